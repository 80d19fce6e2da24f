"""Finds the poses of a log whose scans have none: registers each scan to a map of those before it,
by voxelised GICP (Koide et al. 2021, `small_gicp`)."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.pose import chained
from scenegen.base.errors import DatasetError
from scenegen.base.executors import Counted, unheard
from scenegen.logs import Fusing, LogScan
from scenegen.logs.fuse import in_world, pace_of
from scenegen.logs.log import Log
from scenegen.logs.read import ORIGIN
from scenegen.logs.record import matrix_of
from scenegen.worlds.poses import between, inverse, pose_of_matrix

FINE, FINE_M = 0.1, (0.2, 1.0)
"""Edge of the fine map's voxel, by the median range of the first scan, and its bounds, metres."""
COARSE, SAMPLE = 2.0, 0.25
"""Edges of the coarse map's voxel, and of that in which a scan keeps one point, by the fine one."""
MIN_POINTS = 100
"""A scan with fewer points after sampling is not registered."""
MIN_INLIERS = 0.5
"""A scan is not registered if a smaller share of its points lies in voxels of the map."""
MIN_FACING = 0.05
"""A scan is not registered if a smaller share of its surfaces faces the direction that the fewest
do, within 45°: nothing then shows motion along it, as in a corridor or on an open floor. Corridors
have up to .033, public scans .15 to .31."""
MAX_JUMP = 2.0
"""A scan is not registered farther from its predicted position than so many coarse voxels."""
MAX_AHEAD = 3.0
"""Motion is predicted over at most so many times the time between the last two scans."""
MAX_FAILED = 0.1
"""A log is refused if more of its scans are not registered."""
MAX_TESTED, NEAR, AWAY = 500, 1.0, 10.0
"""Scans of which a return to a place is looked for; how near that is, and the minimum way since,
by the coarse voxel."""
CLOSINGS = 5
"""Returns at which the error is measured."""


def align(log: Log, how: Fusing, *, on_done: Counted = unheard) -> Log:
    """Find the poses of a log by registering its scans, each to the map of the scans before.

    The world is the frame of the first scan: z is up only if the sensor was level then. A scan is
    predicted by constant velocity, and registered to a coarse and then to a fine map of Gaussians,
    which forget what 100 scans have not met. A scan that fits neither is left out. Where the log
    comes back within a coarse voxel of an earlier position, the two scans are registered to
    each other, and the difference to their poses is reported.

    Args:
        log: A log whose poses are not known, see `read_log`.
        how: Parameters; with `deskew`, points are corrected for the predicted motion.
        on_done: Called with 1 after each scan.

    Returns:
        The log of the registered scans, with their poses.

    Raises:
        DatasetError: There are less than two scans, or more than `MAX_FAILED` of them cannot be
            registered; names the first ones.
        ModuleNotFoundError: The extra `align` is not installed.
    """
    if how.deskew:
        log.check_point_times()
    if len(log.poses) < 2:
        raise DatasetError("the log has one scan; expected two or more, which --align compares")
    matcher = _Matcher(how)
    numbers, poses, failed = list[int](), list[Pose](), list[int]()
    for n, scan in enumerate(log.scans()):
        pose = matcher.add(scan)
        if pose is None:
            failed.append(n)
        else:
            numbers.append(n)
            poses.append(pose)
        on_done(1)
    if len(failed) > MAX_FAILED * len(log.poses) or not poses:
        named = ", ".join(map(str, failed[:5])) + ", …" * (len(failed) > 5)
        raise DatasetError(
            f"--align cannot register {len(failed)} of {len(log.poses)} scans to those before them "
            f"(number {named} from 0 on): they do not overlap, hold too few points, or show no "
            f"motion in some direction, as in corridors; expected at most {MAX_FAILED:.0%}; cut "
            "the log there, or give its poses with --poses"
        )

    def scans(first: int = 0) -> Iterator[LogScan]:
        chosen = dict(zip(numbers[first:], poses[first:], strict=True))
        for n, scan in enumerate(log.scans(numbers[first]), numbers[first]):
            if n in chosen:
                yield replace(scan, pose=chosen[n])

    found = replace(
        log,
        times_s=log.times_s[numbers],
        poses=tuple(poses),
        without_pose=log.without_pose + len(failed),
        scans=scans,
    )
    steps = np.diff([pose.position for pose in poses], axis=0)
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    about = {
        "poses": f"poses by aligning scans over {way_m[-1]:.1f} m, the sensor taken to be level in "
        "the first",
        "failed": f"{len(failed)} scans not registered",
        "inliers": f"{np.median(matcher.inliers):.0%} of points matched (median)",
        "closing": _closing(found, matcher, way_m),
    }
    return replace(found, about={**log.about, **about})


