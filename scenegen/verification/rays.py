"""Independent check of stored ranges: rays cast again by another engine, and bounds of noisy
returns."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from lidarsim import GridSpec, Lidar, Sensor
from lidarsim.engines import Caster, EngineFactory
from lidarsim.engines.voxels import MIN_CHORD_M, OCCUPIED, VoxelMap
from lidarsim.grid import Field, Floats, Ints, Mask
from scenegen.worlds.world import World

SLACK_M = 2e-6
"""Addition to bounds for float32 ranges and for the tolerance of `occupancy`, metres."""
MAX_CROSSINGS = 200_000
"""Maximum number of crossings along one axis that are computed at once."""
TOLERANCE_M = 1e-6
"""Tolerance of a stored range, metres. One part in 2^23, the resolution of float32, is added."""
MAX_TIMES = 32
"""Maximum number of times of which the rays of a scan are audited."""
MAX_PAIRS = 2_000_000_000
"""Maximum number of ray-solid pairs of a sample. Beyond it, a random part of the rays is audited.
"""


def count_strays(
    points: Floats,
    occupancy: Mask,
    grid: GridSpec,
    origin: Floats,
    bound_m: float,
) -> int:
    """Count returns that are too far from all occupied voxels. Returns near the map's faces are
    ignored: a solid may be outside.

    Args:
        points: Returns (M, 3) in the world's frame, metres.
        occupancy: Occupied voxels of the map.
        grid: The grid.
        origin: Lower corner of the map in the world's frame, metres.
        bound_m: Allowed distance.
    """
    inside, max_m, voxel = points - origin, bound_m + SLACK_M, grid.voxel_m
    extent = np.array(grid.shape) * voxel
    remaining = inside[((inside >= max_m) & (inside <= extent - max_m)).all(axis=1)]
    shape = np.array(grid.shape)
    shells = range(math.ceil(min(max_m / voxel, max(grid.shape))) + 1)
    # nearest voxels first: after a few, hardly any points remain
    for offset in itertools.chain.from_iterable(map(_shell, shells)):
        if not len(remaining):
            break
        cells = np.floor(remaining / voxel).astype(np.int64) + offset
        in_map = ((cells >= 0) & (cells < shape)).all(axis=1)
        gaps = np.maximum(
            np.maximum(cells * voxel - remaining, remaining - (cells + 1) * voxel), 0.0
        )
        near = in_map & ((gaps**2).sum(axis=1) <= max_m * max_m)
        # only cells inside the map are looked up
        near[near] = occupancy[tuple(cells[near].T)]
        remaining = remaining[~near]
    return len(remaining)


def _shell(reach: int) -> Ints:
    """Cell offsets (n, 3) with maximum norm `reach`."""
    cells = np.indices((2 * reach + 1,) * 3).reshape(3, -1).T - reach
    return np.asarray(cells[np.abs(cells).max(axis=1) == reach])


class MapAuditor:
    """Casts rays through a voxel map with another algorithm than `lidarsim.engines.voxels`: all
    crossings of a ray with planes between voxels are computed and sorted. The midpoint of two
    crossings determines the voxel."""

    def __init__(self, voxels: VoxelMap):
        self._voxels = voxels

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """Cast rays; see `lidarsim.engines.Caster.cast`.

        Returns:
            Ranges in metres; inf for no hit.
        """
        pairs = zip(np.asarray(origins), np.asarray(directions), strict=True)
        return np.stack([self._from(start, rays, max_range_m) for start, rays in pairs])

    def _from(self, start: Floats, rays: Floats, max_range_m: float) -> Floats:
        states, voxel_m = self._voxels.states, self._voxels.voxel_m
        begin = (start - self._voxels.origin) / voxel_m
        reach, fraction = math.ceil(max_range_m / voxel_m) + 2, begin % 1
        ranges = np.full(len(rays), np.inf)
        # bounds the memory of a batch
        batch = max(MAX_CROSSINGS // reach, 1)
        for first in range(0, len(rays), batch):
            batch_rays = rays[first : first + batch] / voxel_m  # voxels a metre
            # the first plane ahead depends on the ray's sign along the axis; then one plane a voxel
            planes = np.where(batch_rays > 0, -fraction, fraction - 1)[..., None] + np.arange(reach)
            with np.errstate(divide="ignore", invalid="ignore"):
                crossings = (planes / np.abs(batch_rays)[..., None]).reshape(len(batch_rays), -1)
            # crossings behind the sensor, and planes parallel to a ray, are clipped away
            sorted_crossings = np.sort(np.clip(np.nan_to_num(crossings), 0, 2 * reach * voxel_m))
            middle, chords = (
                (sorted_crossings[:, 1:] + sorted_crossings[:, :-1]) / 2,
                np.diff(sorted_crossings),
            )
            cells = np.floor(begin + middle[..., None] * batch_rays[:, None]).astype(np.int64)
            hits: Any = ((cells >= 0) & (cells < states.shape)).all(axis=2)
            # space outside the map is free
            hits[hits] = states[tuple(cells[hits].T)] == OCCUPIED
            # a shorter chord only touches a voxel's edge, which the engine ignores, too
            hits &= (chords >= MIN_CHORD_M) & (middle <= max_range_m)
            has_hit = hits.any(axis=1)
            ranges[first : first + batch][has_hit] = middle[has_hit, hits[has_hit].argmax(axis=1)]
        return ranges


class MovingAuditor:
    """Casts rays in a world with movers, each at its time: movers become mocap bodies of the
    world's MuJoCo model, which are set anew for every time."""

    def __init__(self, world: World, factory: EngineFactory, times_s: Floats):
        """Compile the world with its movers.

        Args:
            world: The world.
            factory: Makes the engine that casts rays.
            times_s: (n,): when each ray is cast, seconds.
        """
        assert world.movers is not None
        self._factory, self._times_s, self._movers = factory, times_s, world.movers
        spec = mujoco.MjSpec.from_string(world.mjcf.decode(), assets=dict(world.assets))
        self._movers.add_to(spec, 0.0)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """Cast rays; see `lidarsim.engines.Caster.cast`.

        Args:
            origins: As there, of one pose.
            directions: (1, n, 3), as there.
            max_range_m: As there.

        Returns:
            Ranges (1, n) in metres; inf for no hit.
        """
        rays = np.asarray(directions)
        ranges = np.empty(rays.shape[:2])
        for time_s in np.unique(self._times_s):
            chosen = self._times_s == time_s
            self._place(float(time_s))
            engine = self._factory(self._model, self._data)
            ranges[:, chosen] = engine.cast(origins, rays[:, chosen], max_range_m)
        return ranges

    def _place(self, time_s: float) -> None:
        """Set all movers to where they are at a time, by code of its own."""
        movers = self._movers
        since = time_s % movers.period_s
        for m in range(len(movers)):
            own = slice(*movers.piece_start[m : m + 2])
            n = own.start + np.searchsorted(movers.begin_s[own], since, side="right") - 1
            x, y, z, ahead, left = (
                np.polyval(channel[::-1], since - movers.begin_s[n]) for channel in movers.course[n]
            )
            half = math.atan2(left, ahead) / 2
            self._data.mocap_pos[m] = x, y, z
            self._data.mocap_quat[m] = math.cos(half), 0.0, 0.0, math.sin(half)
        mujoco.mj_kinematics(self._model, self._data)
        # moves the bodies' bounding volumes, too, by which MuJoCo's rays pass bodies by
        mujoco.mj_comPos(self._model, self._data)


