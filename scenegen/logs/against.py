"""Holds a spinning sensor against scans of a real unit: its angles, steps, ranges, lost returns and
noise; and writes a sensor file of what was measured."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from lidarsim import Sensor
from lidarsim.grid import Floats, Ints
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Dropout
from lidarsim.noise.ranges import Near, Quantise, Range
from lidarsim.sensors.device import angles_deg
from lidarsim.sensors.spinning import Spinning
from scenegen.base.files import Json
from scenegen.worlds.clouds import Cloud

SPLIT_DEG = 0.02
"""Sorted elevations of two channels are farther apart than this, degrees."""
MAX_WIDTH_DEG = 0.2
"""Elevations of a channel span less than this, degrees."""
MIN_RETURNS = 20
"""Returns of a channel; fewer are stray."""
MIN_IN = 0.95
"""Share of the returns that are not stray."""
OFF_CENTRE_DEG_M = 2.0
"""How far beams usually begin below or above the frame's origin: 35 mm, as an angle seen from a
metre, degrees."""
MIN_SHARE = 0.75
"""Share of the model's beams that must have returned."""
MAX_OFF_DEG, MAX_WORST_DEG = 1.0, 3.5
"""Differences of elevations that a unit may have, median and worst, degrees: Ouster's differ by up
to 1°, single beams of an HDL-64E by 3°."""
STEPS_M = np.arange(1, 41) * 5e-4
"""Steps of ranges that are tried, metres."""
MIN_COHERENCE = 0.8
"""Ranges have a step if their remainders agree at least so much, 0 to 1."""
SAME_DEG = 0.03
"""Returns of a channel that are nearer in azimuth than this are of one ray, degrees."""
MIN_GRID = 0.9
"""Share of a channel's returns that are whole steps apart, if missing rays can be known."""
MAX_STEPS = 4
"""Returns of one surface are at most so many steps apart; the rays between them are lost."""
MAX_PLANES = 4000
"""Patches in which a plane is fitted."""
HALF_COLUMNS = 4
"""Columns on each side of a patch's centre; a patch has three channels."""
MIN_PATCH = 12
"""Returns of a patch."""
WHITE = 0.7
"""Von Neumann's ratio of residuals (1941), half of it: 1 for noise on a plane, less for a shape."""
ROUGH_M = 0.15
"""A patch with larger residuals is no plane, metres."""
STEEP_DEG = 60.0
"""Noise and drop-outs of a fitted sensor are those of planes below this incidence, degrees."""
RANGES_M = (0.0, 2.0, 5.0, 10.0, 20.0, 50.0, math.inf)
INCIDENCES_DEG = (0.0, 30.0, 60.0, 75.0, 90.0)
"""Limits of the classes of planes."""
MIN_CLASS = 20
"""Planes of a class."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorUnit:
    """A unit of a sensor, by its scans."""

    model: Spinning
    """What it is one of, with the columns and at least the ranges of the unit."""
    beams: Ints
    """(K,): numbers of the model's beams that returned."""
    elevations_deg: Floats
    """(K,): of these beams, without the shift of those that begin beside the centre."""
    azimuths_deg: Floats
    """(K,): of these beams, less those of the model; known up to whole steps, 0 if unknown."""
    steps_deg: Floats
    """(K,): azimuth from ray to ray."""
    ranges_m: Floats
    """(N,): of all returns."""
    quantum_m: float
    """Step of ranges; 0 if there is none."""
    planes: Floats
    """(M, 5): range, incidence in degrees, standard deviation of ranges; lost rays and
    all rays, which are 0 if azimuths are uneven, so that lost rays are not known."""

    @property
    def off_deg(self) -> Floats:
        """(K,): elevations less those of the model."""
        return self.elevations_deg - np.array(self.model.elevations_deg)[self.beams]

    @property
    def noise(self) -> Noise:
        """The model's noise, with stages as measured where scans show them.

        Noise of ranges grows as the model's does."""
        stages: dict[type, Any] = _stages(self.model)
        planes = self.planes[self.planes[:, 1] < STEEP_DEG]
        if self.model.min_range_m:
            stages[Near] = Near(min_range_m=self.model.min_range_m)
        if len(planes) >= MIN_CLASS:
            usual = stages.get(Range, Range())
            # less what rounding to steps adds
            sigma = np.sqrt(np.maximum(planes[:, 2] ** 2 - self.quantum_m**2 / 12, 0.0))
            times = float(np.median(sigma / usual.sigma(planes[:, 0])))
            stages[Range] = Range(
                **{key.name: round(times * getattr(usual, key.name), 6) for key in fields(usual)}
            )
        if isinstance(share := _lost(planes), float):
            stages[Dropout] = Dropout(share=share)
        if self.quantum_m:
            stages[Quantise] = Quantise(step_m=self.quantum_m)
        return Noise(tuple(stages.values()))

    def classes(self, column: int, limits: Sequence[float]) -> Json:
        """Divide planes into classes.

        Args:
            column: Of `planes`: 0, range; 1, incidence.
            limits: Of the classes, ascending.

        Returns:
            Of the classes with enough planes: their lower limits, numbers of planes, median noise
            in metres, and shares of rays that are lost.
        """
        numbers = np.digitize(self.planes[:, column], limits) - 1
        rows = {low: self.planes[numbers == n] for n, low in enumerate(limits)}
        rows = {low: planes for low, planes in rows.items() if len(planes) >= MIN_CLASS}
        return {
            "from": [*rows],
            "planes": [len(planes) for planes in rows.values()],
            "noise_m": [round(float(np.median(planes[:, 2])), 5) for planes in rows.values()],
            "lost": [_lost(planes) for planes in rows.values()],
        }

    def facts(self) -> Json:
        """Return what was measured as plain values."""
        off = np.abs(self.off_deg)

        def rounded(*values: float) -> list[float]:
            return [round(float(value), 4) for value in values]

        return {
            "channels": len(off),
            "elevations_off_deg": rounded(np.median(off), off.max()),
            "azimuth_step_deg": rounded(self.steps_deg.min(), self.steps_deg.max()),
            "range_step_m": self.quantum_m,
            "range_m": rounded(self.ranges_m.min(), self.ranges_m.max()),
            "lost": _lost(self.planes),
            "noise": str(self.noise),
            "beams": self.beams.tolist(),
            "elevations_deg": rounded(*self.elevations_deg),
            "by_range_m": self.classes(0, RANGES_M),
            "by_incidence_deg": self.classes(1, INCIDENCES_DEG),
        }

    def encode(self) -> bytes:
        """Return a sensor file with what was measured; the rest is as the model has it."""
        elevations = np.array(self.model.elevations_deg)
        offsets = np.array(self.model.azimuth_offsets_deg or 0.0 * elevations)
        elevations[self.beams] = self.elevations_deg
        offsets[self.beams] += self.azimuths_deg
        sensor = replace(
            self.model,
            name=f"{self.model.name or 'spinning'}-unit",
            source=f"{len(self.beams)} beams as measured, the rest as {self.model.name}",
            # what the catalogue claims of its figures holds for the model only
            checked="",
            error="",
            elevations_deg=tuple(elevations.round(4).tolist()),
            azimuth_offsets_deg=tuple(offsets.round(4).tolist()),
            noise=str(self.noise),
        )
        lines = [
            f"{item.name} = {json.dumps(getattr(sensor, item.name))}"
            for item in fields(sensor)
            if getattr(sensor, item.name) != item.default
        ]
        return "\n".join(['sensor = "spinning"', *lines]).encode()


