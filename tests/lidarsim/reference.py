"""Independent references for the simulated lidar: layout, ray casting, voxel grids.

Nothing here is imported from, or copied from, the package under test, and nothing here walks a ray
from voxel to voxel. Each reference is the definition written down a second time in the most direct
form that is affordable:

* ray directions: products of scipy rotations (the package's own angle conventions are restated
  here);
* ray casting: every solid is convex, so a line meets it in one interval of distances; the interval
  is found
  by closest approach (ball, infinite cylinder) and slabs (box, flat ends) in the solid's own frame;
* voxels: each voxel is a box and each ray a segment, and the segment's overlap with the box is the
  length of an intersection of three slabs, for every voxel and every ray, in rational arithmetic on
  the exact values of the float64 inputs.
"""

from fractions import Fraction
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

TOUCH_M = 1e-9
"""Overlaps shorter than this, and rays nearer than this to a grid plane, may be answered either
way."""


# ---------------------------------------------------------------------------------------------
# layout


def rotation(quaternion_wxyz):
    """The rotation of a (w, x, y, z) quaternion."""
    return Rotation.from_quat(quaternion_wxyz, scalar_first=True)


def unit(vectors):
    """Unit vectors; along x, where there is no direction."""
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return np.where(length > 0, vectors, [1.0, 0.0, 0.0]) / np.where(length > 0, length, 1.0)


def random_quaternion(rng):
    """A uniformly random attitude as (w, x, y, z): four normal numbers, normalized."""
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def lidar_directions(quaternion, *, rows, columns, vertical_fov_deg, pitch_deg, mount):
    """World directions of a full-circle lidar, from the specification's angles.

    Row r has elevation -fov/2 + r * fov / (rows - 1) and column c has azimuth -180 + c * 360 /
    columns. A tilted sensor is turned nose down by `pitch_deg` about y; a band sensor is level and
    has every elevation lowered by `pitch_deg`.

    A ray is x forward turned twice: up by the elevation, left by the azimuth. A right-handed turn
    about y takes x down, so looking up by e is a turn of -e about y.
    """
    tilt, shift = (pitch_deg, 0.0) if mount == "tilt" else (0.0, pitch_deg)
    elevations = -vertical_fov_deg / 2 + np.arange(rows) * vertical_fov_deg / (rows - 1) - shift
    azimuths = -180.0 + np.arange(columns) * 360.0 / columns
    turns = Rotation.from_euler("yz", [*product(-elevations, azimuths)], degrees=True)
    mounting = Rotation.from_euler("y", tilt, degrees=True)
    world = rotation(quaternion) * mounting * turns
    return world.apply([1.0, 0.0, 0.0]).reshape(rows, columns, 3)


# ----------------------------------------------------------------------------------------- ray
# casting


