"""Times of points: which field of a cloud has them, and in which unit, by what they span."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats
from scenegen.clouds import Cloud
from scenegen.poses import UNITS

MIN_SPAN, MAX_SPAN = 0.05, 1.5
"""The times of a scan's points span at least and at most this share of the time between scans."""
CLOCK_S = 1.0
"""Clocks that are farther apart than this are two."""
SHARE = "shares of a scan"
"""The unit of times from 0 to 1."""


@dataclass(frozen=True, eq=False)
class RawTimes:
    """The fields of one cloud that may be times."""

    fields: Mapping[str, NDArray]
    """By name, (n,), as the driver writes them."""
    returned: NDArray[np.bool_]
    """(n,): whether there is a return, whose time counts."""
    stamp_s: float
    """The cloud's own time, seconds."""

    @classmethod
    def of_cloud(cls, cloud: Cloud, stamp_s: float) -> "RawTimes":
        """Those of a cloud, which begins at `stamp_s`."""
        return cls(cloud.times, cloud.returned, stamp_s)

    def of(self, name: str) -> Floats:
        """A field's values at returns, in its unit."""
        return self.fields[name][self.returned].astype(np.float64)


@dataclass(frozen=True, kw_only=True)
class PointClock:
    """How the times of a log's points are read."""

    field: str
    unit: str
    unit_s: float
    origin: str
    """What is 0: "the stamp", "the clock of the stamps", or "the first point"."""
    max_span_s: float
    """Scans whose times span more have none."""

    def seconds(self, raw: RawTimes) -> Floats | None:
        """When points were measured, (n,), seconds after the cloud's stamp, or after its first
        return for a clock of its own; 0 where nothing returned. None if that cannot be true."""
        if self.field not in raw.fields:
            return None
        if not raw.returned.any():
            return np.zeros(len(raw.returned))
        times = raw.fields[self.field].astype(np.float64) * self.unit_s
        begin = {"the clock of the stamps": raw.stamp_s, "the stamp": 0.0}
        times -= begin.get(self.origin, times[raw.returned].min())
        valid = times[raw.returned]
        far = max(abs(valid.min()), abs(valid.max()), np.ptp(valid))
        return np.where(raw.returned, times, 0.0) if far <= self.max_span_s else None

    @property
    def details(self) -> str:
        """What a time is counted from, and how long a scan may be, in words."""
        return f"from {self.origin}; of a scan, they span at most {self.max_span_s:.4g} s"

    def __str__(self) -> str:
        return f"field {self.field} in {self.unit}"


def find_clock(samples: Sequence[RawTimes], period_s: float) -> PointClock:
    """Determine which field has the times of points, and its unit, from what it spans.

    Args:
        samples: Some clouds of a log.
        period_s: Time between its scans, seconds; NaN if it is not known.

    Returns:
        How times are read.

    Raises:
        ValueError: There is no such field, or none whose times can be true.
    """
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
    """The unit of a field, and how many seconds it is; None if it fits none, or several."""
    values = [sample.of(name) for sample in samples]
    span = float(np.median([np.ptp(times) for times in values]))
    low, high = min(map(np.min, values)), max(map(np.max, values))
    is_float = samples[0].fields[name].dtype.kind == "f"
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