def measure(clouds: Sequence[Cloud], sensor: Sensor) -> SensorUnit:
    """Measure a unit by its scans.

    Args:
        clouds: The scans, in the sensor's own frame.
        sensor: The unit's model.

    Raises:
        ValueError: The sensor does not spin; or channels cannot be told, or are not its own.
    """
    if not isinstance(sensor, Spinning):
        raise ValueError("only scans of spinning sensors can be compared: others have no channels")
    points, scans, rings = _returns(clouds)
    all_ranges, (elevation, azimuth) = np.linalg.norm(points, axis=1), angles_deg(points)
    groups = _split(elevation, rings)
    elevations = np.array([_elevation(elevation[rows], all_ranges[rows]) for rows in groups])
    if (usual_m := np.median(all_ranges)) > sensor.max_range_m:
        raise ValueError(
            f"has ranges of {usual_m:.0f} m in the median, and {sensor.name} has at most "
            f"{sensor.max_range_m:g} m; expected metres: if these are mm or cm, divide the points"
        )
    quantum_m = _quantum(all_ranges)
    beams = _beams(elevations, quantum_m, sensor)

    # rays by scan, channel and azimuth; of several returns of a ray, one
    order = np.concatenate(groups)
    channels = np.repeat(np.arange(len(groups)), [len(rows) for rows in groups])
    # 1000 is more than azimuths span, so rays of two channels never lie within one step
    keys = 1000.0 * (len(groups) * scans[order] + channels) + azimuth[order]
    sorted_keys = np.argsort(keys)
    first = sorted_keys[np.append(True, np.diff(keys[sorted_keys]) >= SAME_DEG)]
    order, channels, gaps = order[first], channels[first], np.diff(keys[first])
    points, ranges, azimuth = points[order], all_ranges[order], azimuth[order]
    steps = np.array([_step(gaps[channels[1:] == n]) for n in range(len(groups))])
    turns = gaps / steps[channels[1:]]
    # over wide gaps, the error of a step adds up
    near = turns[turns < 10]
    is_even = np.mean(np.abs(near - np.rint(near)) < 0.25) >= MIN_GRID
    step = steps[np.bincount(channels).argmax()]
    model = _adapted(sensor, round(360 / step), all_ranges)
    modelled = angles_deg(model.directions_sensor[beams, 0])[1]
    # scans are far from each other, and three channels and some columns within 1
    places = channels + 1000.0 * scans[order], azimuth / step / HALF_COLUMNS
    return SensorUnit(
        model=model,
        beams=beams,
        elevations_deg=elevations,
        azimuths_deg=_azimuths(azimuth, channels, ranges, step, modelled),
        steps_deg=steps,
        ranges_m=all_ranges,
        quantum_m=quantum_m,
        planes=_planes(points, np.stack(places, axis=1), np.rint(turns) * is_even),
    )


