"""An occupancy oracle that shares neither code nor method with ``scenegen.truth``.

A voxel's verdict rests on a distance of its cube. From a primitive, it is MuJoCo's (GJK and EPA, to
1e-9 m); from a cylinder, that of its axis from the part of the cube between its ends. From a convex
hull, it is the widest slab between the two along the axes of the separating axis theorem: at most
the distance, and above 0 where they do not meet. Non-convex things are unions: a triangle mesh is
its triangles, plus the voxel centres whose winding number (solid angles after Van Oosterom and
Strackee 1983) is not zero; a height field is one prism per triangle of MuJoCo's own triangulation.

A cube is *occupied* up to ``NEAR``, *free* from ``FAR`` on, and *either* in between, the band
around the 1e-6 m of the contract in which rounding may decide.
"""

import itertools
import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

NEAR = 0.5e-6
FAR = 3e-6

FREE, EITHER, OCCUPIED = range(3)
"""Of a union's parts, the greatest verdict is the union's."""

KINDS = "sphere", "capsule", "ellipsoid", "cylinder", "box", "plane"

Floats = NDArray[np.float64]


def unit(rng):
    """A random direction."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def rotation(quat):
    """The matrix of a quaternion w, x, y, z of any length."""
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()


@dataclass(frozen=True)
class Shape:
    """One primitive: MuJoCo's name and size numbers, and its pose in the world."""

    kind: str
    size: tuple[float, float, float]
    pos: Floats = field(default_factory=lambda: np.zeros(3))
    quat: Floats = field(default_factory=lambda: np.array([1.0, 0, 0, 0]))

    @cached_property
    def rot(self):
        return rotation(self.quat)

    def at(self, pos):
        return Shape(self.kind, self.size, np.asarray(pos, float), self.quat)


def world_of(*shapes):
    """A compiled model whose world body holds these shapes and nothing else."""
    spec = mujoco.MjSpec()
    for shape in shapes:
        geom = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}")
        spec.worldbody.add_geom(type=geom, size=shape.size, pos=shape.pos, quat=shape.quat)
    return spec.compile()


def add_mesh(spec, mesh, pos, quat, **more):
    """Put a geom of trimesh's mesh into a world, with all of its faces as they are."""
    name = f"mesh {len(spec.meshes)}"
    points, faces = np.ravel(mesh.vertices), np.ravel(mesh.faces)
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name=name, uservert=points, userface=faces.tolist(), inertia=shell, **more)
    geom = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(type=geom, meshname=name, pos=pos, quat=quat)


def add_hfield(spec, elevation, size, pos, quat):
    """Put a height field into a world; its elevation is from 0 to 1, and both are reached, or else
    MuJoCo would stretch it."""
    name, (rows, cols) = f"hfield {len(spec.hfields)}", elevation.shape
    spec.add_hfield(name=name, nrow=rows, ncol=cols, size=size, userdata=elevation.ravel())
    geom = mujoco.mjtGeom.mjGEOM_HFIELD
    spec.worldbody.add_geom(type=geom, hfieldname=name, pos=pos, quat=quat)


# ------------------------------------------------------------------------------------------
# Primitives
# ------------------------------------------------------------------------------------------


def at_least(shape, points):
    """A lower bound of the distance from world points (..., 3) to a primitive, not above 0 where
    they satisfy the inequality that defines it.

    Exact for all but the ellipsoid, for which the gauge G is convex, so that G(y) >= G(x) + dG(x)(y
    - x) puts the surface G = 1 at least (G(x) - 1) / |dG(x)| away.
    """
    local = (points - shape.pos) @ shape.rot
    size = np.array(shape.size)
    side, up = np.hypot(local[..., 0], local[..., 1]), np.abs(local[..., 2])
    match shape.kind:
        case "plane":
            return local[..., 2]
        case "sphere":
            return np.hypot(side, up) - size[0]
        case "capsule":
            return np.hypot(side, np.maximum(up - size[1], 0)) - size[0]
        case "cylinder":
            return np.hypot(np.maximum(side - size[0], 0), np.maximum(up - size[1], 0))
    bound = np.linalg.norm(np.maximum(np.abs(local) - size, 0), axis=-1)
    if shape.kind == "ellipsoid":
        gauge, slope = (np.linalg.norm(local / size**n, axis=-1) for n in (1, 2))
        bound = np.maximum(bound, np.maximum(gauge - 1, 0) * gauge / np.maximum(slope, 1e-9))
    return bound