def ray_directions(lidar: Sensor, quaternion: Floats) -> Floats:
    """Directions of a sensor's rays in the world.

    Those of a raster are computed from docs/sensor.md, independently of `lidarsim`. A table of rays
    is taken as it is.

    Args:
        lidar: The sensor.
        quaternion: Attitude of the body, w x y z.

    Returns:
        Unit vectors (*lidar.shape, 3).
    """
    body = _raster(lidar) if isinstance(lidar, Lidar) else lidar.directions_body
    w, u = quaternion[0], quaternion[1:]
    # rotation by a unit quaternion (w, u): v + 2w (u x v) + 2u x (u x v)
    twice = 2.0 * np.cross(u, body)
    return np.asarray(body + w * twice + np.cross(u, twice))


def _raster(lidar: Lidar) -> Floats:
    """Unit vectors (rows, columns, 3) in the body's frame."""
    rows = _angles(lidar.rows, lidar.vertical_fov_deg, full_turn=False)[:, None]
    a = _angles(
        lidar.columns, lidar.horizontal_fov_deg, full_turn=lidar.horizontal_fov_deg == 360.0
    )[None, :]
    pitch = math.radians(lidar.pitch_deg)
    e, tilt = (rows, pitch) if lidar.mount == "tilt" else (rows - pitch, 0.0)
    x, y, z = np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e) + 0.0 * a
    # R_y takes x to (cos, 0, -sin)
    return np.stack(
        [x * math.cos(tilt) + z * math.sin(tilt), y, z * math.cos(tilt) - x * math.sin(tilt)],
        axis=-1,
    )