def _returns(clouds: Sequence[Cloud]) -> tuple[Floats, Ints, Floats | None]:
    """Return the returns (N, 3), the numbers of their scans (N,), and those of their channels, or
    None if a cloud does not have these."""
    points = [cloud.points[cloud.returned] for cloud in clouds]
    scans = np.repeat(np.arange(len(clouds)), [len(part) for part in points])
    rings = [cloud.rings[cloud.returned] for cloud in clouds if cloud.rings is not None]
    has_rings = len(rings) == len(clouds)
    return np.concatenate(points), scans, np.concatenate(rings) if has_rings else None


def _split(elevation: Floats, rings: Floats | None) -> list[Ints]:
    """Return which returns (N,) each channel has: those with one number, or else between two gaps
    of elevation; without those of channels with very few."""
    # rings are whole numbers: half a step parts them
    values, least = (elevation, SPLIT_DEG) if rings is None else (rings, 0.5)
    order = np.argsort(values)
    groups = np.split(order, np.flatnonzero(np.diff(values[order]) > least) + 1)
    groups = [group for group in groups if len(group) >= MIN_RETURNS]
    widths = [np.ptp(values[group]) for group in groups]
    # a width is NaN if some returns have a NaN as ring
    told = len(groups) > 0 and np.max(widths) <= MAX_WIDTH_DEG
    if not told or sum(map(len, groups)) < MIN_IN * len(order):
        raise ValueError(
            "its channels cannot be told by elevations; expected a field ring, or a whole scan in "
            "the sensor's own frame, neither moved nor deskewed, of beams that begin at its centre"
        )
    return sorted(groups, key=lambda group: np.median(elevation[group]))


def _elevation(elevation: Floats, ranges: Floats) -> float:
    """Return e of elevation = e + c / range: c is not 0 for a beam that begins beside the
    centre."""
    nearness = 1.0 / ranges
    beside = nearness - nearness.mean()
    # all ranges may be equal: the variance must not be 0
    variance = (beside**2).mean() + 1e-12
    slope = (elevation * beside).mean() / variance
    # the more scatter hides it, the nearer c is to 0 (ridge regression)
    scatter = np.std(elevation - slope * beside) / OFF_CENTRE_DEG_M
    slope *= variance / (variance + scatter**2)
    return float(np.median(elevation - slope * nearness))


