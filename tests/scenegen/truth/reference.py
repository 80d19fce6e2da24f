"""An occupancy oracle that shares neither code nor method with ``scenegen.truth``.

Every verdict on a voxel rests on a certificate, never on how the search that found it behaves:

* *occupied* - two points, one a convex combination of points of the solid and one of corners of the
  cube, lie
  at most ``NEAR`` apart (or a corner of the cube is inside the solid by its defining inequality);
* *free* - a plane keeps the cube and the solid at least ``FAR`` apart (support functions of both);
* *either* - both certificates place the distance inside (``NEAR``, ``FAR``), the band around the
  1e-6 m of
  the contract in which rounding may decide.

The search is GJK (Gilbert, Johnson, Keerthi 1988) on support functions, in the solid's own frame;
spheres and capsules are a point and a segment with a margin. A voxel for which it finds neither
certificate is UNDECIDED, and the tests insist that there is none. Non-convex things are unions: a
triangle mesh is its triangles, plus the voxel centres whose winding number (solid angles after Van
Oosterom and Strackee 1983) is not zero; a height field is one prism per triangle of MuJoCo's own
triangulation.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

NEAR = 0.5e-6
FAR = 3e-6

FREE, EITHER, UNDECIDED, OCCUPIED = range(4)
"""Of a union's parts, the greatest verdict is the union's."""

SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, PLANE, HULL = range(7)
KINDS = "sphere", "capsule", "ellipsoid", "cylinder", "box", "plane"

Floats = NDArray[np.float64]
jit = numba.njit(cache=True)


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
# Support functions, membership and distance bounds of the convex solids
# ------------------------------------------------------------------------------------------


@jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def _cross(a, b):
    x, y = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
    return x, y, a[0] * b[1] - a[1] * b[0]


@jit
def _along(a, step, b):
    """a + step * b"""
    return a[0] + step * b[0], a[1] + step * b[1], a[2] + step * b[2]


@jit
def _support(kind, given, d):
    """A point of the solid (of its core, where it has a margin) farthest along d, in its frame.

    What is `given` (n, 3) are a hull's points, or in one row the size of a primitive.
    """
    a, b, c = given[0]
    if kind == HULL:
        for x, y, z in given:
            if x * d[0] + y * d[1] + z * d[2] > a * d[0] + b * d[1] + c * d[2]:
                a, b, c = x, y, z
        return a, b, c
    if kind == SPHERE:
        return 0.0, 0.0, 0.0
    if kind == CAPSULE:
        return 0.0, 0.0, math.copysign(b, d[2])
    if kind == CYLINDER:
        x, y = _rim(a, d)
        return x, y, math.copysign(b, d[2])
    if kind == BOX:
        return math.copysign(a, d[0]), math.copysign(b, d[1]), math.copysign(c, d[2])
    x, y, z = a * d[0], b * d[1], c * d[2]
    norm = math.sqrt(x * x + y * y + z * z)
    return a * x / norm, b * y / norm, c * z / norm


@jit
def _rim(radius, d):
    """The point of a circle farthest along d."""
    norm = max(math.hypot(d[0], d[1]), 1e-300)
    return radius * d[0] / norm, radius * d[1] / norm


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


# ------------------------------------------------------------------------------------------
# GJK: the search for certificates
# ------------------------------------------------------------------------------------------


@jit
def _mixed(w, lam):
    """The combination of the points w (4, 3) with the weights ``lam``."""
    point = 0.0, 0.0, 0.0
    for i in range(4):
        point = _along(point, lam[i], w[i])
    return point


@jit
def _offer(w, lam, best_lam, best):
    """Keep the weights ``lam``, made to add up to 1, if none is negative and they name a point
    nearer to the origin than the best."""
    total = lam[0] + lam[1] + lam[2] + lam[3]
    if total != 0.0:
        least = 0.0
        for i in range(4):  # numba takes seconds to compile what assigns to slices
            lam[i] /= total
            least = min(least, lam[i])
        point = _mixed(w, lam)
        if least >= 0.0 and _dot(point, point) < best:
            best = _dot(point, point)
            for i in range(4):
                best_lam[i] = lam[i]
    for i in range(4):
        lam[i] = 0.0
    return best


@jit
def _nearest_on_simplex(w, n, lam, best_lam):
    """Squared distance from the origin to the hull of the first n points, its weights left in
    ``best_lam``.

    Tries every corner, edge, face and the inside in turn, and believes none of them: what counts is
    the length of the combination that the weights name.
    """
    best = np.inf
    for i in range(n):
        lam[i] = 1.0
        best = _offer(w, lam, best_lam, best)
        for j in range(i + 1, n):
            edge = _along(w[j], -1.0, w[i])
            lam[i], lam[j] = _dot(w[j], edge), -_dot(w[i], edge)
            best = _offer(w, lam, best_lam, best)
            for k in range(j + 1, n):
                normal = _cross(edge, _along(w[k], -1.0, w[i]))
                lam[i] = _dot(normal, _cross(w[j], w[k]))
                lam[j] = _dot(normal, _cross(w[k], w[i]))
                lam[k] = _dot(normal, _cross(w[i], w[j]))
                best = _offer(w, lam, best_lam, best)
    if n == 4:
        one, other = _cross(w[2], w[3]), _cross(w[0], w[1])
        lam[0], lam[1] = _dot(w[1], one), -_dot(w[0], one)
        lam[2], lam[3] = _dot(w[3], other), -_dot(w[2], other)
        best = _offer(w, lam, best_lam, best)
    return best


@jit
def _bracket(kind, given, margin, axes, centre, half):
    """Certified bounds (low, high) of the distance of solid and cube, as tight as a verdict needs;
    the rows of `axes` are the cube's, in the solid's frame.

    ``high`` is |sum lam_i w_i| for weights >= 0 that add up to 1 and w_i differences of points of
    the two; ``low`` is the width of the slab that separates them. The search ends when they decide
    the verdict.
    """
    w, lam, best_lam = np.zeros((4, 3)), np.zeros(4), np.zeros(4)
    low, high, n = -np.inf, np.inf, 0
    v = 1.0, 0.0, 0.0
    for _ in range(400):
        square = _dot(v, v)
        if square == 0.0:
            return low, high
        corner = centre[0], centre[1], centre[2]
        for axis in axes:
            corner = _along(corner, math.copysign(half, _dot(v, axis)), axis)
        d = -v[0], -v[1], -v[2]
        s = _along(_support(kind, given, d), -1.0, corner)
        low = max(low, _dot(v, s) / math.sqrt(square) - margin)
        if low >= FAR or (low >= NEAR and high <= FAR):
            return low, high
        if kind == CYLINDER:
            # All along the side that faces the cube points are nearly as far; one at an end, metres
            # away, would bring the search forward by less than rounding.
            x, y = _rim(given[0, 0], d)
            z = min(max(centre[2], -given[0, 1]), given[0, 1])
            beside = _along((x, y, z), -1.0, corner)
            if square - _dot(v, beside) > 0.5 * (square - _dot(v, s)):
                s = beside
        w[n, 0], w[n, 1], w[n, 2] = s
        high = min(high, math.sqrt(_nearest_on_simplex(w, n + 1, lam, best_lam)) - margin)
        if high <= NEAR:
            return low, high
        n = 0
        for i in range(4):
            weight, best_lam[i] = best_lam[i], 0.0
            if weight > 0.0:
                w[n, 0], w[n, 1], w[n, 2] = w[i]
                best_lam[n] = weight
                n += 1
        if n == 4:
            return low, high
        v = _mixed(w, best_lam)
    return low, high


@jit
def _verdict(low, high):
    if high <= NEAR:
        return OCCUPIED
    if low >= FAR:
        return FREE
    if low >= NEAR and high <= FAR:
        return EITHER
    return UNDECIDED


@jit
def _verdicts(kind, given, margin, axes, centres, half):
    """The verdict on the cube around each of the centres (n, 3), against one solid."""
    found = np.empty(len(centres), np.uint8)
    for n in range(len(centres)):
        found[n] = _verdict(*_bracket(kind, given, margin, axes, centres[n], half))
    return found


def _core(shape):
    """What the search takes of a primitive."""
    kind = KINDS.index(shape.kind)
    margin = shape.size[0] if kind in (SPHERE, CAPSULE) else 0.0
    return kind, np.array([shape.size], float), margin


def judge(shape, grid_shape, voxel, origin):
    """The verdict on one primitive, for every voxel of a map, and which voxels lie near its
    surface.

    A voxel is off the boundary when all its corners are inside (the solid is convex), or its centre
    is farther away than a corner of it is; only boundary voxels need the search.
    """
    half = voxel / 2
    corners = origin + np.moveaxis(np.indices(np.add(grid_shape, 1)), 0, -1) * voxel
    inside = points_inside(shape, corners)
    deep = np.lib.stride_tricks.sliding_window_view(inside, (2, 2, 2)).all(axis=(3, 4, 5))
    centres = voxel_centres(grid_shape, voxel, origin)
    away = at_least(shape, centres)
    boundary = ~deep & (away <= math.sqrt(3.0) * half + FAR)
    verdict = np.where(deep, OCCUPIED, FREE).astype(np.uint8)
    if shape.kind == "plane":
        lows = away[boundary] - half * np.abs(shape.rot[:, 2]).sum()
        verdict[boundary] = [_verdict(low, max(low, 0.0)) for low in lows]
    else:
        local = (centres[boundary] - shape.pos) @ shape.rot
        verdict[boundary] = _verdicts(*_core(shape), shape.rot, local, half)
    return verdict, boundary


def support_point(shape, direction):
    """The point of a primitive (margin included; no half-space) farthest along a unit direction."""
    kind, given, margin = _core(shape)
    core = _support(kind, given, tuple(direction @ shape.rot))
    return shape.pos + shape.rot @ core + margin * direction


def voxel_centres(grid_shape, voxel, origin):
    """The centres of the voxels, (nx, ny, nz, 3)."""
    return origin + (np.moveaxis(np.indices(grid_shape), 0, -1) + 0.5) * voxel


# ------------------------------------------------------------------------------------------
# Unions of convex pieces: meshes and height fields
# ------------------------------------------------------------------------------------------


def judge_hulls(hulls, grid_shape, voxel, origin):
    """The verdict on a union of convex hulls of equally many points, (n, points, 3) in the
    world."""
    verdict, hulls = np.full(grid_shape, FREE, np.uint8), np.ascontiguousarray(hulls)
    centres = voxel_centres(grid_shape, voxel, origin)
    # the voxels that its bounding box meets, and one more all around
    first = np.floor((hulls.min(axis=1) - origin) / voxel).astype(int) - 1
    end = np.floor((hulls.max(axis=1) - origin) / voxel).astype(int) + 2
    for hull, low, high in zip(hulls, first.clip(0), end.clip(0), strict=True):
        part = tuple(map(slice, low, high))
        # in one order, or it is compiled thrice
        inner = np.ascontiguousarray(centres[part]).reshape(-1, 3)
        verdicts = _verdicts(HULL, hull, 0.0, np.eye(3), inner, voxel / 2)
        verdict[part] = np.maximum(verdict[part], verdicts.reshape(verdict[part].shape))
    return verdict


def winding_number(triangles, points):
    """How often a closed surface (f, 3, 3) winds around each point (n, 3): the sum of solid
    angles."""
    total = np.zeros(len(points))
    for first in range(0, len(points), 200):
        corners = triangles[:, :, None] - points[first : first + 200]
        a, b, c = (corners[:, n].transpose(2, 0, 1) for n in range(3))
        la, lb, lc = (np.sqrt(_dot.py_func(v, v)) for v in (a, b, c))
        volume = _dot.py_func(a, _cross.py_func(b, c))
        ab, bc, ca = _dot.py_func(a, b), _dot.py_func(b, c), _dot.py_func(c, a)
        angles = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
        total[first : first + 200] = angles.sum(axis=0)
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
