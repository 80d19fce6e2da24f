"""Fuses the scans of a log into maps by following every ray, and writes some of the scans with the
map around them as their truth."""

import json
import math
import shutil
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelMap
from lidarsim.grid import Floats, Ints
from lidarsim.pose import rotate
from lidarsim.scan import are_returns
from lidarsim.voxelization import ObservedGrid, sort_points, unknown_grid
from scenegen.base.errors import DatasetError, SceneError
from scenegen.base.executors import Counted, unheard
from scenegen.base.files import (
    check_free,
    disk_errors,
    make_parent,
    remove_temp_files,
    write_atomic,
)
from scenegen.base.limits import MAX_PLACE_VOXELS
from scenegen.base.reading import sha256_of
from scenegen.logs import Fusing, LogScan
from scenegen.logs.log import Log
from scenegen.truth.voxels import resample
from scenegen.worlds.clouds.write import encode_npz
from scenegen.worlds.place import box_of, encode_map
from scenegen.worlds.poses import between, write_tum

THREADS = 2
"""Threads that follow rays, each in a window of the map; the calling thread adds the windows up."""
SLICES = 100
"""Parts of the time from scan to scan: deskewing moves the points of a part as one."""
LATE = 10
"""Scans that are searched for one of another time: a message is late by fewer than so many."""
PROGRESS, SAVE_EVERY_S = "progress.npz", 60.0
"""The file with the state of an unfinished run, and how often it is written, seconds."""
NOTHING = np.empty((2, 0, 0, 0), np.uint8)
"""Counts of an empty map."""
MIN_OVERLAP = 0.1
"""A scan does not overlap earlier ones if they met a smaller share of its observed voxels."""
AROUND = np.indices((3, 3, 3)).reshape(3, -1).T - 1
"""Steps (27, 3) from a voxel to all around it."""
MAX_COUNT = 255
"""Maximum count of a voxel (uint8): at this, both of its counts are halved."""
Counts: TypeAlias = NDArray[np.uint8]
Window: TypeAlias = tuple[Ints, ObservedGrid, Floats]
"""The voxels around one scan: the index of the first (3,), counted from the world's origin; which
are observed or free; and the returns (N, 3), metres from the sensor along the world's axes, see
`are_returns`."""


def ingest(log: Log, out: Path, how: Fusing, *, on_done: Counted = unheard) -> Counter[str]:
    """Write the maps of a log, ``place-000.npz`` and on, its observations, and its poses as
    ``poses.tum`` into a new folder.

    The folder has ``.part`` behind its name until it is complete. If a run is stopped or killed, or
    meets a scan that it cannot read, the same call continues from the last save, to the same bits.

    A new map begins where one would have more than `MAX_PLACE_VOXELS`. A voxel is occupied if it
    holds returns, except those of moving objects (see `Fusing`), and free if it holds none and a
    ray crosses it. An observation, ``observations/000010.npz``, has the scan's `points` from the
    sensor along the world's axes, `position`, `quaternion` and `time_s`; and in the usual grid
    around it, `origin`, `voxel_m`, the scan's `observed` and `free`, and the map's `occupancy` and
    `known`.

    Args:
        log: The log.
        out: The folder, which must not exist.
        how: Parameters.
        on_done: Called with 1 after each scan, and first with the scans that an earlier run fused.

    Returns:
        Counts of scans, returns, voxels, maps and observations, for the user.

    Raises:
        DatasetError: A cloud cannot be read, or has no times of points although `how.deskew`; the
            disk fails, `out` exists, or its ``.part`` is of another log or other parameters.
        SceneError: No return is within reach of the sensor, or a map's file is too large.
    """
    if how.deskew:
        log.check_point_times()
    check_free(out)
    make_parent(out)
    unfinished = out.with_name(f"{out.name}.part")
    with disk_errors(out):
        run = _Run(log, how, unfinished, on_done)
        try:
            run.write()
        except SceneError:  # the same call would fail again: there is nothing to continue
            shutil.rmtree(unfinished)
            raise
        (unfinished / PROGRESS).unlink()
        remove_temp_files(unfinished)  # of runs that were killed while they wrote a map
        check_free(out)
        unfinished.rename(out)
    return run.report


