"""Semantics: the geom of every return and every voxel, and that geom's class."""

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any, get_args

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim import AnalyticEngine, GridSpec, Sensor
from lidarsim.grid import Mask
from lidarsim.jit import kernel
from lidarsim.parameters import short_repr
from lidarsim.pose import rotate
from lidarsim.solids import Solids, local
from scenegen.base.errors import GenerationError, RecipeError
from scenegen.base.limits import MAX_CLASSES
from scenegen.truth.occupancy import SLACK_M, inside_columns, spans
from scenegen.truth.shapes import distance
from scenegen.truth.triangles import triangle_distance
from scenegen.worlds.classes import CLASSES, NOTHING, OTHER, By, Labels
from scenegen.worlds.drawing import SHAPES
from scenegen.worlds.traffic import KINDS
from scenegen.worlds.world import World

GROUPS = tuple(f"group {n}" for n in range(mujoco.mjNGROUP))


def classes_of(world: World, labels: Labels) -> NDArray[np.uint16]:
    """Determine the class of every geom of a world.

    Args:
        world: The world.
        labels: The rule, and the classes.

    Returns:
        (ngeom,): numbers of classes.

    Raises:
        GenerationError: If a geom is of none of the classes.
    """
    place = {name: number for number, name in enumerate(labels.classes)}
    named = class_names(world.model, labels.by)
    for geom, name in enumerate(named):
        if name not in place:
            raise GenerationError(
                f"geom {short_repr(world.model.geom(geom).name)} is of class "
                f"{short_repr(name)}, which "
                "was not known before; name it in the kind's `classes`, or give --labels group"
            )
    return np.array([place[name] for name in named], np.uint16)


def class_names(model: mujoco.MjModel, by: By) -> list[str]:
    """Name the class of every geom; see `Labels`.

    Args:
        model: The compiled world.
        by: The rule.

    Returns:
        ngeom names.
    """
    if by == "group":
        return [GROUPS[int(group)] for group in model.geom_group]
    names = [model.mat(int(number)).name if number >= 0 else "" for number in model.geom_matid]
    if by == "class":
        return [name if name in CLASSES else OTHER for name in names]
    if by == "name":
        names = [model.geom(geom).name for geom in range(model.ngeom)]
    classes = []
    for geom, name in enumerate(names):
        # copies are numbered, as "chair_03" and "chair.leg2": their class has no numbers
        words = (word.rstrip("0123456789") for word in re.split(r"[._-]+", name))
        stem = "_".join(filter(None, words))
        classes.append(stem or SHAPES[int(model.geom_type[geom])])
    return classes


def labels_by(by: By, named: Iterable[str]) -> Labels:
    """Make the labels of worlds.

    Args:
        by: The rule.
        named: Names of classes that geoms have besides their shapes.

    Returns:
        The labels.

    Raises:
        GenerationError: If there are too many classes.
        RecipeError: If there is no such rule.
    """
    if by not in get_args(By):
        raise RecipeError(f"labels = {by!r}: expected one of {', '.join(get_args(By))}")
    fixed = {"group": GROUPS, "class": CLASSES}
    # sorted, so that numbers do not depend on the order of worlds
    known = fixed[by] if by in fixed else (*SHAPES, *sorted(set(named) - {*SHAPES, NOTHING}))
    if len(known) >= MAX_CLASSES:
        raise GenerationError(
            f"{len(known)} classes by name, expected {MAX_CLASSES} at most; give --labels group"
        )
    return Labels(by=by, classes=(NOTHING, *known))


def label_fields(
    sample: Mapping[str, Any], world: World, lidar: Sensor, grid: GridSpec, labels: Labels
) -> dict[str, NDArray[Any]]:
    """Compute the fields of a sample with the geom and class of its returns and voxels.

    A return is of the geom that its ray meets first, whatever noise made of its range. Movers are
    numbered on from the geoms; a voxel that a mover touches is the mover's.

    Args:
        sample: Its other fields by name: position, quaternion, ranges, occupancy and origin.
        world: The sample's world.
        lidar: The sensor.
        grid: The map's grid.
        labels: The rule, and the classes.

    Returns:
        return_geom, return_class (*lidar.shape), voxel_geom and voxel_class (*grid.shape).

    Raises:
        GenerationError: If a geom is of none of the classes.
    """
    kinds = [] if world.movers is None else world.movers.kind.tolist()
    of_movers = [labels.classes.index(KINDS[kind - 1]) for kind in kinds]
    # -1, no geom, is the last
    classes = np.concatenate([classes_of(world, labels), of_movers, [0]]).astype("<u2")
    directions = rotate(sample["quaternion"], lidar.directions_body)
    origin = np.asarray(sample["position"])[None]
    # of our engines, only this one tells which geom a ray meets
    engine: Any = world.caster(AnalyticEngine.of)
    met = engine.hits(origin, directions[None], lidar.max_range_m).geoms[0]
    returned = np.where(np.isfinite(sample["ranges"]), met, -1).astype("<i4")
    # voxels that only a mover fills belong to no geom
    standing = sample.get("static_occupancy", sample["occupancy"])
    voxels = owners(world.solids, standing, grid, sample["origin"]).astype("<i4")
    if world.movers is not None:
        for numbers, mover in ((returned, "return_mover"), (voxels, "voxel_mover")):
            # of a damaged sample, numbers may be any
            moving = (sample[mover] >= 0) & (sample[mover] < len(kinds))
            numbers[moving] = world.model.ngeom + sample[mover][moving].astype("<i4")
    return {
        "return_geom": returned,
        "return_class": classes[returned],
        "voxel_geom": voxels,
        "voxel_class": classes[voxels],
    }


