"""A log of a real sensor: its poses, its clouds, and how both were read.

The times of points have no standard name or unit. `find_clock` determines the field and the unit
from the time that a cloud spans.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.parameters import MAX_LENGTH_M
from scenegen.base.errors import DatasetError
from scenegen.logs import LogScan
from scenegen.logs.bags import Reader
from scenegen.worlds.clouds import Cloud, check_scan
from scenegen.worlds.poses import UNITS

MIN_SPAN, MAX_SPAN = 0.05, 1.5
"""Minimum and maximum span of the times of a scan's points, by the time between scans."""
CLOCK_S = 1.0
"""Maximum difference between times of the same clock, seconds."""
SHARE = "shares of a scan"
"""Name of the unit of times that go from 0 to 1 in each scan."""


@dataclass(frozen=True, eq=False)
class Log:
    """A log whose poses are known, and whose clouds are read one after the other."""

    times_s: Floats
    """(n,): when each scan began, seconds."""
    poses: tuple[Pose, ...]
    """(n,): the sensor's pose in the world at each time."""
    without_pose: int
    """Scans that were left out since no pose is known at their time."""
    scans: Callable[..., Iterator[LogScan]]
    """Read the n scans, or with a number, those from it on."""
    about: Mapping[str, str] = field(default_factory=dict)
    """How clouds, points, poses and times were read, in words."""
    details: Mapping[str, str] = field(default_factory=dict)
    """Further lines of that kind, which only `explained` shows."""
    no_point_times: str = ""
    """Why the times of points are not known, for an error; "" if they are, or may be."""

    def line(self) -> str:
        """Return how the log was read, in one line for people."""
        return f"read: {', '.join(self.about.values())}"

    def explained(self) -> dict[str, str]:
        """Return how the log was read, with facts of its times and its first cloud, which is
        read."""
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
        """Check that the times of points are known, as deskewing needs.

        Raises:
            DatasetError: They are not; says why.
        """
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
    """Make a log of the scans that have a pose.

    Args:
        path: Where it is, for errors.
        times: (n,): when each scan began, seconds.
        poses: (n,): the sensor's pose in the world, None if it is not known.
        clouds: Function that yields the name of each of the n clouds, and its reader.
        samples: Some clouds by number; their times of points decide how all are read.
        posed_s: (m,): times at which poses are known, rising; empty or NaN if they have none.
        about: `Log.about` without the times of points.
        details: `Log.details` without the times of points.

    Raises:
        DatasetError: No scan has a pose, or a pose is beyond `MAX_LENGTH_M`.
    """
    placed = [n for n, pose in enumerate(poses) if pose is not None]
    if not placed:
        raise DatasetError(
            f"{path}: none of its {len(poses)} scans has a pose at its time: scans are "
            f"{span(times)}, and poses {span(posed_s)}; expected seconds of the same clock"
        )
    held = tuple(filter(None, poses))
    if (furthest := max(abs(pose.position).max() for pose in held)) > MAX_LENGTH_M:
        raise DatasetError(
            f"{path}: a pose is beyond {MAX_LENGTH_M:g} m ({furthest:.3g} m); subtract the first "
            "position from all (UTM lies so far out), or give them in metres"
        )
    # a log without times of points is a log: only `--deskew` needs them
    clock, fault, point_times = None, "", {}
    try:
        raw = [RawTimes.of_cloud(cloud, times[n]) for n, cloud in samples.items()]
        clock = find_clock(raw, period_s(times))
        point_times = {"point_times": clock.details}
    except ValueError as error:
        fault = f"{path}: {error}"

    def scans(first: int = 0) -> Iterator[LogScan]:
        rows = zip(times.tolist(), poses, clouds(), strict=True)
        posed = ((time, pose, reader) for time, pose, reader in rows if pose is not None)
        for time, pose, (name, read) in itertools.islice(posed, first, None):
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
    """Return the first and last time, for people."""
    return f"from {times_s[0]:.14g} to {times_s[-1]:.14g} s"


def period_s(times_s: Floats) -> float:
    """Return the median time between scans, seconds; NaN if no time is after another."""
    # messages may come twice or late: such steps are no period
    steps = np.diff(times_s)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else math.nan


@dataclass(frozen=True, eq=False)
class RawTimes:
    """The fields of one cloud that may be times."""

    fields: Mapping[str, NDArray]
    """By name, (n,), as the driver writes them."""
    returned: NDArray[np.bool_]
    """(n,): whether the ray returned; other times may be anything."""
    stamp_s: float
    """The cloud's own time, seconds."""

    @classmethod
    def of_cloud(cls, cloud: Cloud, stamp_s: float) -> "RawTimes":
        """Take the fields of a cloud.

        Args:
            cloud: The cloud.
            stamp_s: Its time, seconds.
        """
        return cls(cloud.times, cloud.returned, stamp_s)

    def of(self, name: str) -> Floats:
        """Return a field's values at returns, in the field's unit."""
        return self.fields[name][self.returned].astype(np.float64)


