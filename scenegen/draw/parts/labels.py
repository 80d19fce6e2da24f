"""Semantics: which geom every return and every voxel is of, and of which class that geom is."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, get_args

from scenegen.worlds.classes import By, Labels


class LabelsPart:
    """See `scenegen.draw.parts.Part`."""

    help: str = (
        "Store the geom and the class of every return and voxel: the kinds' own classes, or by "
        "names, materials or groups of geoms."
    )
    choices: tuple[str, ...] = get_args(By)
    settings: type = Labels

    def resolve(self, choice: Any, class_names: Callable[[Any], set[str]]) -> Labels:
        """See `Part.resolve`."""
        from scenegen.worlds.labels import labels_by

        return labels_by(choice, class_names(choice))

    def compute(
        self, fields: Mapping[str, Any], world: Any, recipe: Any, settings: Labels
    ) -> dict[str, Any]:
        """See `Part.compute`."""
        from scenegen.worlds.labels import label_fields

        return label_fields(fields, world, recipe.lidar, recipe.grid, settings)

    def broken_laws(
        self, fields: Mapping[str, Any], settings: Labels, *, exact: bool
    ) -> Iterator[str]:
        """See `Part.broken_laws`: what is occupied or returned has a geom, and geoms have
        classes."""
        import numpy as np

        occupied, returned = fields["occupancy"], np.isfinite(fields["ranges"])
        for what, known, both_ways, line in (
            ("voxel", occupied, True, "voxels have a geom and are not occupied"),
            # noise may tell of a return where the ray itself met nothing
            ("return", returned, exact, "rays have a geom and no return"),
        ):
            geoms, classes = fields[f"{what}_geom"], fields[f"{what}_class"]
            wrong = np.count_nonzero((geoms >= 0) & ~known)
            wrong += np.count_nonzero((geoms < 0) & known) if both_ways else 0
            if wrong:
                yield f"{wrong} {line}, or the reverse"
            wrong = np.count_nonzero((classes > 0) != (geoms >= 0))
            wrong += np.count_nonzero(classes >= len(settings.classes))
            if wrong:
                yield f"{wrong} values of {what}_class are no class of a geom"