NONE = -1
"""The owner of a voxel that is not occupied."""


def owners(solids: Solids, occupancy: Mask, grid: GridSpec, origin: ArrayLike) -> NDArray[np.int32]:
    """Find the geom that every occupied voxel belongs to.

    It is the geom whose filled solid lies nearest to the voxel's centre, at 0 if it holds the
    centre; of several at the same distance the one with the lowest number.

    Args:
        solids: The world.
        occupancy: (*grid.shape).
        grid: The map's grid.
        origin: (3,): its least corner, metres, in the world.

    Returns:
        (*grid.shape): numbers of geoms; `NONE` where not occupied.
    """
    origin, voxel_m = np.asarray(origin, float), grid.voxel_m
    # a cube that a solid touches has its centre no farther off; twice the slack, since `touches`
    # counts corners and edges up to 1.7 times as far
    reach = 0.5 * math.sqrt(3.0) * voxel_m + 2 * SLACK_M
    # below any distance in free voxels, so that no geom claims them
    nearest, owner = np.where(occupancy, np.inf, -1.0), np.full(grid.shape, NONE, np.int32)
    forms = solids.shape, solids.size, solids.position, solids.rotation
    boxes = solids.lower - reach, solids.upper + reach
    _claim_primitives(forms, boxes, solids.geom, origin, voxel_m, nearest, owner)
    for mesh, filled in enumerate(solids.mesh_filled):
        geom = solids.geom[len(solids.shape) + mesh]
        triangles = solids.triangles[solids.mesh_start[mesh] : solids.mesh_start[mesh + 1]]
        _claim_triangles(triangles, geom, reach, origin, voxel_m, nearest, owner)
        if filled:
            held = np.zeros(grid.shape, bool)
            inside_columns(triangles, origin, voxel_m, held)
            # free voxels have -1, and stay without an owner
            held &= (nearest > 0.0) | ((nearest == 0.0) & (geom < owner))
            nearest[held], owner[held] = 0.0, geom
    return owner


@kernel
def _claim(gap, geom, place, nearest, owner):
    """Give a voxel to a geom that is nearer than its owner, or equally near with a lower number."""
    if gap < nearest[place] or (gap == nearest[place] and geom < owner[place]):
        nearest[place], owner[place] = gap, geom


@kernel
def _claim_primitives(forms, boxes, geoms, origin, voxel_m, nearest, owner):
    """Claim the voxels in primitives' `boxes` by the distances of their centres."""
    shape, size, position, rotation = forms
    for n in range(len(shape)):
        centre = position[n]
        i0, i1, j0, j1, k0, k1 = spans(boxes[0][n], boxes[1][n], origin, voxel_m, nearest.shape)
        first = origin + (np.array([i0, j0, k0]) + 0.5) * voxel_m
        for i in range(i0, i1):
            dx = first[0] + (i - i0) * voxel_m - centre[0]
            for j in range(j0, j1):
                dy = first[1] + (j - j0) * voxel_m - centre[1]
                for k in range(k0, k1):
                    if nearest[i, j, k] >= 0.0:
                        dz = first[2] + (k - k0) * voxel_m - centre[2]
                        x, y, z = local(rotation[n], dx, dy, dz)
                        gap = distance(shape[n], size[n], x, y, z)
                        _claim(gap, geoms[n], (i, j, k), nearest, owner)


@kernel
def _claim_triangles(triangles, geom, reach, origin, voxel_m, nearest, owner):
    """Claim the voxels near triangles (T, 3, 3) by the distances of their centres."""
    for n in range(len(triangles)):
        a, b, c = triangles[n]
        low = np.minimum(np.minimum(a, b), c) - reach
        high = np.maximum(np.maximum(a, b), c) + reach
        i0, i1, j0, j1, k0, k1 = spans(low, high, origin, voxel_m, nearest.shape)
        for i in range(i0, i1):
            x = origin[0] + (i + 0.5) * voxel_m
            for j in range(j0, j1):
                y = origin[1] + (j + 0.5) * voxel_m
                for k in range(k0, k1):
                    if nearest[i, j, k] >= 0.0:
                        z = origin[2] + (k + 0.5) * voxel_m
                        gap = triangle_distance(a, b, c, x, y, z)
                        _claim(gap, geom, (i, j, k), nearest, owner)