def points_inside(shape, points):
    """Whether world points (..., 3) satisfy the inequality that defines a primitive."""
    return at_least(shape, points) <= 0


def support_point(shape, direction):
    """The point of a primitive (no half-space) farthest along a unit direction."""
    d, size = direction @ shape.rot, np.array(shape.size)
    end = np.copysign(size, d)
    match shape.kind:
        case "sphere":
            end = size[0] * d
        case "capsule":
            end = size[0] * d + [0, 0, math.copysign(size[1], d[2])]
        case "cylinder":
            rim = size[0] * d[:2] / max(math.hypot(*d[:2]), 1e-300)
            end = np.array([*rim, math.copysign(size[1], d[2])])
        case "ellipsoid":
            end = size**2 * d / np.linalg.norm(size * d)
    return shape.pos + shape.rot @ end


def _verdicts(shape, centres, half):
    """The verdicts on the cubes around centres (n, 3)."""
    if shape.kind == "cylinder":  # of which MuJoCo misses cubes that touch the side
        # one longer and wider by a slack reaches at most √2 of it beyond
        (radius, length, _), slacks = shape.size, (NEAR, FAR / 1.5)
        near, far = (_beside(shape, centres, half, length + slack) - slack for slack in slacks)
        return np.select([near <= radius, far < radius], [OCCUPIED, EITHER], FREE)
    margin_m, core = 0.0, shape
    if shape.kind == "capsule":  # MuJoCo's function for capsules and boxes is not exact
        margin_m, length, _ = shape.size
        core = replace(shape, kind="box", size=(1e-9, 1e-9, length))
    model = world_of(core, Shape("box", (half, half, half)))
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-9, 500
    data, distances = mujoco.MjData(model), np.empty(len(centres))
    mujoco.mj_kinematics(model, data)
    for n, centre in enumerate(centres):
        data.geom_xpos[1] = centre
        distances[n] = mujoco.mj_geomDistance(model, data, 0, 1, margin_m + 2 * FAR, None)
    distances -= margin_m
    return np.select([distances <= NEAR, distances < FAR], [OCCUPIED, EITHER], FREE)


CORNERS = np.array(list(itertools.product((-1, 1), repeat=3)))
EDGES = np.argwhere(np.triu(abs(CORNERS[:, None] - CORNERS).sum(axis=2) == 2))


def _beside(shape, centres, half, length):
    """Metres from an axis to the parts of cubes between its ends at ± length: to the hull of where
    the cubes' edges begin and end between them."""
    corners = (centres[:, None] + half * CORNERS - shape.pos) @ shape.rot
    begin, end = corners[:, EDGES].transpose(2, 0, 1, 3)
    rise = end[..., 2] - begin[..., 2] + 1e-300
    shares = np.sort([(z - begin[..., 2]) / rise for z in (-length, length)], axis=0).clip(0, 1)
    points = np.concatenate(begin + shares[..., None] * (end - begin), axis=1)
    points[abs(points[..., 2]) > length + 1e-12] = np.nan
    one, other = np.triu_indices(points.shape[1])
    first, step = points[:, one, :2], points[:, other, :2] - points[:, one, :2]
    share = -(first * step).sum(axis=2) / ((step**2).sum(axis=2) + 1e-300)
    apart = np.linalg.norm(first + share.clip(0, 1)[..., None] * step, axis=2)
    least = np.where(np.isnan(apart), np.inf, apart).min(axis=1)
    # where the axis enters and leaves the cubes
    ways = (centres[:, None] + half * np.array([[-1], [1]]) - shape.pos) / (
        shape.rot[:, 2] + 1e-300
    )
    enters, leaves = ways.min(axis=1).max(axis=1), ways.max(axis=1).min(axis=1)
    return np.where(np.maximum(enters, -length) <= np.minimum(leaves, length), 0.0, least)


def judge(shape, grid_shape, voxel, origin):
    """The verdict on one primitive, for every voxel of a map, and which voxels lie near its
    surface.

    A voxel is off the boundary when all its corners are inside (the solid is convex), or its centre
    is farther away than a corner of it is; only boundary voxels need a distance.
    """
    half = voxel / 2
    corners = origin + np.moveaxis(np.indices(np.add(grid_shape, 1)), 0, -1) * voxel
    inside = points_inside(shape, corners)
    deep = np.lib.stride_tricks.sliding_window_view(inside, (2, 2, 2)).all(axis=(3, 4, 5))
    centres = voxel_centres(grid_shape, voxel, origin)
    boundary = ~deep & (at_least(shape, centres) <= math.sqrt(3.0) * half + FAR)
    verdict = np.where(deep, OCCUPIED, FREE)
    verdict[boundary] = _verdicts(shape, centres[boundary], half)
    return verdict, boundary


