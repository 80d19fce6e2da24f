"""Surface normals of returns."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

UNIT = 1e-6
"""Tolerance of the length of a normal, which is stored in float32."""


@dataclass(frozen=True, kw_only=True)
class Normals:
    """Settings of the part: none."""


class NormalsPart:
    """The part `normals`; see `scenegen.draw.parts.Part`."""

    help: str = "Store the surface normal at every return."
    choices: tuple[str, ...] = ()
    settings: type = Normals

    def resolve(self, choice: Any, class_names: Callable[[Any], set[str]]) -> Normals:
        """Make the settings; see `Part.resolve`.

        Returns:
            Empty settings.
        """
        return Normals()

    def compute(
        self, fields: Mapping[str, Any], world: Any, recipe: Any, settings: Normals
    ) -> dict[str, Any]:
        """Compute the outward normal of the surface that each ray hits first; see `Part.compute`.

        The clean ray counts: noise changes ranges, not normals.

        Returns:
            The field of the group "normals", (*rays, 3), in the world's frame.
        """
        import numpy as np

        from lidarsim import AnalyticEngine
        from lidarsim.pose import rotate

        # of numerical code alone: reading a dataset imports this file
        from scenegen.draw.draw import caster_at

        lidar = recipe.lidar
        times = fields.get("scan_times")
        directions = rotate(fields["quaternion"], lidar.directions_body)
        time_s = 0.0 if times is None else float(times[0])
        # the analytic engine alone tells normals, whichever engine cast the ranges
        engine: Any = caster_at(world, AnalyticEngine.of, recipe, time_s)
        origin = np.asarray(fields["position"])[None]
        hits = engine.hits(origin, directions[None], lidar.max_range_m)
        # NaN where a ray hits nothing; the format has zeros there
        normals = np.nan_to_num(hits.normals[0]).astype("<f4")
        normals[~np.isfinite(fields["ranges"])] = 0.0
        return {"return_normal": normals}

    def broken_laws(
        self, fields: Mapping[str, Any], settings: Normals, *, exact: bool
    ) -> Iterator[str]:
        """Check that normals have length 1 at returns, and are 0 elsewhere.

        Yields:
            A line if some are wrong.
        """
        import numpy as np

        lengths = np.linalg.norm(fields["return_normal"].astype(float), axis=-1)
        returned = np.isfinite(fields["ranges"])
        wrong = np.count_nonzero(lengths[~returned])
        unit = np.abs(lengths - 1.0) <= UNIT
        # noise may add a return where the ray itself hits nothing
        unit |= (lengths == 0.0) & (not exact)
        wrong += np.count_nonzero(returned & ~unit)
        if wrong:
            yield f"{wrong} normals are not of length 1 at a return, and 0 elsewhere"
