"""A second opinion on stored ranges: the rays of a sample, cast anew without MuJoCo."""

import math

import numpy as np
from numpy.typing import NDArray

from lidarsim import Lidar
from scenegen.truth import Solids
from scenegen.verify.intersect import cast

TOLERANCE_M = 5e-6
"""How far a stored range may be from ours: float32 rounds ranges below 16 m by 4.8e-7 m, and MuJoCo keeps meshes and
height fields in float32."""
GRAZING_M = 1e-5
"""A ray that passes an edge, or touches a surface, within this may go either way."""
MOST_PAIRS = 2_000_000_000
"""Rays times solids that are tried for one sample; of more, a random part of the rays is audited."""


def ray_directions(lidar: Lidar, quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors (rows, columns, 3) in the world, written from docs/sensor.md and not from `lidarsim`."""
    vertical, horizontal = math.radians(lidar.vertical_fov_deg), math.radians(lidar.horizontal_fov_deg)
    gaps = lidar.columns if lidar.horizontal_fov_deg >= 360.0 else lidar.columns - 1
    r, c = np.arange(lidar.rows), np.arange(lidar.columns)
    e = -vertical / 2 + vertical * r / max(lidar.rows - 1, 1) if lidar.rows > 1 else np.zeros(1)
    a = -horizontal / 2 + horizontal * c / max(gaps, 1) if lidar.columns > 1 else np.zeros(1)
    pitch = math.radians(lidar.pitch_deg)
    if lidar.mount == "band":
        e, pitch = e - pitch, 0.0
    e, a = e[:, None], a[None, :]
    x, y, z = np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e) + 0.0 * a
    x, z = x * math.cos(pitch) + z * math.sin(pitch), -x * math.sin(pitch) + z * math.cos(pitch)
    w, u = quaternion[0], quaternion[1:]
    v = np.stack([x, y, z], axis=-1)
    twice = 2.0 * np.cross(u, v)
    return np.asarray(v + w * twice + np.cross(u, twice))


def audit(
    ranges: NDArray[np.float32],
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    solids: Solids,
    lidar: Lidar,
    *,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Cast the rays of one sample anew: (rays,), numbers in C order; (rays,), the ranges found, metres, inf where
    none; (rays,), how far the stored ones are from them; (rays,), whether a ray that differs only grazes something:
    one of four rays around it, `GRAZING_M` away at its end, finds what is stored."""
    directions = ray_directions(lidar, quaternion).reshape(-1, 3)
    chosen = np.arange(len(directions))
    most = max(MOST_PAIRS // max(len(solids.shape) + len(solids.triangles), 1), 100)
    if len(chosen) > most:
        chosen = np.sort(rng.choice(chosen, most, replace=False))
    stored = ranges.reshape(-1)[chosen].astype(np.float64)
    found = cast(position, directions[chosen], solids, lidar.max_range_m)
    differing = np.flatnonzero(_gap(stored, found, lidar.max_range_m) > TOLERANCE_M)
    grazing = np.zeros(len(chosen), dtype=np.bool_)
    if len(differing):
        across = np.cross(directions[chosen[differing]], [[0.0, 0.0, 1.0]])
        steep = (across**2).sum(axis=1) < 1e-12
        across[steep] = [1.0, 0.0, 0.0]
        across /= np.sqrt((across**2).sum(axis=1, keepdims=True))
        along = np.cross(across, directions[chosen[differing]])
        reach = np.minimum(stored[differing], lidar.max_range_m)[:, None]
        for step in (across, -across, along, -along):
            near = directions[chosen[differing]] + step * (GRAZING_M / np.maximum(reach, GRAZING_M))
            again = cast(position, near, solids, lidar.max_range_m)
            # the nearby ray meets a slanted surface a little before or after
            grazing[differing] |= _gap(stored[differing], again, lidar.max_range_m) <= 100 * GRAZING_M
    return chosen, found, _gap(stored, found, lidar.max_range_m), grazing


def _gap(stored: NDArray[np.float64], found: NDArray[np.float64], max_range_m: float) -> NDArray[np.float64]:
    """Metres between two ranges of a ray; nothing returned counts as a return from the end of the sensor's range."""
    return np.abs(np.minimum(stored, max_range_m) - np.minimum(found, max_range_m))
