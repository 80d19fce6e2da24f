"""Classes of solids that kinds of worlds draw, and the share of light that each reflects.

The names follow the occupancy classes of SemanticKITTI (Behley et al. 2019) and nuScenes (Occ3D,
Tian et al. 2023) where these have one. A class is the solids' material, so it is in every MJCF
document, and the material's colour has the brightness that the noise stage `intensity` takes for
its albedo. The shares are for light of 0.9 µm, from the table of reflectivities that makers of
laser range finders print (asphalt 17 %, smooth concrete 24 %, brick and clay up to 75 %, rough wood
25 %, dry lumber 94 %, deciduous trees 60 %, conifers 30 %, black rubber 5 %, white masonry 85 %);
painted and metal surfaces vary so much that theirs are round numbers between."""

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from scenegen.base.limits import MAX_CLASSES

By: TypeAlias = Literal["class", "name", "material", "group"]
"""The attribute of a geom that decides its class."""
NOTHING = "nothing"
"""Class 0: of a ray without a return, and of a voxel that is not occupied."""


@dataclass(frozen=True, kw_only=True)
class Labels:
    """The rule by which geoms have classes, and the list of classes.

    By `name`, it is the geom's name without the numbers that end its parts, so that ``crate_07`` is
    a ``crate``, and ``beech_01_bough`` a ``beech_bough``; by `material`, it is the name of its
    material in the same way. A geom without such a name is of the class of its shape. By `group`,
    it is MuJoCo's group; by `class`, it is one of `scenegen.worlds.classes.CLASSES`, the same for
    all kinds of worlds: the material's, and "other" for a geom whose material has another name."""

    by: By
    classes: tuple[str, ...]
    """Names of classes; a class is its place in here, and the first is `NOTHING`."""

    def __post_init__(self) -> None:
        if self.by not in get_args(By):
            raise ValueError(f"by = {self.by!r}: expected one of {', '.join(get_args(By))}")
        # JSON gives a list, which has no hash
        object.__setattr__(self, "classes", tuple(self.classes))
        names = self.classes
        valid = all(isinstance(name, str) and name.isprintable() for name in names)
        if (
            not valid
            or not 0 < len(names) <= MAX_CLASSES
            or len(set(names)) < len(names)
            or names[0] != NOTHING
        ):
            raise ValueError(
                f"classes: expected up to {MAX_CLASSES} different names, {NOTHING!r} first"
            )


OTHER = "other"
"""The class of a solid whose material is not a class."""
_REFLECTS = """
other      0.40  1.00 1.00 1.00
road       0.17  1.00 1.00 1.05
sidewalk   0.24  1.05 1.00 0.95
terrain    0.30  1.20 1.00 0.70
floor      0.30  1.05 1.00 0.95
ceiling    0.70  1.00 1.00 1.00
wall       0.60  1.05 1.00 0.92
building   0.45  1.25 0.95 0.80
roof       0.35  1.60 0.85 0.70
door       0.35  1.30 0.95 0.60
column     0.30  1.00 1.00 1.00
stairs     0.35  1.00 1.00 1.10
furniture  0.50  1.30 0.95 0.60
shelf      0.40  0.70 0.95 1.80
goods      0.55  1.30 0.95 0.60
vegetation 0.50  0.50 1.20 0.50
trunk      0.25  1.30 0.95 0.60
rock       0.30  1.10 1.00 0.85
pole       0.35  1.00 1.00 1.00
cable      0.10  1.00 1.00 1.00
sign       0.60  0.70 1.00 1.60
fence      0.40  1.00 1.00 0.90
vehicle    0.35  0.70 1.00 1.70
tyre       0.05  1.00 1.00 1.00
pipe       0.45  1.40 0.95 0.50
tank       0.55  0.95 1.00 1.05
machine    0.40  0.70 1.10 0.90
beam       0.30  1.00 1.00 1.00
"""
"""A class a line: the share that it reflects, and its hue as red, green and blue of any size."""


def _coloured(albedo: float, *hue: float) -> tuple[float, ...]:
    """Scale a hue to the brightness `albedo`, by the weights of ITU-R BT.709."""
    bright = 0.2126 * hue[0] + 0.7152 * hue[1] + 0.0722 * hue[2]
    # four digits, so that MJCF writes the colour without loss
    return (*(round(min(albedo * part / bright, 1.0), 4) for part in hue), 1.0)


COLOURS = {
    name: _coloured(*map(float, numbers))
    for name, *numbers in map(str.split, _REFLECTS.strip().splitlines())
}
"""Every class and its colour, as red, green, blue and alpha."""
CLASSES = tuple(COLOURS)
