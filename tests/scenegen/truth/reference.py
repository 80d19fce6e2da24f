"""An occupancy oracle that shares neither code nor method with ``scenegen.truth``.

Every verdict on a voxel rests on a certificate, never on how the search that found it behaves:

* *occupied* - two points, one a convex combination of points of the solid and one of corners of the
  cube, lie
  at most ``NEAR`` apart (or a corner of the cube is inside the solid by its defining inequality);
* *free* - a plane keeps the cube and the solid at least ``FAR`` apart (support functions of both);
* *either* - both certificates place the distance inside (``NEAR``, ``FAR``), the band around the
  1e-6 m of
  the contract in which rounding may decide.

The search is GJK (Gilbert, Johnson, Keerthi 1988) on support functions; spheres and capsules are a
point and a segment with a margin. A voxel for which it finds neither certificate is UNDECIDED, and
the tests insist that there is none. Non-convex things are unions: a triangle mesh is its triangles,
plus the voxel centres whose winding number (solid angles after Van Oosterom and Strackee 1983) is
not zero; a height field is one prism per triangle of MuJoCo's own triangulation.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

NEAR = 0.5e-6
FAR = 3e-6

FREE, OCCUPIED, EITHER, UNDECIDED = 0, 1, 2, 3

SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, PLANE, HULL = range(7)
KINDS = {
    "sphere": SPHERE,
    "capsule": CAPSULE,
    "ellipsoid": ELLIPSOID,
    "cylinder": CYLINDER,
    "box": BOX,
    "plane": PLANE,
}

Floats = NDArray[np.float64]
_NO_HULL = np.zeros((1, 3))


def rotation(quat):
    """The matrix of a quaternion w, x, y, z (normalised here), from its textbook expansion."""
    w, x, y, z = np.asarray(quat, float) / np.linalg.norm(quat)
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


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


# ------------------------------------------------------------------------------------------
# Support functions, membership and distance bounds of the convex solids
# ------------------------------------------------------------------------------------------


@numba.njit(cache=True, nogil=True)
def _support(kind, size, rot, pos, hull, dx, dy, dz):
    """A point of the solid (of its core, where it has a margin) farthest along d, in the world."""
    if kind == HULL:
        best, top = 0, -np.inf
        for i in range(hull.shape[0]):
            s = hull[i, 0] * dx + hull[i, 1] * dy + hull[i, 2] * dz
            if s > top:
                best, top = i, s
        return hull[best, 0], hull[best, 1], hull[best, 2]
    lx = rot[0, 0] * dx + rot[1, 0] * dy + rot[2, 0] * dz
    ly = rot[0, 1] * dx + rot[1, 1] * dy + rot[2, 1] * dz
    lz = rot[0, 2] * dx + rot[1, 2] * dy + rot[2, 2] * dz
    px, py, pz = 0.0, 0.0, 0.0
    if kind == CAPSULE:
        pz = math.copysign(size[1], lz)
    elif kind == ELLIPSOID:
        a, b, c = size[0] * lx, size[1] * ly, size[2] * lz
        norm = math.sqrt(a * a + b * b + c * c)
        if norm > 0.0:
            px, py, pz = size[0] * a / norm, size[1] * b / norm, size[2] * c / norm
    elif kind == CYLINDER:
        norm = math.sqrt(lx * lx + ly * ly)
        if norm > 0.0:
            px, py = size[0] * lx / norm, size[0] * ly / norm
        pz = math.copysign(size[1], lz)
    elif kind == BOX:
        px = math.copysign(size[0], lx)
        py = math.copysign(size[1], ly)
        pz = math.copysign(size[2], lz)
    return (
        pos[0] + rot[0, 0] * px + rot[0, 1] * py + rot[0, 2] * pz,
        pos[1] + rot[1, 0] * px + rot[1, 1] * py + rot[1, 2] * pz,
        pos[2] + rot[2, 0] * px + rot[2, 1] * py + rot[2, 2] * pz,
    )


@numba.njit(cache=True, nogil=True)
def _beside(size, rot, pos, dx, dy, dz, cx, cy, cz):
    """The point of a cylinder's side that is farthest along d, at the height of the world point
    c."""
    x, y, z = cx - pos[0], cy - pos[1], cz - pos[2]
    height = min(max(rot[0, 2] * x + rot[1, 2] * y + rot[2, 2] * z, -size[1]), size[1])
    lx = rot[0, 0] * dx + rot[1, 0] * dy + rot[2, 0] * dz
    ly = rot[0, 1] * dx + rot[1, 1] * dy + rot[2, 1] * dz
    norm = math.sqrt(lx * lx + ly * ly)
    px, py = 0.0, 0.0
    if norm > 0.0:
        px, py = size[0] * lx / norm, size[0] * ly / norm
    return (
        pos[0] + rot[0, 0] * px + rot[0, 1] * py + rot[0, 2] * height,
        pos[1] + rot[1, 0] * px + rot[1, 1] * py + rot[1, 2] * height,
        pos[2] + rot[2, 0] * px + rot[2, 1] * py + rot[2, 2] * height,
    )


def at_least(shape, points):
    """A lower bound of the distance from world points (..., 3) to a primitive, not above 0 where
    they satisfy the inequality that defines it.

    Exact for all but the ellipsoid, for which the gauge G is convex, so that G(y) >= G(x) + dG(x)(y
    - x) puts the surface G = 1 at least (G(x) - 1) / |dG(x)| away.
    """
    local = (points - shape.pos) @ shape.rot
    if shape.kind == "plane":
        return local[..., 2]
    local, size = np.abs(local), np.array(shape.size)
    side = np.hypot(local[..., 0], local[..., 1])
    match shape.kind:
        case "sphere":
            return np.linalg.norm(local, axis=-1) - size[0]
        case "capsule":
            return np.hypot(side, np.maximum(local[..., 2] - size[1], 0)) - size[0]
        case "cylinder":
            over = np.maximum(local[..., 2] - size[1], 0)
            return np.hypot(np.maximum(side - size[0], 0), over)
    bound = np.linalg.norm(np.maximum(local - size, 0), axis=-1)
    if shape.kind == "ellipsoid":
        scaled = local / size
        gauge = np.linalg.norm(scaled, axis=-1)
        slope = np.linalg.norm(scaled / size, axis=-1) / np.maximum(gauge, 1)
        bound = np.maximum(bound, np.where(gauge > 1, (gauge - 1) / np.maximum(slope, 1e-9), 0))
    return bound


def points_inside(shape, points):
    """Whether world points (..., 3) satisfy the inequality that defines a primitive."""
    return at_least(shape, points) <= 0


# ------------------------------------------------------------------------------------------
# GJK: the search for certificates
# ------------------------------------------------------------------------------------------


@numba.njit(cache=True, nogil=True)
def _dot(w, i, j):
    return w[i, 0] * w[j, 0] + w[i, 1] * w[j, 1] + w[i, 2] * w[j, 2]


@numba.njit(cache=True, nogil=True)
def _offer(w, lam, best_lam, best):
    """Keep the weights ``lam`` if they name a point of the simplex nearer to the origin than the
    best."""
    x = lam[0] * w[0, 0] + lam[1] * w[1, 0] + lam[2] * w[2, 0] + lam[3] * w[3, 0]
    y = lam[0] * w[0, 1] + lam[1] * w[1, 1] + lam[2] * w[2, 1] + lam[3] * w[3, 1]
    z = lam[0] * w[0, 2] + lam[1] * w[1, 2] + lam[2] * w[2, 2] + lam[3] * w[3, 2]
    n = x * x + y * y + z * z
    if n < best:
        best = n
        for i in range(4):
            best_lam[i] = lam[i]
    return best


@numba.njit(cache=True, nogil=True)
def _triple(w, i, j, nx, ny, nz):
    """n . (w_i x w_j)"""
    return (
        nx * (w[i, 1] * w[j, 2] - w[i, 2] * w[j, 1])
        + ny * (w[i, 2] * w[j, 0] - w[i, 0] * w[j, 2])
        + nz * (w[i, 0] * w[j, 1] - w[i, 1] * w[j, 0])
    )


@numba.njit(cache=True, nogil=True)
def _nearest_on_simplex(w, n, lam, best_lam):
    """Squared distance from the origin to the hull of the first n points, its weights left in
    ``best_lam``.

    Tries every corner, edge, face and the inside in turn, and believes none of them: what counts is
    the length of the combination that the weights name.
    """
    best = np.inf
    for i in range(n):
        lam[:] = 0.0
        lam[i] = 1.0
        best = _offer(w, lam, best_lam, best)
        for j in range(i + 1, n):
            ii, ij, jj = _dot(w, i, i), _dot(w, i, j), _dot(w, j, j)
            length = ii - 2.0 * ij + jj
            if length > 0.0 and 0.0 < ii - ij < length:
                t = (ii - ij) / length
                lam[:] = 0.0
                lam[i], lam[j] = 1.0 - t, t
                best = _offer(w, lam, best_lam, best)
            for k in range(j + 1, n):
                ax, ay, az = w[j, 0] - w[i, 0], w[j, 1] - w[i, 1], w[j, 2] - w[i, 2]
                bx, by, bz = w[k, 0] - w[i, 0], w[k, 1] - w[i, 1], w[k, 2] - w[i, 2]
                nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                li = _triple(w, j, k, nx, ny, nz)
                lj = _triple(w, k, i, nx, ny, nz)
                lk = _triple(w, i, j, nx, ny, nz)
                total = li + lj + lk
                if total > 0.0 and li >= 0.0 and lj >= 0.0 and lk >= 0.0:
                    lam[:] = 0.0
                    lam[i], lam[j], lam[k] = li / total, lj / total, lk / total
                    best = _offer(w, lam, best_lam, best)
    if n == 4:
        a = _triple(w, 2, 3, w[1, 0], w[1, 1], w[1, 2])
        b = -_triple(w, 2, 3, w[0, 0], w[0, 1], w[0, 2])
        c = _triple(w, 1, 3, w[0, 0], w[0, 1], w[0, 2])
        d = -_triple(w, 1, 2, w[0, 0], w[0, 1], w[0, 2])
        total = a + b + c + d
        if total < 0.0:
            a, b, c, d, total = -a, -b, -c, -d, -total
        if total > 0.0 and a >= 0.0 and b >= 0.0 and c >= 0.0 and d >= 0.0:
            lam[0], lam[1], lam[2], lam[3] = a / total, b / total, c / total, d / total
            best = _offer(w, lam, best_lam, best)
    return best


@numba.njit(cache=True, nogil=True)
def _bracket(kind, size, rot, pos, hull, margin, cx, cy, cz, half):
    """Certified bounds (low, high) of the distance of solid and cube, as tight as a verdict needs.

    ``high`` is |sum lam_i w_i| for weights >= 0 that add up to 1 and w_i differences of points of
    the two; ``low`` is the width of the slab that separates them. The search ends when they decide
    the verdict.
    """
    w, lam, best_lam = np.zeros((4, 3)), np.zeros(4), np.zeros(4)
    low, high = -np.inf, np.inf
    vx, vy, vz = pos[0] - cx, pos[1] - cy, pos[2] - cz
    if kind == HULL:
        vx, vy, vz = hull[0, 0] - cx, hull[0, 1] - cy, hull[0, 2] - cz
    if vx == 0.0 and vy == 0.0 and vz == 0.0:
        vx = 1.0
    n = 0
    for _ in range(400):
        sx, sy, sz = _support(kind, size, rot, pos, hull, -vx, -vy, -vz)
        ox, oy = cx + math.copysign(half, vx), cy + math.copysign(half, vy)
        oz = cz + math.copysign(half, vz)
        sx, sy, sz = sx - ox, sy - oy, sz - oz
        norm = math.sqrt(vx * vx + vy * vy + vz * vz)
        low = max(low, (vx * sx + vy * sy + vz * sz) / norm - margin)
        if low >= FAR or (low >= NEAR and high <= FAR):
            return low, high
        if kind == CYLINDER:
            # All along the side that faces the cube points are nearly as far; one at an end, metres
            # away, would bring the search forward by less than rounding.
            bx, by, bz = _beside(size, rot, pos, -vx, -vy, -vz, cx, cy, cz)
            bx, by, bz = bx - ox, by - oy, bz - oz
            most = norm * norm - (vx * sx + vy * sy + vz * sz)
            if norm * norm - (vx * bx + vy * by + vz * bz) > 0.5 * most:
                sx, sy, sz = bx, by, bz
        for i in range(n):
            if w[i, 0] == sx and w[i, 1] == sy and w[i, 2] == sz:
                return low, high
        w[n, 0], w[n, 1], w[n, 2] = sx, sy, sz
        n += 1
        square = _nearest_on_simplex(w, n, lam, best_lam)
        kept = 0
        for i in range(n):
            if best_lam[i] > 0.0:
                w[kept, 0], w[kept, 1], w[kept, 2] = w[i, 0], w[i, 1], w[i, 2]
                best_lam[kept] = best_lam[i]
                kept += 1
        for i in range(kept, 4):
            w[i, 0] = w[i, 1] = w[i, 2] = 0.0
        high = min(high, math.sqrt(square) - margin)
        if high <= NEAR or kept == 4:
            return low, high
        n = kept
        vx = vy = vz = 0.0
        for i in range(n):
            vx += best_lam[i] * w[i, 0]
            vy += best_lam[i] * w[i, 1]
            vz += best_lam[i] * w[i, 2]
        if vx == 0.0 and vy == 0.0 and vz == 0.0:
            return low, high
    return low, high


@numba.njit(cache=True, nogil=True)
def _verdict(low, high):
    if high <= NEAR:
        return OCCUPIED
    if low >= FAR:
        return FREE
    if low >= NEAR and high <= FAR:
        return EITHER
    return UNDECIDED


@numba.njit(cache=True, nogil=True)
def _verdicts(kind, size, rot, pos, hull, margin, centres, half):
    """The verdict on the cube around each of the centres (n, 3), against one primitive."""
    found = np.empty(len(centres), np.uint8)
    for n in range(len(centres)):
        x, y, z = centres[n]
        low, high = _bracket(kind, size, rot, pos, hull, margin, x, y, z, half)
        found[n] = _verdict(low, high)
    return found


@dataclass(frozen=True)
class Judged:
    """A verdict for every voxel of a map, and which voxels lie near the surface."""

    verdict: NDArray[np.uint8]
    boundary: NDArray[np.bool_]

    @property
    def undecided(self):
        return int((self.verdict == UNDECIDED).sum())


def disagreements(answer, truth):
    """The indices of the voxels at which an occupancy map contradicts the reference."""
    if answer.shape != truth.verdict.shape or answer.dtype != np.bool_:
        raise AssertionError(
            f"not an occupancy map of {truth.verdict.shape}: {answer.dtype}{answer.shape}"
        )
    wrong = (answer & (truth.verdict == FREE)) | (~answer & (truth.verdict == OCCUPIED))
    return np.argwhere(wrong)


def _core(shape):
    kind = KINDS[shape.kind]
    return kind, (shape.size[0] if kind in (SPHERE, CAPSULE) else 0.0)


def judge(shape, grid_shape, voxel, origin):
    """The truth about one primitive, for every voxel of a map.

    A voxel is off the boundary when all its corners are inside (the solid is convex), or its centre
    is farther away than a corner of it is; only boundary voxels need the search.
    """
    kind, margin = _core(shape)
    size, pos, half = np.asarray(shape.size, float), np.asarray(shape.pos, float), voxel / 2
    corners = origin + np.moveaxis(np.indices(np.add(grid_shape, 1)), 0, -1) * voxel
    inside = points_inside(shape, corners)
    deep = np.lib.stride_tricks.sliding_window_view(inside, (2, 2, 2)).all(axis=(3, 4, 5))
    centres = voxel_centres(grid_shape, voxel, origin)
    away = at_least(shape, centres)
    boundary = ~deep & (away <= math.sqrt(3.0) * half + FAR)
    verdict = np.where(deep, OCCUPIED, FREE).astype(np.uint8)
    if kind == PLANE:
        lows = away[boundary] - half * np.abs(shape.rot[:, 2]).sum()
        verdict[boundary] = [_verdict(low, max(low, 0.0)) for low in lows]
    else:
        given = kind, size, shape.rot, pos, _NO_HULL, margin
        verdict[boundary] = _verdicts(*given, centres[boundary], half)
    return Judged(verdict, boundary)


def support_point(shape, direction):
    """The point of a primitive (margin included) farthest along a unit direction."""
    kind, margin = _core(shape)
    if kind == PLANE:
        raise ValueError("a half-space has a support point along its normal only")
    d = np.asarray(direction, float)
    size, pos = np.asarray(shape.size, float), np.asarray(shape.pos, float)
    core = _support(kind, size, shape.rot, pos, _NO_HULL, float(d[0]), float(d[1]), float(d[2]))
    return np.array(core) + margin * d


def voxel_centres(grid_shape, voxel, origin):
    """The centres of the voxels, (nx, ny, nz, 3)."""
    axes = [
        o + (np.arange(n) + 0.5) * voxel
        for o, n in zip(np.asarray(origin, float), grid_shape, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


# ------------------------------------------------------------------------------------------
# Unions of convex pieces: meshes and height fields
# ------------------------------------------------------------------------------------------


@numba.njit(cache=True, nogil=True)
def _sweep_hulls(kind, hulls, first, end, voxel, origin, verdict):
    """Judge the voxels from `first` to `end` (n, 3) of each hull (n, points, 3); a hit is final.

    `kind`, HULL, is an argument: for a constant, numba would compile the search once more.
    """
    half, zero, eye = voxel / 2, np.zeros(3), np.eye(3)
    for t in range(len(hulls)):
        for i in range(first[t, 0], end[t, 0]):
            cx = origin[0] + (i + 0.5) * voxel
            for j in range(first[t, 1], end[t, 1]):
                cy = origin[1] + (j + 0.5) * voxel
                for k in range(first[t, 2], end[t, 2]):
                    if verdict[i, j, k] == OCCUPIED:
                        continue
                    cz = origin[2] + (k + 0.5) * voxel
                    low, high = _bracket(kind, zero, eye, zero, hulls[t], 0.0, cx, cy, cz, half)
                    found = _verdict(low, high)
                    if found == OCCUPIED or (found != FREE and verdict[i, j, k] != UNDECIDED):
                        verdict[i, j, k] = found


def judge_hulls(hulls, grid_shape, voxel, origin):
    """The truth about a union of convex hulls of equally many points, (n, points, 3) in the world.

    Every occupied voxel counts as boundary, and so do its neighbours.
    """
    verdict = np.full(grid_shape, FREE, np.uint8)
    hulls, origin = np.ascontiguousarray(hulls, float), np.asarray(origin, float)
    # the voxels that its bounding box meets, and one more all around
    first = np.floor((hulls.min(axis=1) - origin) / voxel).astype(int) - 1
    end = np.floor((hulls.max(axis=1) - origin) / voxel).astype(int) + 2
    first, end = np.maximum(first, 0), np.minimum(end, grid_shape)
    _sweep_hulls(HULL, hulls, first, end, float(voxel), origin, verdict)
    return Judged(verdict, ndimage.binary_dilation(verdict != FREE, np.ones((3, 3, 3))))


def winding_number(triangles, points):
    """How often a closed surface (f, 3, 3) winds around each point (n, 3): the sum of solid
    angles."""
    total = np.zeros(len(points))
    for start in range(0, len(points), 2048):
        a, b, c = (triangles[None, :, i] - points[start : start + 2048, None] for i in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        numerator = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
        denominator = (
            la * lb * lc
            + np.einsum("ijk,ijk->ij", a, b) * lc
            + np.einsum("ijk,ijk->ij", b, c) * la
            + np.einsum("ijk,ijk->ij", c, a) * lb
        )
        total[start : start + 2048] = 2 * np.arctan2(numerator, denominator).sum(axis=1)
    return total / (4 * np.pi)


def judge_mesh(triangles, grid_shape, voxel, origin, *, filled):
    """The truth about a triangle mesh given in the world: its surface, and what it encloses if
    ``filled``.

    A voxel that no triangle touches is inside or outside as a whole: the winding number at its
    centre tells.
    """
    surface = judge_hulls(triangles, grid_shape, voxel, origin)
    if not filled:
        return surface
    clear = surface.verdict != OCCUPIED
    verdict = surface.verdict.copy()
    centres = voxel_centres(grid_shape, voxel, origin)
    corners = triangles.reshape(-1, 3)
    clear &= np.all((centres >= corners.min(axis=0)) & (centres <= corners.max(axis=0)), axis=-1)
    inside = np.abs(winding_number(triangles, centres[clear])) > 0.5
    verdict[clear] = np.where(inside, OCCUPIED, verdict[clear])
    return Judged(verdict, surface.boundary)


def hfield_prisms(heights, size, pos, quat):
    """A height field as prisms (n, 6, 3) in the world, from its surface down to z = -size[3].

    ``heights`` (rows along y, columns along x) are metres above the geom's frame. Each cell is cut
    along the diagonal from its (low x, low y) corner to its (high x, high y) corner;
    ``tests/lidarsim/engines/test_laws.py`` establishes with rays that MuJoCo cuts it there.
    """
    rows, cols = heights.shape
    xs = np.linspace(-size[0], size[0], cols)
    ys = np.linspace(-size[1], size[1], rows)
    prisms = []
    for r in range(rows - 1):
        for c in range(cols - 1):
            low, high = (r, c), (r + 1, c + 1)
            for third in ((r, c + 1), (r + 1, c)):
                top = [(xs[j], ys[i], heights[i, j]) for i, j in (low, high, third)]
                prisms.append(top + [(x, y, -size[3]) for x, y, _ in top])
    return np.asarray(prisms) @ rotation(quat).T + np.asarray(pos, float)