class _Run:
    """Fusion of a log into a folder, which also holds the state that a later run continues from."""

    def __init__(self, log: Log, how: Fusing, folder: Path, on_done: Counted):
        """Begin, or continue from the state in `folder`. Raises DatasetError if that is of another
        log or other parameters."""
        self._log, self._how, self._folder, self._on_done = log, how, folder, on_done
        poses = [[*pose.position, *pose.quaternion] for pose in log.poses]
        self._key = sha256_of(f"{how} {log.times_s.tolist()} {poses}".encode())
        """Hash of the log and the parameters, so that no run continues another's maps."""
        self._scan = 0
        """Number of the next scan."""
        self.report = Counter(scans_without_pose=log.without_pose)
        """Counts so far, see `ingest`."""
        self._counts = NOTHING
        """(2, *shape): how many scans observed each voxel of the current map, and found it free;
        empty where no scan of it was counted."""
        if (folder / PROGRESS).exists():
            with np.load(folder / PROGRESS) as saved:
                if str(saved["key"]) != self._key:
                    raise DatasetError(
                        f"{folder}: holds unfinished maps of another log or with other options; "
                        "remove it, or give another name"
                    )
                self._scan, self._counts = int(saved["scan"]), saved["counts"]
                self.report = Counter(json.loads(str(saved["report"])))
        else:
            check_free(folder)
            (folder / "observations").mkdir(parents=True)
            rows = zip(log.times_s.tolist(), log.poses, strict=True)
            write_tum(folder / "poses.tum", rows)
            # at once: after a kill, a folder without this file would be refused
            self._save()
        self._saved_s = time.monotonic()
        self._scans = log.scans(self._scan)
        on_done(self._scan)

    def _save(self) -> None:
        progress = {
            "counts": self._counts,
            "key": self._key,
            "scan": self._scan,
            "report": json.dumps(self.report),
        }
        write_atomic(self._folder / PROGRESS, encode_npz(progress))
        self._saved_s = time.monotonic()

    def write(self) -> None:
        """Write the maps that are missing, and their observations.

        Raises:
            DatasetError: A cloud cannot be read, or the disk fails.
            SceneError: No return is within reach of the sensor, or a map's file is too large.
        """
        # the parts are the same in every run, so that a saved scan says which of them are done
        for number, part in enumerate(self._parts()):
            if self._scan >= part.stop:  # an earlier run wrote this map
                continue
            observations = {
                n: self._folder / "observations" / f"{n:06d}.npz" for n in part[:: self._how.every]
            }
            place = self._fused(part, observations)
            name = f"place-{number:03d}.npz"
            write_atomic(self._folder / name, encode_map(place, name))
            for observation in observations.values():
                self.report.update(_observe(observation, place))
            self.report.update(
                maps=1,
                observations=len(observations),
                occupied_voxels=int(np.count_nonzero(place.states == OCCUPIED)),
                free_voxels=int(np.count_nonzero(place.states == FREE)),
            )
            self._save()
        if not self.report["occupied_voxels"]:
            raise SceneError(
                "no return of the log is within --reach of its sensor; expected clouds in metres"
            )

    def _parts(self) -> Iterator[range]:
        """Yield the range of scans of each map: as many as fit into `MAX_PLACE_VOXELS`."""
        poses = self._log.poses
        begin, low, high = 0, poses[0].position, poses[0].position
        for n, pose in enumerate(poses):
            low, high = np.minimum(low, pose.position), np.maximum(high, pose.position)
            if math.prod(self._box(low, high)[1]) > MAX_PLACE_VOXELS:
                yield range(begin, n)
                begin, low, high = n, pose.position, pose.position
        yield range(begin, len(poses))

    def _box(self, low: Floats, high: Floats) -> tuple[Ints, tuple[int, ...]]:
        """Return index of the first voxel, counted from the world's origin, and shape of a map
        whose scans lie between `low` and `high` (3,), metres."""
        how = self._how
        reach = np.array([how.reach_m, how.reach_m, how.rise_m])
        first = np.floor((low - reach) / how.voxel_m).astype(np.int64) - 1
        last = np.ceil((high + reach) / how.voxel_m).astype(np.int64) + 1
        return first, tuple((last - first).tolist())

    def _fused(self, part: range, observations: Mapping[int, Path]) -> VoxelMap:
        """Return the map of the scans of `part`, from the next one on. Those of `observations` are
        written to these files, still without truth."""
        positions = np.array([self._log.poses[n].position for n in part])
        first, shape = self._box(positions.min(axis=0), positions.max(axis=0))
        if not self._counts.size:
            self._counts = np.zeros((2, *shape), np.uint8)
        (hits, misses), remaining = self._counts, range(self._scan, part.stop)
        for n, (scan, window) in zip(remaining, self._windows(remaining), strict=True):
            corner, seen, points = window
            overlapping, observed = _count(hits, misses, corner - first, seen)
            self.report.update(
                scans=1,
                returns=len(points),
                returns_left_out=len(scan.points) - len(points),
                scans_without_overlap=int(n > part[0] and overlapping < MIN_OVERLAP * observed),
            )
            if n in observations:
                observation = {
                    "points": points.astype(np.float32),
                    "position": scan.pose.position,
                    "quaternion": scan.pose.quaternion,
                    "time_s": np.float64(scan.time_s),
                }
                # not synced, for speed: a kill loses nothing, and a power failure at most this
                write_atomic(observations[n], encode_npz(observation), sync=False)
            self._scan = n + 1
            self._on_done(1)
            # after the last scan, `write` saves, once the map is written
            if time.monotonic() - self._saved_s > SAVE_EVERY_S and n + 1 < part.stop:
                self._save()
        # `_settle` replaces these counts in place, and the next map begins without any
        self._counts = NOTHING
        self.report.update(moved_voxels=_settle(hits, misses, self._how.moved_share))
        low, high = box_of(hits, lambda layer: layer != UNKNOWN)
        if not high.all():
            raise SceneError("no scan of the log has a return that its maps reach")
        states = np.ascontiguousarray(hits[tuple(map(slice, low, high))])
        return VoxelMap(states, self._how.voxel_m, (first + low) * self._how.voxel_m)

    def _windows(self, part: range) -> Iterator[tuple[LogScan, Window]]:
        """Yield scans and their windows in order; threads work some scans ahead.

        Raises:
            DatasetError: A scan cannot be read. The scans before it are counted and saved first.
        """
        waiting, broken = deque[tuple[LogScan, Future[Window]]](), None
        with ThreadPoolExecutor(THREADS) as pool:
            for n in part:
                try:
                    scan = next(self._scans)
                    pace = pace_of(self._log, n)
                    if self._how.deskew and ("t" not in scan.more or not pace[1]):
                        raise DatasetError(
                            f"scan {n}, at {scan.time_s:.14g} s, has no times of points that can "
                            "be true, or all scans near it have its time"
                        )
                except DatasetError as error:
                    broken = error
                    break
                waiting.append((scan, pool.submit(_window, scan, pace, self._how)))
                # few scans ahead, since each window takes memory
                if len(waiting) > 2 * THREADS:
                    ready, window = waiting.popleft()
                    yield ready, window.result()
            # also before an error, so that its user need not fuse these scans again
            for ready, window in waiting:
                yield ready, window.result()
        if broken is not None:
            self._save()
            raise DatasetError(
                f"{broken}; mend it and give the same command again, which continues from scan "
                f"{self._scan} of {len(self._log.poses)}"
            )


