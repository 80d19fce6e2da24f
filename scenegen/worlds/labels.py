"""Semantics: which geom every return and every voxel is of, and of which class that geom is."""

import functools
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim import AnalyticEngine, GridSpec, Sensor
from lidarsim.pose import rotate
from scenegen.errors import GenerationError, short
from scenegen.limits import MOST_CLASSES
from scenegen.truth.labels import owners
from scenegen.worlds.classes import CLASSES, OTHER
from scenegen.worlds.world import World

By: TypeAlias = Literal["class", "name", "material", "group"]
"""What decides the class of a geom."""
NOTHING = "nothing"
"""Class 0: of a ray without a return, and of a voxel that is not occupied."""
SHAPES = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
"""Classes of geoms without names, by MuJoCo's codes of shapes."""
GROUPS = tuple(f"group {n}" for n in range(mujoco.mjNGROUP))


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

    def of(self, world: World) -> NDArray[np.uint16]:
        """The class of every geom of a world, (ngeom,). Raises GenerationError for one that is none
        of `classes`."""
        place = {name: number for number, name in enumerate(self.classes)}
        named = class_names(world.model, self.by)
        for geom, name in enumerate(named):
            if name not in place:
                raise GenerationError(
                    f"geom {short(world.model.geom(geom).name)} is of class {short(name)}, which "
                    "was not known before; name it in the kind's `classes`, or give --labels group"
                )
        return np.array([place[name] for name in named], np.uint16)


def class_names(model: mujoco.MjModel, by: By) -> list[str]:
    """The name of every geom's class; see `Labels`."""
    if by == "group":
        return [GROUPS[int(group)] for group in model.geom_group]
    names = [model.mat(int(number)).name if number >= 0 else "" for number in model.geom_matid]
    if by == "class":
        return [name if name in CLASSES else OTHER for name in names]
    if by == "name":
        names = [model.geom(geom).name for geom in range(model.ngeom)]
    parts = (re.split(r"[._-]+", name) for name in names)
    stems = ("_".join(filter(None, (part.rstrip("0123456789") for part in each))) for each in parts)
    return [stem or SHAPES[int(model.geom_type[geom])] for geom, stem in enumerate(stems)]


def labels_by(by: By, named: Iterable[str]) -> Labels:
    """The labels of worlds whose geoms' classes `named` are known besides shapes. Raises
    GenerationError."""
    fixed = {"group": GROUPS, "class": CLASSES}
    known = fixed[by] if by in fixed else (*SHAPES, *sorted(set(named) - {*SHAPES, NOTHING}))
    if len(known) >= MOST_CLASSES:
        raise GenerationError(
            f"{len(known)} classes by name, expected {MOST_CLASSES} at most; give --labels group"
        )
    return Labels(by=by, classes=(NOTHING, *known))


def label_fields(
    sample: Mapping[str, Any], world: World, lidar: Sensor, grid: GridSpec, labels: Labels
) -> dict[str, NDArray[Any]]:
    """The fields of a sample that say which geom and class its returns and voxels are of.

    A return is of the geom that its ray meets first, whatever noise made of its range.

    Args:
        sample: Its other fields by name: position, quaternion, ranges, occupancy and origin.
        world: The world that it is of.
        lidar: The sensor.
        grid: The map's grid.
        labels: What decides the class of a geom.

    Raises:
        GenerationError: A geom is of none of the classes.
    """
    # -1, no geom, is the last
    classes = np.append(labels.of(world), [0]).astype("<u2")
    directions = rotate(sample["quaternion"], lidar.directions_body)
    origin = np.asarray(sample["position"])[None]
    met = _engine(world).hits(origin, directions[None], lidar.max_range_m).geoms[0]
    returned = np.where(np.isfinite(sample["ranges"]), met, -1).astype("<i4")
    voxels = owners(world.solids, sample["occupancy"], grid, sample["origin"]).astype("<i4")
    return {
        "return_geom": returned,
        "return_class": classes[returned],
        "voxel_geom": voxels,
        "voxel_class": classes[voxels],
    }


@functools.lru_cache(maxsize=4)
def _engine(world: World) -> AnalyticEngine:
    return AnalyticEngine(world.solids)
