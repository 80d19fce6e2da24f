"""A log: its poses, what reads its clouds, and how all of it was read."""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.parameters import MOST_LENGTH_M
from scenegen.clouds import Cloud, check_scan
from scenegen.errors import DatasetError
from scenegen.logs import LogScan
from scenegen.logs.bags import Reader
from scenegen.logs.times import RawTimes, find_clock


@dataclass(frozen=True, eq=False)
class Log:
    """A log whose poses are known, and whose clouds are read one after the other."""

    times_s: Floats
    """(n,): when each scan began, seconds."""
    poses: tuple[Pose, ...]
    """The sensor's at each, as many."""
    without_pose: int
    """Scans that are left out: none of the poses is of their time."""
    scans: Callable[..., Iterator[LogScan]]
    """Reads the n scans, or those from a number on."""
    about: Mapping[str, str] = field(default_factory=dict)
    """How clouds, points, poses and times were read, in words."""
    details: Mapping[str, str] = field(default_factory=dict)
    """More of that."""
    no_point_times: str = ""
    """Why the times of points are not known, for an error; "" if they are, or may be."""

    def line(self) -> str:
        """How it was read, as a line for people."""
        return f"read: {', '.join(self.about.values())}"

    def explained(self) -> dict[str, str]:
        """How it was read, with what its times and its first cloud say. Reads that cloud."""
        scan = next(self.scans())
        ranges = np.sqrt((scan.points[np.isfinite(scan.points).all(axis=1)] ** 2).sum(axis=1))
        first = f"{len(scan.points)} points"
        if len(ranges):
            low, middle, high = np.quantile(ranges, [0, 0.5, 1])
            first += f", {low:.4g} to {high:.4g} m from the sensor, {middle:.4g} m in the median"
        return {
            **self.about,
            **self.details,
            "scans": f"{span(self.times_s)}, {period_s(self.times_s):.4g} s apart (median)",
            "scans_without_pose": str(self.without_pose),
            **({"no_point_times": self.no_point_times} if self.no_point_times else {}),
            "first_cloud": first,
        }

    def check_point_times(self) -> None:
        """Raise DatasetError if the times of its points are not known."""
        if self.no_point_times:
            raise DatasetError(f"{self.no_point_times}; leave out --deskew, or mend the times")


def make_log(
    path: Path,
    times: Floats,
    poses: Sequence[Pose | None],
    clouds: Callable[[], Iterator[Reader]],
    samples: Mapping[int, Cloud],
    posed_s: Floats,
    *,
    about: Mapping[str, str],
    details: Mapping[str, str],
) -> Log:
    """A log of the scans that have a pose.

    Args:
        path: Where it is, for errors.
        times: (n,): when each scan began, seconds.
        poses: (n,): the sensor's, None if it is not known.
        clouds: Reads the n clouds.
        samples: Some of these by number, whose times of points decide how all are read.
        posed_s: (m,): for which times poses are known, rising; empty or NaN for all.
        about: `Log.about`, but for the times of points.
        details: `Log.details`, likewise.

    Raises:
        DatasetError: No scan has a pose, or one is too far out.
    """
    placed = [n for n, pose in enumerate(poses) if pose is not None]
    if not placed:
        raise DatasetError(
            f"{path}: no pose is of the time of any of its {len(poses)} scans: these are "
            f"{span(times)}, and poses {span(posed_s)}; expected seconds of the same clock"
        )
    held = tuple(filter(None, poses))
    if (furthest := max(abs(pose.position).max() for pose in held)) > MOST_LENGTH_M:
        raise DatasetError(
            f"{path}: a pose is beyond {MOST_LENGTH_M:g} m ({furthest:.3g} m); subtract the first "
            "position from all (UTM lies so far out), or give them in metres"
        )
    clock, fault, point_times = None, "", {}
    try:
        raw = [RawTimes.of_cloud(cloud, times[n]) for n, cloud in samples.items()]
        clock = find_clock(raw, period_s(times))
        point_times = {"point_times": clock.details}
    except ValueError as error:
        fault = f"{path}: {error}"

    def scans(first: int = 0) -> Iterator[LogScan]:
        rows = zip(times.tolist(), poses, clouds(), strict=True)
        kept = ((time, pose, reader) for time, pose, reader in rows if pose is not None)
        for time, pose, (name, read) in itertools.islice(kept, first, None):
            cloud = read()
            check_scan(cloud.points, np.zeros(3), name)
            seconds = clock.seconds(RawTimes.of_cloud(cloud, time)) if clock else None
            yield LogScan(time, pose, cloud.points, {} if seconds is None else {"t": seconds})

    return Log(
        times[placed],
        held,
        len(poses) - len(placed),
        scans,
        {**about, "times": f"times from {clock}" if clock else "no times of points"},
        {**details, **point_times},
        fault,
    )


def span(times_s: Floats) -> str:
    """The first and last of times, in words."""
    return f"from {times_s[0]:.14g} to {times_s[-1]:.14g} s"


def period_s(times_s: Floats) -> float:
    """The time from scan to scan (median), seconds; NaN if no time is after another."""
    steps = np.diff(times_s)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else math.nan
