"""What is measured of one sample by itself, by name: what `inspect` tells, and `take` can choose
by."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from scenegen.sample import Sample


def _ranges(sample: Sample) -> NDArray[np.float32]:
    """Those of all its scans."""
    return np.array([sample.ranges, *getattr(sample, "earlier_ranges", ())])


def _range_m(sample: Sample) -> float:
    ranges = _ranges(sample)
    hit = np.isfinite(ranges)
    return float(ranges[hit].mean()) if hit.any() else float("nan")


FIGURES: Mapping[str, Callable[[Sample], float]] = {
    "occupied": lambda sample: float(sample.occupancy.mean()),
    "observed": lambda sample: float(sample.observed.mean()),
    "free": lambda sample: float(sample.free.mean()),
    "returned": lambda sample: float(np.isfinite(_ranges(sample)).mean()),
    "range_m": _range_m,
    "tudf_m": lambda sample: float(sample.tudf.mean()),
}
"""Shares of all voxels; of all rays, those that returned; the mean range of these, metres, NaN for
none; and the mean distance of the map's voxels, metres."""