def _closing(log: Log, matcher: "_Matcher", way_m: Floats) -> str:
    """Say how far the poses of a log err where it comes back to a place; `way_m` (n,) is the way
    to each scan, metres."""
    positions = np.array([pose.position for pose in log.poses])
    pairs = list[tuple[int, int]]()
    for last in range(0, len(positions), len(positions) // MAX_TESTED + 1):
        near = np.linalg.norm(positions - positions[last], axis=1) < NEAR * matcher.coarse_m
        returned = near & (way_m < way_m[last] - AWAY * matcher.coarse_m)
        if returned.any():
            pairs.append((int(np.argmax(returned)), last))
    chosen = pairs[:: -(len(pairs) // CLOSINGS + 1)]  # the last one errs most
    errors = np.array([matcher.closing_error(log, *pair) for pair in chosen])
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        return "no return to a place, so the drift is not known"
    return (
        f"drift at {len(errors)} returns to a place {np.median(errors):.2f} m in the median, "
        f"{errors.max():.2f} m at most"
    )


class _Matcher:
    """Maps of the scans so far, and the last poses."""

    def __init__(self, how: Fusing):
        """Begin without a scan. Raises ModuleNotFoundError without `small_gicp`."""
        import small_gicp

        self._gicp: Any = small_gicp
        self._how = how
        self._edges_m = (0.0, 0.0)
        """Of the voxels of the coarse and the fine map; 0 before the first scan."""
        self._maps = list[Any]()
        self._track = list[tuple[float, Pose]]()
        """Time and pose in the middle of the last two scans."""
        self.inliers = list[float]()
        """Of each registered scan but the first, the share of points that were matched."""

    @property
    def coarse_m(self) -> float:
        """Edge of the coarse map's voxels, metres."""
        return self._edges_m[0]

    def add(self, scan: LogScan) -> Pose | None:
        """Return the pose of the next scan, which is then part of the maps; None if it does not fit
        them."""
        begin_s = middle_s = scan.time_s
        if self._how.deskew and len(scan.points):
            # a wrong velocity bends a scan and moves its ends, but hardly its middle
            middle_s += float(np.mean(scan.more.get("t", 0.0)))
        period_s = self._track[-1][0] - self._track[0][0] if self._track else 0.0
        begin, end, pose = map(self._predicted, (begin_s, begin_s + period_s, middle_s))
        points = self._sampled(replace(scan, pose=begin), (end, period_s), pose)
        if points is None:
            return None
        if not self._maps:
            self._maps = [self._gicp.GaussianVoxelMap(edge) for edge in self._edges_m]
        else:
            fit, share = self._registered(self._maps, points, pose)
            jump = np.linalg.norm(fit.position - pose.position)
            if share < MIN_INLIERS or jump > MAX_JUMP * self.coarse_m:
                return None
            self.inliers.append(share)
            pose = fit
        for each in self._maps:
            each.insert(points, matrix_of(pose))
        self._track = [*self._track[-1:], (middle_s, pose)]
        return self._predicted(begin_s)

    def closing_error(self, log: Log, first: int, last: int) -> float:
        """Register two scans of one place to each other.

        Args:
            log: The log, with the poses that were found.
            first: Number of the earlier scan.
            last: Number of the later one.

        Returns:
            By how much their poses err, metres; NaN if the scans do not fit each other.
        """
        before, after = (
            self._sampled(next(log.scans(n)), pace_of(log, n), log.poses[n]) for n in (first, last)
        )
        maps = [self._gicp.GaussianVoxelMap(edge) for edge in self._edges_m]
        for each in maps:
            each.insert(before)
        step = chained(inverse(log.poses[first]), log.poses[last])
        fit, share = self._registered(maps, after, step)
        error = float(np.linalg.norm(fit.position - step.position))
        return error if share >= MIN_INLIERS else np.nan

    def _predicted(self, time_s: float) -> Pose:
        """Return the pose at a time by constant velocity."""
        if len(self._track) < 2:
            return self._track[-1][1] if self._track else ORIGIN
        (start_s, start), (end_s, end) = self._track
        # of scans with the same stamp, no velocity is known
        ahead = (time_s - end_s) / (end_s - start_s) if end_s > start_s else 0.0
        return between(start, end, 1 + min(ahead, MAX_AHEAD))

    def _sampled(self, scan: LogScan, pace: tuple[Pose, float], frame: Pose) -> Any:
        """Return the returns of a scan in a frame, one for each small voxel, with their
        covariances; None if they are too few, or too few face one direction. `pace` is as of
        `pace_of`."""
        begin, end = (chained(inverse(frame), pose) for pose in (scan.pose, pace[0]))
        points, ranges, *_ = in_world(replace(scan, pose=begin), (end, pace[1]), self._how)
        if len(points) < MIN_POINTS:
            return None
        if not self.coarse_m:
            fine = float(np.clip(FINE * np.median(ranges), *FINE_M))
            self._edges_m = COARSE * fine, fine
        sampled, _ = self._gicp.preprocess_points(points, SAMPLE * self._edges_m[1])
        is_enough = sampled.size() >= MIN_POINTS and _facing(sampled.normals()[:, :3]) >= MIN_FACING
        return sampled if is_enough else None

    def _registered(self, maps: list[Any], points: Any, pose: Pose) -> tuple[Pose, float]:
        """Register points to the coarse and then the fine map, beginning at a pose. Return their
        pose, and the share of points that match the fine map."""
        for edge, target in zip(self._edges_m, maps, strict=True):
            fit = self._gicp.align(
                target, points, matrix_of(pose), max_correspondence_distance=2 * edge
            )
            pose = pose_of_matrix(fit.T_target_source[:3].reshape(-1), "registration")
        return pose, fit.num_inliers / points.size()


def _facing(normals: Floats) -> float:
    """Share of unit normals (n, 3) within 45° of the direction that the fewest face."""
    weakest = np.linalg.eigh(normals.T @ normals)[1][:, 0]  # eigenvalues ascend
    return float((np.abs(normals @ weakest) > math.sqrt(0.5)).mean())