def pace_of(log: Log, n: int) -> tuple[Pose, float]:
    """Find how the sensor moves during a scan.

    Args:
        log: The log.
        n: Number of the scan.

    Returns:
        A pose of the sensor after the scan began, and how many seconds after; 0 if no scan near it
        has another time.
    """
    poses, times = log.poses, log.times_s
    # the next scan, unless its message was sent twice or late
    for after in range(n + 1, min(n + LATE, len(poses))):
        if times[after] > times[n]:
            return poses[after], float(times[after] - times[n])
    for before in range(n - 1, max(n - LATE, -1), -1):
        if times[before] < times[n]:  # extrapolated: the motion continues
            return between(poses[before], poses[n], 2.0), float(times[n] - times[before])
    return poses[n], 0.0


def in_world(
    scan: LogScan, pace: tuple[Pose, float], how: Fusing
) -> tuple[Floats, Floats, Ints, dict[int, Floats]]:
    """Move the returns of a scan into the world, each from where the sensor was at its time.

    Args:
        scan: The scan, with its pose.
        pace: See `pace_of`.
        how: `least_m` and `deskew` are used.

    Returns:
        The N returns in the world (N, 3) and their ranges (N,), metres; the slice of time of each
        (N,); and the sensor's position (3,) in each slice.
    """
    after, seconds = pace
    usable = are_returns(scan.points, min_range_m=how.least_m)
    points = scan.points[usable]
    ranges = np.sqrt((points**2).sum(axis=1))
    # the sensor moves while it scans: points of a slice of that time are seen from one pose
    slices = np.zeros(len(points), np.int64)
    if how.deskew and "t" in scan.more and seconds > 0:
        # negative for points before the stamp
        shares = np.clip(scan.more["t"][usable] / seconds, -1.0, 1.0)
        slices = np.minimum(np.floor(shares * SLICES), SLICES - 1).astype(np.int64)
    sensors = dict[int, Floats]()
    for number in np.unique(slices).tolist():
        pose = between(scan.pose, after, (number + 0.5) / SLICES) if slices.any() else scan.pose
        inside = slices == number
        points[inside] = rotate(pose.quaternion, points[inside]) + pose.position
        sensors[number] = pose.position
    return points, ranges, slices, sensors