def _angles(count: int, fov_deg: float, *, full_turn: bool) -> Floats:
    """Angles over the field of view, centred, radians. A full turn omits its end, which equals its
    start."""
    if count == 1:
        return np.zeros(1)
    return np.radians(
        np.arange(count) * fov_deg / (count if full_turn else count - 1) - fov_deg / 2
    )


def audit(
    ranges: Field,
    position: Floats,
    quaternion: Floats,
    engine_of: Callable[[Ints], Caster],
    lidar: Sensor,
    *,
    solids: int,
    rng: np.random.Generator,
    times_s: Floats | None = None,
) -> tuple[Ints, Floats, Floats]:
    """Cast the rays of a sample again.

    Args:
        ranges: Stored ranges, metres.
        position: Position of the sensor in the world, metres.
        quaternion: Attitude of the body, w x y z.
        engine_of: Returns the engine of the sample's world for rays of these numbers (n,).
        lidar: The sensor.
        solids: Number of solids of the world, which limits the number of rays.
        rng: Chooses the rays if not all are cast.
        times_s: When each ray is cast (*lidar.shape), seconds, in a world with movers. Rays of
            `MAX_TIMES` of these times are cast, as each takes a world of its own.

    Returns:
        Ray numbers in C order (n,); new ranges (n,), metres, inf for no hit; their distances from
            the stored ranges (n,), metres, where no return counts as the maximum range.
    """
    directions = ray_directions(lidar, quaternion).reshape(-1, 3)
    chosen = np.arange(len(directions))
    if times_s is not None and len(times := np.unique(times_s)) > MAX_TIMES:
        some = rng.choice(times, MAX_TIMES, replace=False)
        chosen = np.flatnonzero(np.isin(times_s.reshape(-1), some))
    max_rays = max(MAX_PAIRS // max(solids, 1), 100)
    if len(chosen) > max_rays:
        chosen = np.sort(rng.choice(chosen, max_rays, replace=False))
    cast_ranges = engine_of(chosen).cast(
        position[None], directions[None, chosen], lidar.max_range_m
    )[0]
    stored = np.minimum(ranges.reshape(-1)[chosen].astype(np.float64), lidar.max_range_m)
    return chosen, cast_ranges, np.abs(stored - np.minimum(cast_ranges, lidar.max_range_m))


def disagrees(gap: Floats, audited: Floats, max_range_m: float) -> Mask:
    """Where ranges differ by more than rounding.

    Args:
        gap: Differences, metres.
        audited: Ranges of the audit, metres.
        max_range_m: Range of the sensor, metres.

    Returns:
        Mask; True also for NaN.
    """
    # negated, so that NaN counts as a difference
    return ~(gap <= TOLERANCE_M + np.minimum(audited, max_range_m) / 2**23)