def _quantum(ranges: Floats) -> float:
    """Return the largest step of which ranges are multiples, metres, or 0."""
    # some 20,000 ranges: each is tried with 40 steps, and all would take much memory
    phases = 2j * math.pi * ranges[:: len(ranges) // 20_000 + 1, None] / STEPS_M
    is_step = np.abs(np.exp(phases).mean(axis=0)) >= MIN_COHERENCE
    return round(float(STEPS_M[is_step].max(initial=0.0)), 4)


def _step(gaps: Floats) -> float:
    """Return the azimuth from ray to ray of a channel; gaps are wider where rays are lost."""
    usual = np.quantile(gaps, 0.25)
    return float(gaps[np.abs(gaps - usual) <= 0.1 * usual].mean())


def _beams(elevations: Floats, quantum_m: float, sensor: Spinning) -> Ints:
    """Return the sensor's beams that are nearest to channels, (K,).

    Raises:
        ValueError: The channels are those of another sensor.
    """
    modelled = np.array(sensor.elevations_deg)
    step_m = getattr(_stages(sensor).get(Quantise), "step_m", 0.0)
    # converters round coordinates, which leaves no step of ranges: a step is the sensor's own
    if quantum_m and step_m not in (0.0, quantum_m):
        raise ValueError(
            f"has ranges in steps of {1e3 * quantum_m:g} mm; expected {1e3 * step_m:g} mm, as of "
            f"{sensor.name}"
        )
    if MIN_SHARE * len(modelled) <= len(elevations) <= len(modelled):
        # assigned, so that no beam is taken for two channels
        beams = linear_sum_assignment((elevations[:, None] - modelled) ** 2)[1]
        off = np.abs(elevations - modelled[beams])
        if np.median(off) <= MAX_OFF_DEG and off.max() <= MAX_WORST_DEG:
            return beams
    raise ValueError(
        f"has {len(elevations)} channels from {elevations.min():.1f}° to {elevations.max():.1f}°; "
        f"expected those of {sensor}"
    )


def _stages(sensor: Spinning) -> dict[type, Any]:
    return {type(stage): stage for stage in Noise.parse(sensor.noise or "none").stages}


def _adapted(sensor: Spinning, columns: int, ranges: Floats) -> Spinning:
    """Return the sensor with so many columns and, as returns only bound these, at least their
    ranges. If its lasers have a pace, its head turns at another rate."""
    paced = sensor.firing_cycle_s or sensor.firing_times_s
    return replace(
        sensor,
        # a `Spinning` has columns or a firing cycle, not both
        columns=0 if sensor.firing_cycle_s else columns,
        rate_hz=1 / (columns * sensor.cycle_s) if paced else sensor.rate_hz,
        min_range_m=min(sensor.min_range_m, round(ranges.min(), 4)),
        max_range_m=max(sensor.max_range_m, math.ceil(ranges.max())),
    )


def _azimuths(
    azimuth: Floats, channels: Ints, ranges: Floats, step: float, modelled: Floats
) -> Floats:
    """Return azimuths of channels less the `modelled` (K,), all from the first one's. They are
    known up to steps, since a scan does not say which rays are of one column, and 0 for a channel
    without a grid."""
    means = []
    for rows in (channels == n for n in range(len(modelled))):
        # near the sensor, beams that begin beside its centre have other azimuths
        far = azimuth[rows][ranges[rows] >= np.median(ranges[rows])]
        means.append(np.exp(2j * math.pi * far / step).mean())
    off = np.angle(means) / (2 * math.pi) * step - modelled
    off = (off - off[np.abs(means).argmax()] + step / 2) % step - step / 2
    return np.where(np.abs(means) > 0.5, off, 0.0)  # phases without a grid cancel


def _planes(points: Floats, places: Floats, steps: Floats) -> Floats:
    """Fit planes to patches of three channels, see `SensorUnit.planes`.

    Args:
        points: (N, 3), by scan, channel and azimuth.
        places: (N, 2): those of a patch are within 1 of its centre.
        steps: (N - 1,): from each point to the next, whole steps; 0 if unknown.
    """
    ranges = np.linalg.norm(points, axis=1)
    is_gap = (steps > MAX_STEPS) | (np.abs(np.diff(ranges)) > 0.1 * ranges[1:])
    passed = np.append(np.where(is_gap, 0.0, steps), 0.0)
    counts = np.stack([np.maximum(passed - 1.0, 0.0), passed], axis=1)
    seeds = np.arange(0, len(ranges), len(ranges) // MAX_PLANES + 1)
    # 1.01: neighbours at a distance of 1 count, however they are rounded; sorted, so that residuals
    # beside one another are of neighbouring rays
    patches = cKDTree(places).query_ball_point(places[seeds], 1.01, p=math.inf, return_sorted=True)
    directions, planes = points / ranges[:, None], []
    for seed, patch in zip(seeds, patches, strict=True):
        # with two channels, any slope across them would fit
        if len(patch) < MIN_PATCH or np.ptp(places[patch, 0]) < 2:
            continue
        r, d = ranges[patch], directions[patch]
        # on a plane, 1 / r is linear in the direction; times r², residuals are metres
        normal = np.linalg.lstsq(d * r[:, None] ** 2, r, rcond=None)[0]
        residuals = r - r**2 * (d @ normal)
        variance = (residuals**2).sum() / (len(r) - 3)  # a plane has three parameters
        is_white = (np.diff(residuals) ** 2).mean() / 2 > WHITE * variance
        if is_white and variance < ROUGH_M**2:
            cosine = abs(directions[seed] @ normal) / np.linalg.norm(normal)
            angle = math.degrees(math.acos(min(1.0, cosine)))  # rounding may exceed 1
            planes.append((ranges[seed], angle, math.sqrt(variance), *counts[patch].sum(axis=0)))
    return np.array(planes).reshape(-1, 5)


def _lost(planes: Floats) -> float | str:
    """Return the share of rays that are lost, or "unknown" if none were counted."""
    lost, rays = planes[:, 3:].sum(axis=0)
    return round(float(lost / rays), 4) if rays else "unknown"
