"""Maps of a log, made by following every ray of every scan; and some of its scans beside the truth
that all of them tell."""

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
    disk_told,
    make_parent,
    remove_drafts,
    sha256_of,
    write_whole,
)
from scenegen.base.limits import MOST_PLACE_VOXELS
from scenegen.logs import Fusing, LogScan
from scenegen.logs.log import Log
from scenegen.truth.voxels import resample
from scenegen.worlds.clouds.write import encode_npz
from scenegen.worlds.place import box_of, encode_map
from scenegen.worlds.poses import between

THREADS = 2
"""Threads that follow rays, each in a window of the map; a third adds the windows up."""
SLICES = 100
"""Parts of the way from scan to scan: where points are deskewed, those of a part move as one."""
LATE = 10
"""Messages of clouds are late by fewer than this."""
PROGRESS, SAVE_EVERY_S = "progress.npz", 60.0
"""The file that says how far a log is fused, and how often it is written, seconds."""
NOTHING = np.empty((2, 0, 0, 0), np.uint8)
"""The counts of no voxel."""
MIN_OVERLAP = 0.1
"""A scan of whose observed voxels a smaller share was met before does not overlap with those before
it."""
MAX_COUNT = 255
"""Scans that are counted of a voxel: beyond, both of its counts are halved."""
Counts: TypeAlias = NDArray[np.uint8]
Window: TypeAlias = tuple[Ints, ObservedGrid, Floats]
"""What one scan says of the voxels around it: the first of them (3,), counted from the world's
origin; which are observed or free; and the returns (N, 3), from the sensor, along the world's axes,
metres, see `are_returns`."""


def ingest(log: Log, out: Path, how: Fusing, *, on_done: Counted = unheard) -> Counter[str]:
    """Write the maps of a log, ``place-000.npz`` and on, and its observations into a new folder
    `out`. Until all is there, it is called as `out` with ``.part`` behind: where a run was stopped
    or killed, or met a scan that cannot be read, the same call goes on from what it saved last, to
    the same bits.

    A new map begins where one would have more than `MOST_PLACE_VOXELS`. A voxel is occupied where
    it holds returns, but for what moved on (see `Fusing`), and free where it holds none and a ray
    crosses it. An observation, ``observations/000010.npz``, has the scan's `points` from the
    sensor along the world's axes, `position`, `quaternion` and `time_s`; and in the usual grid
    around it, `origin`, `voxel_m`, its own `observed` and `free`, and the whole map's `occupancy`
    and `known`.

    Returns:
        What was found, counted.

    Raises:
        DatasetError: A cloud cannot be read, or is to be deskewed and has no times of points; the
            disk refuses, there is something at `out`, or another log's work goes on there.
        SceneError: The log says nothing, or a map's file is too large.
    """
    if how.deskew:
        log.check_point_times()
    check_free(out)
    make_parent(out)
    unfinished = out.with_name(f"{out.name}.part")
    with disk_told(out):
        run = _Run(log, how, unfinished, on_done)
        try:
            run.write()
        except SceneError:
            shutil.rmtree(unfinished)
            raise
        (unfinished / PROGRESS).unlink()
        remove_drafts(unfinished)  # of runs that were killed while they wrote a map
        check_free(out)
        unfinished.rename(out)
    return run.report