def voxel_centres(grid_shape, voxel, origin):
    """The centres of the voxels, (nx, ny, nz, 3)."""
    return origin + (np.moveaxis(np.indices(grid_shape), 0, -1) + 0.5) * voxel


# ------------------------------------------------------------------------------------------
# Unions of convex pieces: meshes and height fields
# ------------------------------------------------------------------------------------------


def _gaps(hull, centres, half):
    """Widths of the widest slabs between the hull of points and the cubes around centres."""
    edges = (hull[:, None] - hull)[np.triu_indices(len(hull), 1)]
    crosses = np.cross(edges[:, None], np.concatenate([edges, np.eye(3)])).reshape(-1, 3)
    axes = np.concatenate([np.eye(3), crosses[crosses.any(axis=1)]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    ends, middles = hull @ axes.T, centres @ axes.T
    apart = np.maximum(ends.min(axis=0) - middles, middles - ends.max(axis=0))
    return (apart - half * np.abs(axes).sum(axis=1)).max(axis=1)


def judge_hulls(hulls, grid_shape, voxel, origin):
    """The verdict on a union of convex hulls of equally many points, (n, points, 3) in the
    world."""
    verdict, centres = np.full(grid_shape, FREE), voxel_centres(grid_shape, voxel, origin)
    # the voxels that its bounding box meets, and one more all around
    first = np.floor((hulls.min(axis=1) - origin) / voxel).astype(int) - 1
    end = np.floor((hulls.max(axis=1) - origin) / voxel).astype(int) + 2
    for hull, low, high in zip(hulls, first.clip(0), end.clip(0), strict=True):
        part = tuple(map(slice, low, high))
        if not verdict[part].size:
            continue
        gaps = _gaps(hull, centres[part].reshape(-1, 3), voxel / 2)
        verdicts = np.select([gaps <= 0, gaps < FAR], [OCCUPIED, EITHER], FREE)
        verdict[part] = np.maximum(verdict[part], verdicts.reshape(verdict[part].shape))
    return verdict


def winding_number(triangles, points):
    """How often a closed surface (f, 3, 3) winds around each point (n, 3): the sum of solid
    angles."""
    total = np.zeros(len(points))
    for corners in triangles:
        a, b, c = corners[:, None] - points
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        ab, bc, ca, volume = (
            np.einsum("ni,ni->n", *pair) for pair in ((a, b), (b, c), (c, a), (a, np.cross(b, c)))
        )
        total += 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return total / (4 * np.pi)


def filled(surface, triangles, voxel, origin):
    """The verdict on a watertight mesh, given that on its `surface`.

    A voxel that no triangle touches is inside or outside as a whole: the winding number at its
    centre tells.
    """
    centres = voxel_centres(surface.shape, voxel, origin)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    clear = ((centres >= low) & (centres <= high)).all(axis=-1) & (surface != OCCUPIED)
    inside = np.abs(winding_number(triangles, centres[clear])) > 0.5
    verdict = surface.copy()
    verdict[clear] = np.where(inside, OCCUPIED, verdict[clear])
    return verdict


def hfield_prisms(heights, size, pos, quat):
    """A height field as prisms (n, 6, 3) in the world, from its surface down to z = -size[3].

    ``heights`` (rows along y, columns along x) are metres above the geom's frame. Each cell is cut
    along the diagonal from its (low x, low y) corner to its (high x, high y) corner;
    ``tests/lidarsim/engines/test_laws.py`` establishes with rays that MuJoCo cuts it there.
    """
    rows, cols = heights.shape
    xs, ys = np.linspace(-size[0], size[0], cols), np.linspace(-size[1], size[1], rows)
    prisms = []
    for r, c in np.ndindex(rows - 1, cols - 1):
        for third in ((r, c + 1), (r + 1, c)):
            top = [(xs[j], ys[i], heights[i, j]) for i, j in ((r, c), (r + 1, c + 1), third)]
            prisms.append(top + [(x, y, -size[3]) for x, y, _ in top])
    return np.asarray(prisms) @ rotation(quat).T + pos