def _slab(start, along, half):
    """Distances at which a line's coordinate enters and leaves [-half, half]; (inf, -inf) for
    never."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-half - start) / along, (half - start) / along
    near, far = np.minimum(a, b), np.maximum(a, b)
    still = along == 0
    inside = np.abs(start) <= half
    near = np.where(still, np.where(inside, -np.inf, np.inf), near)
    far = np.where(still, np.where(inside, np.inf, -np.inf), far)
    return near, far


def _ball(start, along, radius):
    """Distances at which lines enter and leave a ball (in 3-D) or a disc (in 2-D) about the origin.

    By closest approach: the foot of the centre on the line, and half the chord through it. `along`
    need not be of unit length, distances are in its units; where it is zero the line is a point, in
    or out for ever.
    """
    square = np.sum(along * along, axis=-1)
    still = square == 0
    foot = np.where(still, 0.0, -np.sum(start * along, axis=-1) / np.where(still, 1.0, square))
    miss = start + foot[..., None] * along
    rest = radius**2 - np.sum(miss * miss, axis=-1)
    half = np.sqrt(np.maximum(rest, 0.0) / np.where(still, 1.0, square))
    half = np.where(still, np.inf, half)
    hit = rest >= 0
    return np.where(hit, foot - half, np.inf), np.where(hit, foot + half, -np.inf)


def interval(kind, size, start, along):
    """Distances at which lines of a solid's own frame enter and leave it; (inf, -inf) where they
    miss.

    Sizes are MuJoCo's, or arrays with one for each line.
    """
    if kind in ("sphere", "ellipsoid"):  # a unit ball in the space divided by the half axes
        axes = np.stack(np.broadcast_arrays(*size), axis=-1)
        return _ball(start / axes, along / axes, 1.0)
    if kind == "box":  # three slabs
        pieces = [_slab(start[..., a], along[..., a], size[a]) for a in range(3)]
    else:  # a round wall without end, and one slab
        wall = _ball(start[..., :2], along[..., :2], size[0])
        pieces = [wall, _slab(start[..., 2], along[..., 2], size[1])]
    nears, fars = zip(*pieces, strict=True)
    near, far = np.max(nears, axis=0), np.min(fars, axis=0)
    hit = near <= far
    near, far = np.where(hit, near, np.inf), np.where(hit, far, -np.inf)
    if kind == "capsule":  # convex: from the first to the last distance in this or either ball
        for end in (-size[1], size[1]):
            above = np.stack(np.broadcast_arrays(0.0, 0.0, end), axis=-1)
            ball_near, ball_far = _ball(start - above, along, size[0])
            near, far = np.minimum(near, ball_near), np.maximum(far, ball_far)
    return near, far


# ----------------------------------------------------------------------------------------------
# voxels


def observed(origin, voxel_m, shape, position, directions, ranges32):
    """Voxels holding a return: the specification's floor formula, in float64."""
    out, returned = np.zeros(shape, bool), np.isfinite(ranges32)
    reach = ranges32[returned].astype(np.float64)
    points = position + reach[:, None] * directions[returned]
    index = np.floor((points - origin) / voxel_m)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    out[tuple(index[inside].astype(int).T)] = True
    return out


def passages(origin, voxel_m, shape, position, ray, reach, margin_m=0.0):
    """Each voxel that a segment meets, grown by `margin_m` on every side: its index, and where the
    segment enters and leaves it, in rational arithmetic.

    The float64 inputs are taken at their exact values and the grid's planes lie at origin + k *
    voxel exactly. Voxels are half-open, which decides rays that run within a plane. Distances are
    in units of the direction's length.
    """
    axes = zip(shape, position, ray, origin, strict=True)
    spans = [list(_spans(voxel_m, margin_m, *axis, Fraction(reach))) for axis in axes]
    for (i, a0, a1), (j, b0, b1) in product(*spans[:2]):
        if max(a0, b0) < min(a1, b1):
            for k, c0, c1 in spans[2]:
                first, last = max(a0, b0, c0), min(a1, b1, c1)
                if first < last:
                    yield (i, j, k), first, last


def overlaps(origin, voxel_m, shape, position, directions, reach, margin_m=0.0):
    """The greatest length in which a segment meets each voxel; 0 where none does."""
    out = np.zeros(shape, object)
    for ray, end in zip(directions.reshape(-1, 3), reach.ravel(), strict=True):
        for index, *ends in passages(origin, voxel_m, shape, position, ray, end, margin_m):
            out[index] = max(out[index], ends[1] - ends[0])
    return out


def _spans(voxel_m, margin_m, count, start, along, low, end):
    """Of each voxel along one axis that a segment meets: its number, and where, as fractions."""
    given = (voxel_m, margin_m, start, along, low)
    size, margin, start, along, low = (Fraction(float(x)) for x in given)
    for index in range(count):
        below = low + index * size - start - margin
        above = low + (index + 1) * size - start + margin
        if along == 0:
            first, last = Fraction(0), end if below <= 0 < above else Fraction(0)
        else:
            first, last = sorted((below / along, above / along))
        first, last = max(first, Fraction(0)), min(last, end)
        if first < last:
            yield index, first, last