class _Run:
    """A log that becomes maps in a folder, which holds what a run that goes on needs."""

    def __init__(self, log: Log, how: Fusing, folder: Path, on_done: Counted):
        """Begins, or goes on from what was saved in `folder`. Raises DatasetError where that is not
        of this log."""
        self._log, self._how, self._folder, self._on_done = log, how, folder, on_done
        poses = [[*pose.position, *pose.quaternion] for pose in log.poses]
        self._key = sha256_of(f"{how} {log.times_s.tolist()} {poses}".encode())
        """What tells the log and how it is fused from others."""
        self._scan = 0
        """The next one."""
        self.report = Counter(scans_without_pose=log.without_pose)
        """What was found so far."""
        self._counts = NOTHING
        """(2, *shape): how many scans observed each voxel of the current map, and found it free;
        empty where no scan of it was counted."""
        if (folder / PROGRESS).exists():
            with np.load(folder / PROGRESS) as saved:
                if str(saved["key"]) != self._key:
                    raise DatasetError(
                        f"{folder}: holds another log's unfinished maps, or with other options; "
                        "remove it, or give another name"
                    )
                self._scan, self._counts = int(saved["scan"]), saved["counts"]
                self.report = Counter(json.loads(str(saved["report"])))
        else:
            check_free(folder)
            (folder / "observations").mkdir(parents=True)
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
        write_whole(self._folder / PROGRESS, encode_npz(progress))
        self._saved_s = time.monotonic()

    def write(self) -> None:
        """See `ingest`."""
        for number, part in enumerate(self._parts()):
            if self._scan >= part.stop:
                continue
            observations = {
                n: self._folder / "observations" / f"{n:06d}.npz" for n in part[:: self._how.every]
            }
            place = self._fused(part, observations)
            name = f"place-{number:03d}.npz"
            write_whole(self._folder / name, encode_map(place, name))
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
        """The numbers of the scans of each map."""
        poses = self._log.poses
        begin, low, high = 0, poses[0].position, poses[0].position
        for n, pose in enumerate(poses):
            low, high = np.minimum(low, pose.position), np.maximum(high, pose.position)
            if math.prod(self._box(low, high)[1]) > MOST_PLACE_VOXELS:
                yield range(begin, n)
                begin, low, high = n, pose.position, pose.position
        yield range(begin, len(poses))

    def _box(self, low: Floats, high: Floats) -> tuple[Ints, tuple[int, ...]]:
        """The first voxel, counted from the world's origin, and the shape of a map of scans from
        positions between `low` and `high` (3,)."""
        how = self._how
        reach = np.array([how.reach_m, how.reach_m, how.rise_m])
        first = np.floor((low - reach) / how.voxel_m).astype(np.int64) - 1
        last = np.ceil((high + reach) / how.voxel_m).astype(np.int64) + 1
        return first, tuple((last - first).tolist())

    def _fused(self, part: range, observations: Mapping[int, Path]) -> VoxelMap:
        """The map of some scans, which come next; some of them are written as `observations`."""
        positions = np.array([self._log.poses[n].position for n in part])
        first, shape = self._box(positions.min(axis=0), positions.max(axis=0))
        if not self._counts.size:
            self._counts = np.zeros((2, *shape), np.uint8)
        (hits, misses), rest = self._counts, range(self._scan, part.stop)
        for n, (scan, window) in zip(rest, self._windows(rest), strict=True):
            corner, seen, points = window
            met, observed = _count(hits, misses, corner - first, seen)
            self.report.update(
                scans=1,
                returns=len(points),
                returns_left_out=len(scan.points) - len(points),
                scans_without_overlap=int(n > part[0] and met < MIN_OVERLAP * observed),
            )
            if n in observations:
                observation = {
                    "points": points.astype(np.float32),
                    "position": scan.pose.position,
                    "quaternion": scan.pose.quaternion,
                    "time_s": np.float64(scan.time_s),
                }
                write_whole(observations[n], encode_npz(observation), sync=False)
            self._scan = n + 1
            self._on_done(1)
            if time.monotonic() - self._saved_s > SAVE_EVERY_S and n + 1 < part.stop:
                self._save()
        self._counts = NOTHING
        self.report.update(moved_voxels=_settle(hits, misses, self._how.moved_share))
        low, high = box_of(hits, lambda layer: layer != UNKNOWN)
        if not high.all():
            raise SceneError("no scan of the log has a return that its maps reach")
        states = np.ascontiguousarray(hits[tuple(map(slice, low, high))])
        return VoxelMap(states, self._how.voxel_m, (first + low) * self._how.voxel_m)

    def _windows(self, part: range) -> Iterator[tuple[LogScan, Window]]:
        """Scans, each with what it says, in order; some are worked on ahead. What was counted is
        saved where one cannot be read."""
        waiting, broken = deque[tuple[LogScan, Future[Window]]](), None
        with ThreadPoolExecutor(THREADS) as pool:
            for n in part:
                try:
                    scan = next(self._scans)
                    pace = _pace(self._log, n)
                    if self._how.deskew and ("t" not in scan.more or not pace[1]):
                        raise DatasetError(
                            f"scan {n}, at {scan.time_s:.14g} s, has no times of points that can "
                            "be true, or all scans near it have its time"
                        )
                except DatasetError as error:
                    broken = error
                    break
                waiting.append((scan, pool.submit(_window, scan, pace, self._how)))
                if len(waiting) > 2 * THREADS:
                    ready, window = waiting.popleft()
                    yield ready, window.result()
            for ready, window in waiting:
                yield ready, window.result()
        if broken is not None:
            self._save()
            raise DatasetError(
                f"{broken}; mend it and give the same command again, which goes on from scan "
                f"{self._scan} of {len(self._log.poses)}"
            )


def _pace(log: Log, n: int) -> tuple[Pose, float]:
    """Where the sensor is some seconds after scan n began, and how many; 0 if no scan near it has
    another time."""
    poses, times = log.poses, log.times_s
    # the next scan, unless its message was sent twice or late
    for after in range(n + 1, min(n + LATE, len(poses))):
        if times[after] > times[n]:
            return poses[after], float(times[after] - times[n])
    for before in range(n - 1, max(n - LATE, -1), -1):
        if times[before] < times[n]:  # it goes on as it came
            return between(poses[before], poses[n], 2.0), float(times[n] - times[before])
    return poses[n], 0.0


