"""Rays through many worlds at once: one thread a ray, by the closed forms of the analytic engine."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.engines import forms, traverse
from lidarsim.gpu.device import EXACT, on_device, wp
from lidarsim.gpu.translate import translated
from lidarsim.gpu.worlds import Packed, Worlds
from lidarsim.solids.shapes import PLANE

wp.set_module_options(EXACT)
INF = wp.constant(wp.float64(np.inf))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
SPARE = wp.constant(wp.float64(traverse.SPARE_LENGTH2))
ROUNDED = wp.constant(wp.float64(traverse.ROUNDED))
inverse = translated(traverse.inverse)
passes = translated(traverse.passes)
meet_solid = translated(traverse.meet_solid)
meet_plane = translated(forms.meet_plane)
upright = translated(forms.upright)
meet_triangle = translated(forms.meet_triangle)


def cast(
    worlds: Worlds,
    origins: Any,
    directions: Any,
    max_range_m: float,
    *,
    which: ArrayLike | None = None,
) -> Any:
    """Cast rays from poses in worlds of their own.

    Pose p stands at `origins` (P, 3) in world `which` (P,), which is world p unless said otherwise,
    and looks along the unit vectors `directions` (P, R, 3): NumPy's arrays, or Warp's of ``vec3d``,
    (P,) and (P, R). A ray that is no unit vector, or whose origin is not finite, meets nothing.

    Returns:
        Metres along the rays to the first surface, a Warp array (P, R) of float64 on the worlds'
        device; ``inf`` where nothing is met within `max_range_m`.

    Raises:
        ValueError: for arrays of other shapes.
    """
    poses, count = (*np.shape(directions), 0, 0)[:2]
    starts = on_device("origins", origins, wp.vec3d, (poses,), worlds.device)
    rays = on_device("directions", directions, wp.vec3d, (poses, count), worlds.device)
    ranges = wp.empty((poses, count), dtype=wp.float64, device=worlds.device)
    inputs = [worlds.packed, worlds.which(which, poses), starts, rays, float(max_range_m), ranges]
    wp.launch(_cast, dim=ranges.shape, inputs=inputs, device=worlds.device)
    return ranges


@wp.kernel
def _cast(
    packed: Packed,
    which: wp.array[wp.int32],
    origins: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    max_range_m: wp.float64,
    ranges: wp.array2d[wp.float64],
) -> None:
    p, n = wp.tid()
    o, d = origins[p], wp.vec3d(directions[p, n])
    best, met = wp.float64(max_range_m), wp.bool(False)
    box = wp.int32(packed.box_start[which[p]])
    end = wp.int32(packed.box_start[which[p] + 1])
    length2 = wp.dot(d, d)
    if not (wp.abs(length2 - ONE) <= SPARE and wp.abs(o[0]) + wp.abs(o[1]) + wp.abs(o[2]) < INF):
        box = end
    if wp.abs(length2 - ONE) > ROUNDED:
        d /= wp.sqrt(length2)
    steps = wp.vec3d(inverse(d[0]), inverse(d[1]), inverse(d[2]))
    frame = upright(o, d)
    while box < end:
        one = wp.cw_mul(packed.box_lower[box] - o, steps)
        other = wp.cw_mul(packed.box_upper[box] - o, steps)
        near, far = wp.min(one, other), wp.max(one, other)
        begin = wp.max(wp.max(near[0], near[1]), wp.max(near[2], ZERO))
        if begin > wp.min(wp.min(far[0], far[1]), wp.min(far[2], best)):
            box = packed.beyond[box]
            continue
        for q in range(packed.first[box], packed.last[box]):
            g = packed.item[q]
            t = wp.float64(INF)
            if g < 0:
                t = meet_triangle(packed.triangles, -1 - g, frame)
            else:
                t = _meet_primitive(packed, g, o, d)
            if t <= best and t < INF:
                best = t
                met = True
        box += 1
    ranges[p, n] = best if met else INF


@wp.func
def _meet_primitive(packed: Packed, g: wp.int32, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Distance to a primitive of the world."""
    if packed.shape[g] == PLANE:
        place, turn = packed.position[g], packed.rotation[g]
        return meet_plane(packed.size[g], place, turn, o[0], o[1], o[2], d[0], d[1], d[2])
    x = o[0] - packed.position[g, 0]
    y = o[1] - packed.position[g, 1]
    z = o[2] - packed.position[g, 2]
    if passes(packed.reach2[g], x, y, z, d[0], d[1], d[2]):
        return INF
    return meet_solid(g, packed.shape, packed.size, packed.rotation, x, y, z, d[0], d[1], d[2])
