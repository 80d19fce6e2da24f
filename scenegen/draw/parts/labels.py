"""Labels: the geom of every return and voxel, and the geom's class."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, get_args

from scenegen.worlds.classes import By, Labels


class LabelsPart:
    """The part `labels`; see `scenegen.draw.parts.Part`."""

    help: str = (
        "Store the geom and the class of every return and voxel: the kinds' own classes, or by "
        "names, materials or groups of geoms."
    )
    choices: tuple[str, ...] = get_args(By)
    settings: type = Labels

    def resolve(self, choice: Any, class_names: Callable[[Any], set[str]]) -> Labels:
        """Make the table of classes.

        Args:
            choice: How geoms are classified: "class", "name", "material" or "group".
            class_names: Returns the classes of the geoms of all worlds.

        Returns:
            The table of classes.

        Raises:
            RecipeError: if there are too many classes.
        """
        from scenegen.worlds.labels import labels_by

        return labels_by(choice, class_names(choice))

    def compute(
        self, fields: Mapping[str, Any], world: Any, recipe: Any, settings: Labels
    ) -> dict[str, Any]:
        """Label returns and voxels; see `Part.compute`.

        Returns:
            The fields of the group "labels".
        """
        from scenegen.worlds.labels import label_fields

        return label_fields(fields, world, recipe.lidar, recipe.grid, settings)

    def broken_laws(
        self, fields: Mapping[str, Any], settings: Labels, *, exact: bool
    ) -> Iterator[str]:
        """Check that exactly the occupied voxels and the returns have geoms, and geoms have
        classes.

        Yields:
            A line for each fault.
        """
        import numpy as np

        occupied, returned = fields["occupancy"], np.isfinite(fields["ranges"])
        for noun, expected, required, line in (
            ("voxel", occupied, True, "voxels have a geom and are not occupied"),
            # noise may add a return where the ray itself hits nothing
            ("return", returned, exact, "rays have a geom and no return"),
        ):
            geoms, classes = fields[f"{noun}_geom"], fields[f"{noun}_class"]
            wrong = np.count_nonzero((geoms >= 0) & ~expected)
            wrong += np.count_nonzero((geoms < 0) & expected) if required else 0
            if wrong:
                yield f"{wrong} {line}, or the reverse"
            # class 0 means that there is no geom
            wrong = np.count_nonzero((classes > 0) != (geoms >= 0))
            wrong += np.count_nonzero(classes >= len(settings.classes))
            if wrong:
                yield f"{wrong} values of {noun}_class are no class of a geom"
