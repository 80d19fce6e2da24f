"""Semantics: which geom every return and every voxel is of, and of which class that geom is."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

from scenegen.limits import MOST_CLASSES

By: TypeAlias = Literal["class", "name", "material", "group"]
"""What decides the class of a geom."""
NOTHING = "nothing"
"""Class 0: of a ray without a return, and of a voxel that is not occupied."""


@dataclass(frozen=True, kw_only=True)
class Labels:
    """What decides the class of a geom, and what classes there are.

    By `name`, it is the geom's name without the numbers that end its parts, so that ``crate_07`` is
    a ``crate``, and ``beech_01_bough`` a ``beech_bough``; by `material`, it is the name of its
    material in the same way. A geom without such a name is of the class of its shape. By `group`,
    it is MuJoCo's group; by `class`, it is one of `scenegen.worlds.classes.CLASSES`, the same
    for all kinds of worlds: the material's, and "other" for a geom whose material has another
    name.
    """

    by: By
    classes: tuple[str, ...]
    """Names of classes; a class is its place in here, and the first is `NOTHING`."""

    def __post_init__(self) -> None:
        if self.by not in get_args(By):
            raise ValueError(f"by = {self.by!r}: expected one of {', '.join(get_args(By))}")
        object.__setattr__(self, "classes", tuple(self.classes))
        names = self.classes
        valid = all(isinstance(name, str) and name.isprintable() for name in names)
        if (
            not valid
            or not 0 < len(names) <= MOST_CLASSES
            or len(set(names)) < len(names)
            or names[0] != NOTHING
        ):
            raise ValueError(
                f"classes: expected up to {MOST_CLASSES} different names, {NOTHING!r} first"
            )


class LabelsPart:
    """See `scenegen.parts.Part`."""

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
