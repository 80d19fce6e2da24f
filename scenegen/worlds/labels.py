"""Semantics: which geom every return and every voxel is of, and of which class that geom is."""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim import AnalyticEngine, GridSpec, Sensor
from lidarsim.grid import Floats, Mask
from lidarsim.jit import kernel
from lidarsim.pose import rotate
from lidarsim.solids.shapes import Solids
from scenegen.errors import GenerationError, short
from scenegen.limits import MOST_CLASSES
from scenegen.truth.occupancy import SLACK_M, spans
from scenegen.truth.shapes import distance, local
from scenegen.truth.triangles import inside_columns, triangle_distance
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
    engine: Any = world.caster(AnalyticEngine.of)
    met = engine.hits(origin, directions[None], lidar.max_range_m).geoms[0]
    returned = np.where(np.isfinite(sample["ranges"]), met, -1).astype("<i4")
    voxels = owners(world.solids, sample["occupancy"], grid, sample["origin"]).astype("<i4")
    return {
        "return_geom": returned,
        "return_class": classes[returned],
        "voxel_geom": voxels,
        "voxel_class": classes[voxels],
    }


NONE = -1
"""The owner of a voxel that is not occupied."""


def owners(solids: Solids, occupancy: Mask, grid: GridSpec, origin: ArrayLike) -> NDArray[np.int32]:
    """The geom (*grid.shape) that every occupied voxel belongs to, `NONE` elsewhere; `origin` (3,)
    is the grid's least corner, world metres.

    It is the geom whose filled solid lies nearest to the voxel's centre, at 0 where it holds the
    centre; of several at the same distance the one with the lowest number.
    """
    origin, voxel_m = np.asarray(origin, dtype=np.float64), grid.voxel_m
    # a cube that a solid touches has its centre no farther off
    reach = 0.5 * math.sqrt(3.0) * voxel_m + 2 * SLACK_M
    nearest, owner = np.full(grid.shape, np.inf), np.full(grid.shape, NONE, np.int32)
    primitives = len(solids.shape)
    for n in range(primitives):
        cells = _cells(solids.lower[n] - reach, solids.upper[n] + reach, origin, grid)
        if cells is not None:
            here = np.where(occupancy[cells], 0.0, np.inf)
            first = np.array([part.start for part in cells])
            _to_primitive(
                solids.shape[n],
                solids.size[n],
                solids.position[n],
                solids.rotation[n],
                origin + (first + 0.5) * voxel_m,
                voxel_m,
                here,
            )
            _claim(here, int(solids.geom[n]), nearest[cells], owner[cells])
    for mesh, filled in enumerate(solids.mesh_filled):
        triangles = solids.triangles[solids.mesh_start[mesh] : solids.mesh_start[mesh + 1]]
        low, high = triangles.min(axis=1) - reach, triangles.max(axis=1) + reach
        cells = _cells(low.min(axis=0), high.max(axis=0), origin, grid)
        if cells is not None:
            here = np.full(grid.shape, np.inf)
            _to_triangles(triangles, low, high, origin, voxel_m, occupancy, here)
            if filled:
                held = np.zeros(grid.shape, np.bool_)
                inside_columns(triangles, origin, voxel_m, held)
                here[held & occupancy] = 0.0
            _claim(here[cells], int(solids.geom[primitives + mesh]), nearest[cells], owner[cells])
    return owner


def _cells(
    lower: Floats, upper: Floats, origin: Floats, grid: GridSpec
) -> tuple[slice, ...] | None:
    """The voxels that touch a box; None where there are none."""
    ends = spans(lower, upper, origin, grid.voxel_m, grid.shape)
    found = tuple(map(slice, ends[::2], ends[1::2]))
    return found if all(part.start < part.stop for part in found) else None


def _claim(here: Floats, geom: int, nearest: Floats, owner: NDArray[np.int32]) -> None:
    """Give `geom` the voxels to which it is nearer than their owner, or as near and of a lower
    number."""
    won = (here < nearest) | ((here == nearest) & np.isfinite(here) & (geom < owner))
    nearest[won], owner[won] = here[won], geom


@kernel
def _to_primitive(shape, size, position, axes, first, voxel_m, here):
    """Distances of centres to a primitive, where `here` is not inf."""
    nx, ny, nz = here.shape
    for i in range(nx):
        dx = first[0] + i * voxel_m - position[0]
        for j in range(ny):
            dy = first[1] + j * voxel_m - position[1]
            for k in range(nz):
                if here[i, j, k] == 0.0:
                    dz = first[2] + k * voxel_m - position[2]
                    x, y, z = local(axes, dx, dy, dz)
                    here[i, j, k] = distance(shape, size, x, y, z)


@kernel
def _to_triangles(triangles, low, high, origin, voxel_m, occupancy, here):
    """Least distances of occupied voxels' centres to triangles (T, 3, 3), in boxes from `low` to
    `high` (T, 3)."""
    for n in range(len(triangles)):
        a, b, c = triangles[n, 0], triangles[n, 1], triangles[n, 2]
        i0, i1, j0, j1, k0, k1 = spans(low[n], high[n], origin, voxel_m, occupancy.shape)
        for i in range(i0, i1):
            x = origin[0] + (i + 0.5) * voxel_m
            for j in range(j0, j1):
                y = origin[1] + (j + 0.5) * voxel_m
                for k in range(k0, k1):
                    if occupancy[i, j, k]:
                        z = origin[2] + (k + 0.5) * voxel_m
                        here[i, j, k] = min(here[i, j, k], triangle_distance(a, b, c, x, y, z))