def _window(scan: LogScan, pace: tuple[Pose, float], how: Fusing) -> Window:
    """Follow the rays of a scan through the voxels around it; `pace` is from `pace_of`."""
    center, voxel_m = scan.pose.position, how.voxel_m
    points, ranges, slices, sensors = in_world(scan, pace, how)
    # the window holds rays as far as they reach, and within the rise that is mapped
    reached = center + np.minimum(1.0, how.reach_m / ranges)[:, None] * (points - center)
    ends = np.concatenate([reached, [center, *sensors.values()]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    low[2], high[2] = max(low[2], center[2] - how.rise_m), min(high[2], center[2] + how.rise_m)
    first = np.floor(low / voxel_m).astype(np.int64) - 2
    x, y, z = (np.floor(high / voxel_m).astype(np.int64) + 3 - first).tolist()
    grid = GridSpec(shape=(x, y, z), voxel_m=voxel_m, truncation_m=voxel_m)
    seen = unknown_grid(grid, first * voxel_m)
    for number, sensor in sensors.items():
        inside = slices == number
        sort_points(sensor, points[inside], grid, seen.origin, reach_m=how.reach_m, into=seen)
    # rays of other slices may have crossed voxels with a return
    seen.free[seen.observed] = False
    return first, seen, points - center


def _count(hits: Counts, misses: Counts, corner: Ints, seen: ObservedGrid) -> tuple[int, int]:
    """Add a scan's window to the counts of a map, in place.

    Args:
        hits: Scans that observed each voxel.
        misses: Scans that found each voxel free, and observed none beside it; at least 1 if any
            scan found it free.
        corner: (3,): index of the window's first voxel in the map.
        seen: The window.

    Returns:
        How many observed voxels an earlier scan met, and how many voxels were observed.
    """
    low, high = np.maximum(corner, 0), np.minimum(corner + seen.observed.shape, hits.shape)
    # where map and window overlap, in the map and in the window
    in_map, inside = tuple(map(slice, low, high)), tuple(map(slice, low - corner, high - corner))
    hit, miss = hits[in_map], misses[in_map]
    observed, free = seen.observed[inside], seen.free[inside]
    full = (observed | free) & (np.maximum(hit, miss) == MAX_COUNT)
    if full.any():  # rounded up, so that a count above 0 stays above 0
        hit[full] -= hit[full] >> 1
        miss[full] -= miss[full] >> 1
    overlapping = observed & ((hit | miss) > 0)
    hit += observed
    # rays that graze a surface cross its voxels: beside an observed voxel, free ones stay free, but
    # do not count against hits of other scans
    counted, within, inner = free.copy(), np.zeros_like(observed), (slice(1, -1),) * 3
    within[inner] = observed[inner]  # the others have no voxels all around
    strides = np.array([observed[0].size, observed.shape[2], 1])
    counted.reshape(-1)[np.flatnonzero(within)[:, None] + AROUND @ strides] = False
    miss += counted
    np.maximum(miss, free, out=miss)
    return int(overlapping.sum()), int(observed.sum())


def _settle(hits: Counts, misses: Counts, moved_share: float) -> int:
    """Replace each voxel's hits by its state; return how many voxels a moving object left free."""
    moved = 0
    for hit, miss in zip(
        hits, misses, strict=True
    ):  # by layers, since int64 counts take much memory
        total = hit.astype(np.int64) + miss
        gone = (hit > 0) & (hit < moved_share * total)
        moved += int(gone.sum())
        hit[:] = np.select([total == 0, gone | (hit == 0)], [UNKNOWN, FREE], OCCUPIED)
    return moved


def _observe(path: Path, place: VoxelMap) -> dict[str, int]:
    """Add to an observation its own grid and the map's, which is the truth. Count its returns in
    that grid, and those where the map has no solid: of a moving object, or grazing."""
    with np.load(path) as file:
        observation = dict(file)
    grid, position = GridSpec(), observation["position"]
    origin, points = grid.origin_at(position), observation["points"] + position
    seen = sort_points(position, points, grid, origin)
    occupancy, known = resample(place, grid, origin)
    observation |= {"origin": origin, "voxel_m": np.float64(grid.voxel_m)}
    observation |= {"observed": seen.observed, "free": seen.free}
    observation |= {"occupancy": occupancy, "known": known}
    write_atomic(path, encode_npz(observation), sync=False)
    voxels = grid.index(points, origin)
    within = voxels[((voxels >= 0) & (voxels < grid.shape)).all(axis=1)]
    outside = int(np.count_nonzero(~occupancy[tuple(within.T)]))
    return {"observed_returns": len(within), "returns_outside_truth": outside}