def _window(scan: LogScan, pace: tuple[Pose, float], how: Fusing) -> Window:
    """What a scan says of the voxels around it, where the sensor goes at this `pace`."""
    here, voxel_m, (after, seconds) = scan.pose.position, how.voxel_m, pace
    usable = are_returns(scan.points, min_range_m=how.least_m)
    points = scan.points[usable]
    ranges = np.sqrt((points**2).sum(axis=1))
    # the sensor moves while it scans: points of a slice of that time are seen from one pose
    slices = np.zeros(len(points), np.int64)
    if how.deskew and "t" in scan.more and seconds > 0:
        shares = np.clip(scan.more["t"][usable] / seconds, -1.0, 1.0)
        slices = np.minimum(np.floor(shares * SLICES), SLICES - 1).astype(np.int64)
    sensors = dict[int, Floats]()
    for number in np.unique(slices).tolist():
        pose = between(scan.pose, after, (number + 0.5) / SLICES) if slices.any() else scan.pose
        inside = slices == number
        points[inside] = rotate(pose.quaternion, points[inside]) + pose.position
        sensors[number] = pose.position
    # the window holds rays as far as they reach, and within the rise that is mapped
    reached = here + np.minimum(1.0, how.reach_m / ranges)[:, None] * (points - here)
    ends = np.concatenate([reached, [here, *sensors.values()]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    low[2], high[2] = max(low[2], here[2] - how.rise_m), min(high[2], here[2] + how.rise_m)
    first = np.floor(low / voxel_m).astype(np.int64) - 2
    x, y, z = (np.floor(high / voxel_m).astype(np.int64) + 3 - first).tolist()
    grid = GridSpec(shape=(x, y, z), voxel_m=voxel_m, truncation_m=voxel_m)
    seen = unknown_grid(grid, first * voxel_m)
    for number, sensor in sensors.items():
        inside = slices == number
        sort_points(sensor, points[inside], grid, seen.origin, reach_m=how.reach_m, into=seen)
    seen.free[seen.observed] = False
    return first, seen, points - here


def _count(hits: Counts, misses: Counts, corner: Ints, seen: ObservedGrid) -> tuple[int, int]:
    """Add a scan's window, whose first voxel is `corner` (3,), to how many scans observed each
    voxel of the map or found it free.

    Returns:
        How many of the observed voxels an earlier scan met, and how many there are.
    """
    low, high = np.maximum(corner, 0), np.minimum(corner + seen.observed.shape, hits.shape)
    # where map and window overlap, in the map and in the window
    in_map, inside = tuple(map(slice, low, high)), tuple(map(slice, low - corner, high - corner))
    hit, miss = hits[in_map], misses[in_map]
    observed, free = seen.observed[inside], seen.free[inside]
    full = (observed | free) & (np.maximum(hit, miss) == MAX_COUNT)
    if full.any():  # a count above 0 stays so
        hit[full] -= hit[full] >> 1
        miss[full] -= miss[full] >> 1
    met = observed & ((hit | miss) > 0)
    hit += observed
    miss += free
    return int(met.sum()), int(observed.sum())


def _settle(hits: Counts, misses: Counts, moved_share: float) -> int:
    """Write each voxel's state into `hits`. Gives how many voxels something has moved out of."""
    moved = 0
    for hit, miss in zip(hits, misses, strict=True):  # layer by layer, for there may be very many
        total = hit.astype(np.int64) + miss
        gone = (hit > 0) & (hit < moved_share * total)
        moved += int(gone.sum())
        hit[:] = np.select([total == 0, gone | (hit == 0)], [UNKNOWN, FREE], OCCUPIED)
    return moved


def _observe(path: Path, place: VoxelMap) -> dict[str, int]:
    """Add to a scan that is kept what it says of the grid around it, and what the map does. Counts
    its returns in that grid, and those of them where the map says that nothing is: they were of
    something that moved on, or grazed."""
    with np.load(path) as file:
        observation = dict(file)
    grid, position = GridSpec(), observation["position"]
    origin, points = grid.origin_at(position), observation["points"] + position
    seen = sort_points(position, points, grid, origin)
    occupancy, known = resample(place, grid, origin)
    observation |= {"origin": origin, "voxel_m": np.float64(grid.voxel_m)}
    observation |= {"observed": seen.observed, "free": seen.free}
    observation |= {"occupancy": occupancy, "known": known}
    write_whole(path, encode_npz(observation), sync=False)
    voxels = grid.index(points, origin)
    within = voxels[((voxels >= 0) & (voxels < grid.shape)).all(axis=1)]
    outside = int(np.count_nonzero(~occupancy[tuple(within.T)]))
    return {"observed_returns": len(within), "returns_outside_truth": outside}
