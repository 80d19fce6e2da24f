"""Movers: which returns and voxels are of what moves, and where it goes."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from lidarsim.parameters import short_repr
from scenegen.base.errors import UsageError
from scenegen.worlds.traffic import PRESETS, Traffic


class MoversPart:
    """The part `movers`; see `scenegen.draw.parts.Part`. Unlike other parts, it changes the worlds:
    `draw_unit` adds people, vehicles and drones to them."""

    help: str = "Add people, vehicles and drones that move, with their exact courses."
    choices: tuple[str, ...] = tuple(PRESETS)
    settings: type = Traffic

    def resolve(self, choice: Any, class_names: Callable[[Any], set[str]]) -> Traffic:
        """Make the settings; see `Part.resolve`.

        Args:
            choice: Name of a preset.
            class_names: Not needed.

        Returns:
            The settings.

        Raises:
            UsageError: if there is no such preset.
        """
        if choice not in self.choices:
            raise UsageError(
                f"movers = {short_repr(choice)}: expected one of {', '.join(self.choices)}"
            )
        return PRESETS[choice]

    def compute(
        self, fields: Mapping[str, Any], world: Any, recipe: Any, settings: Traffic
    ) -> dict[str, Any]:
        """Tell what of a sample is of movers; see `Part.compute`.

        Returns:
            The fields of the group "movers" that are not among `fields` already.
        """
        from scenegen.draw.movers import mover_fields

        return mover_fields(fields, world, recipe, settings)

    def broken_laws(
        self, fields: Mapping[str, Any], settings: Traffic, *, exact: bool
    ) -> Iterator[str]:
        """Check that what is occupied is of movers or stands still, that only returns are of
        movers, and that all of them are in the table.

        Yields:
            A line for each fault.
        """
        import numpy as np

        moving, standing = fields["voxel_mover"] >= 0, fields["static_occupancy"]
        if wrong := np.count_nonzero((moving | standing) != fields["occupancy"]):
            yield f"{wrong} voxels are occupied by neither movers nor others, or the reverse"
        hit = fields["return_mover"] >= 0
        if exact and (wrong := np.count_nonzero(hit & ~np.isfinite(fields["ranges"]))):
            yield f"{wrong} rays are of movers and have no return"
        count = int(np.count_nonzero(fields["mover_kind"]))
        for name in ("voxel_mover", "return_mover"):
            if (fields[name] >= count).any() or (fields[name] < -1).any():
                yield f"{name} names a mover beyond the {count} of the table"
        if not np.isfinite(fields["scan_times"]).all():
            yield "scan_times are not finite"