@dataclass(frozen=True, kw_only=True)
class PointClock:
    """How the times of a log's points are read."""

    field: str
    unit: str
    unit_s: float
    origin: str
    """Where times begin: "the stamp", "the clock of the stamps", or "the first point"."""
    max_span_s: float
    """Maximum span of a scan, seconds; times of longer scans are wrong, and not used."""

    def seconds(self, raw: RawTimes) -> Floats | None:
        """Return when points were measured, (n,), seconds after the cloud's stamp (after its first
        return if the clock is another); 0 where nothing returned. None if times are impossible."""
        if self.field not in raw.fields:
            return None
        if not raw.returned.any():
            return np.zeros(len(raw.returned))
        times = raw.fields[self.field].astype(np.float64) * self.unit_s
        begin = {"the clock of the stamps": raw.stamp_s, "the stamp": 0.0}
        # a clock of its own has no common origin with the stamps
        times -= begin.get(self.origin, times[raw.returned].min())
        valid = times[raw.returned]
        far = max(abs(valid.min()), abs(valid.max()), np.ptp(valid))
        return np.where(raw.returned, times, 0.0) if far <= self.max_span_s else None

    @property
    def details(self) -> str:
        """Origin of times and maximum span of a scan, for people."""
        return f"from {self.origin}; of a scan, they span at most {self.max_span_s:.4g} s"

    def __str__(self) -> str:
        return f"field {self.field} in {self.unit}"


def find_clock(samples: Sequence[RawTimes], period_s: float) -> PointClock:
    """Determine which field has the times of points, and its unit, from the field's span.

    Args:
        samples: Some clouds of a log.
        period_s: Time between its scans, seconds; NaN if it is not known.

    Returns:
        The field, its unit, and its origin.

    Raises:
        ValueError: No field has times, or no unit makes a field's times fit the period.
    """
    # a span needs two returns
    samples = [sample for sample in samples if sample.returned.sum() > 1]
    names = list(samples[0].fields) if samples else []
    names = [name for name in names if all(name in sample.fields for sample in samples)]
    if samples and not names:
        raise ValueError(
            "its points have no field of times (t, time, timestamp, stamps, time_offset …)"
        )
    if not samples or not period_s > 0:
        raise ValueError(
            "its points' times have no known unit: no two scans have returns and rising stamps"
        )
    faults = list[str]()
    for name in names:
        unit = _unit(samples, name, period_s)
        if unit is None:
            spans = np.median([np.ptp(sample.of(name)) for sample in samples])
            faults.append(f"field {name} spans {spans:.6g} in a scan")
            continue
        label, unit_s = unit
        firsts = np.array([sample.of(name).min() * unit_s for sample in samples])
        late = abs(firsts - [sample.stamp_s for sample in samples]).max()
        reach = MAX_SPAN * period_s
        # times count from the stamp, or on the stamp's clock, or on the sensor's own clock
        if abs(firsts).max() <= reach:
            origin = "the stamp"
        elif late <= reach:
            origin = "the clock of the stamps"
        elif late <= CLOCK_S:
            faults.append(f"field {name} begins {late:.3g} s from the stamp")
            continue
        else:
            origin = "the first point"
        return PointClock(field=name, unit=label, unit_s=unit_s, origin=origin, max_span_s=reach)
    raise ValueError(
        f"its points' times do not fit the {period_s:.4g} s between scans: {'; '.join(faults)}; "
        f"expected {MIN_SPAN:g} to {MAX_SPAN:g} times that, in s, ms, µs or ns, or 0 to 1"
    )


def _unit(samples: Sequence[RawTimes], name: str, period_s: float) -> tuple[str, float] | None:
    """Return the unit of a field, and its seconds; None if none fits, or several do."""
    values = [sample.of(name) for sample in samples]
    span = float(np.median([np.ptp(times) for times in values]))
    low, high = min(map(np.min, values)), max(map(np.max, values))
    is_float = samples[0].fields[name].dtype.kind == "f"
    # some drivers write 0 to 1 over a scan
    shares = is_float and 0 <= low <= 0.1 and 0.9 <= high <= 1
    fitting = [
        (unit, scale)
        for unit, scale in UNITS.items()
        if MIN_SPAN <= span * scale / period_s <= MAX_SPAN
    ]
    if shares and (not fitting or fitting[0][0] != "s"):
        return SHARE, period_s
    if shares and abs(period_s - 1) > 0.1:
        return None  # either seconds or shares of a scan, and the times differ
    return fitting[0] if fitting else None
