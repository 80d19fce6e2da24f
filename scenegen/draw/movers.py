"""Fields of samples with movers: how they are computed, and what follows from them at other
times."""

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import AnalyticEngine, GridSpec
from lidarsim.grid import Field, Floats, Ints, Mask
from lidarsim.movers import CHANNELS, COEFFICIENTS, Movers, MovingCaster
from lidarsim.pose import rotate
from scenegen.base.errors import DatasetError, GenerationError, MissingPartError
from scenegen.truth import distance_field, rasterize
from scenegen.worlds.movers import fault_of
from scenegen.worlds.traffic import MAX_MOVERS, MAX_PIECES, MAX_SOLIDS, Traffic

NO_SHAPE = -1.0
"""Shape of a row of `mover_solids` that holds no solid."""
OVER_TIME = re.compile(r"(occupancy|tudf)\+(\d+(?:\.\d+)?)|flow|moving")
"""Fields that follow from a sample's movers, such as occupancy+0.5, that after half a second."""


def ray_times(traffic: Traffic | None, lidar: Any, time_s: float) -> Any:
    """Times at which rays meet movers.

    Args:
        traffic: The recipe's movers, or None.
        lidar: The sensor.
        time_s: When the scan begins, seconds.

    Returns:
        One number, or one for each ray, (*lidar.shape), seconds.
    """
    return time_s + lidar.times_s if traffic is not None and traffic.firing_times else time_s


def mover_voxels(movers: Movers, grid: GridSpec, origin: Floats, time_s: float) -> NDArray[np.int8]:
    """Which mover touches each voxel.

    Args:
        movers: The movers.
        grid: The grid.
        origin: (3,): its least corner in the world, metres.
        time_s: The time, seconds.

    Returns:
        (*grid.shape): the smallest number of a mover; -1 for none.
    """
    voxels = np.full(grid.shape, -1, np.int8)
    solids = movers.solids(time_s)
    near = (solids.lower <= origin + grid.extent_m) & (solids.upper >= origin)
    # most movers are far from a sample's map; the smallest number is written last
    for number in np.unique(movers.owner[near.all(axis=1)])[::-1].tolist():
        first, last = movers.solid_start[number : number + 2]
        names = ("shape", "size", "position", "rotation", "lower", "upper", "geom")
        own = {name: getattr(solids, name)[first:last] for name in names}
        np.copyto(voxels, number, where=rasterize(replace(solids, **own), grid, origin))
    return voxels


def mover_fields(
    fields: Mapping[str, Any], world: Any, recipe: Any, traffic: Traffic
) -> dict[str, Any]:
    """Compute the fields of the group "movers" that are not part of the truth.

    Args:
        fields: Other fields of the sample, `scan_times` among them.
        world: The `World`, with movers.
        recipe: The `Recipe`.
        traffic: The settings.

    Returns:
        Fields by name.

    Raises:
        GenerationError: if a course has more pieces than the table.
    """
    movers: Movers = world.movers
    times, lidar = fields["scan_times"], recipe.lidar
    caster = MovingCaster(
        world.caster(AnalyticEngine.of), movers, ray_times(traffic, lidar, float(times[0]))
    )
    directions = rotate(fields["quaternion"], lidar.directions_body)
    solid = caster.solid_of(fields["position"][None], directions[None], lidar.max_range_m)[0]
    # -1, no solid, picks the last entry: -1, no mover
    hit = np.append(movers.owner, -1)[solid].astype(np.int8)
    # the clean ray counts: noise changes ranges, and may lose a return
    hit[~np.isfinite(fields["ranges"])] = -1
    return {
        "return_mover": hit,
        "course_end": (end_s := times[0] + traffic.after_s),
        **_tables(movers, float(times.min()), float(end_s)),
    }


def _tables(movers: Movers, begin_s: float, end_s: float) -> dict[str, Any]:
    """Tables of movers and of their courses in an interval of time."""
    part = movers.window(begin_s, end_s)
    kind = np.zeros(MAX_MOVERS, np.int8)
    solids = np.full((MAX_MOVERS, MAX_SOLIDS, 7), NO_SHAPE)
    # NaN and not 0, at which a piece may begin: readers take the finite rows
    course = np.full((MAX_MOVERS, MAX_PIECES, 1 + CHANNELS * COEFFICIENTS), np.nan)
    kind[: len(part)] = part.kind
    rows = np.column_stack([part.shape, part.size, part.offset])
    solids[part.owner, _slots(part.owner, part.solid_start)] = rows
    counts = np.diff(part.piece_start)
    if (counts > MAX_PIECES).any():
        raise GenerationError(
            f"a mover's course has {counts.max()} pieces in the {end_s - begin_s:g} s from the "
            f"earliest scan to movers.after_s after the last, and a sample stores {MAX_PIECES}; "
            "lower after_s or the number of scans, or raise sensor_mps"
        )
    owner = np.repeat(np.arange(len(part)), counts)
    pieces = np.column_stack([part.begin_s, part.course.reshape(-1, CHANNELS * COEFFICIENTS)])
    course[owner, _slots(owner, part.piece_start)] = pieces
    return {"mover_kind": kind, "mover_solids": solids, "mover_course": course}


def _slots(owner: Ints, start: Ints) -> Ints:
    """Number items that lie owner by owner, of each anew."""
    return np.asarray(np.arange(len(owner)) - start[owner])


def stored_movers(sample: Any) -> Movers:
    """Read the movers of a sample from its tables.

    Args:
        sample: The sample.

    Returns:
        The movers, whose courses hold from the earliest scan to `after_s` after the sample's time.

    Raises:
        MissingPartError: if the sample has none.
        DatasetError: if they are damaged.
    """
    if sample.mover_kind is None:
        raise MissingPartError("this sample has no movers; generate the dataset with --movers")
    count = int(np.count_nonzero(sample.mover_kind))
    solids, course = sample.mover_solids[:count], sample.mover_course[:count]
    present, pieces = solids[:, :, 0] != NO_SHAPE, np.isfinite(course[:, :, 0])
    rows = solids[present]
    starts = np.concatenate([[0], np.cumsum(pieces.sum(axis=1))])
    movers = Movers(
        kind=sample.mover_kind[:count].astype(np.int64),
        owner=np.nonzero(present)[0],
        # a damaged table may hold any number
        shape=np.nan_to_num(rows[:, 0]).clip(NO_SHAPE, 99).astype(np.int64),
        size=rows[:, 1:4].copy(),
        offset=rows[:, 4:].copy(),
        piece_start=starts.astype(np.int64),
        begin_s=course[:, :, 0][pieces],
        course=course[pieces][:, 1:].reshape(-1, CHANNELS, COEFFICIENTS),
    )
    fault = fault_of(movers)
    numbers = sample.voxel_mover
    if not fault and not ((numbers >= -1) & (numbers < count)).all():
        fault = f"expected voxel_mover from -1 to {count - 1}"
    if fault:
        raise DatasetError(f"the sample's movers are damaged: {fault}; verify the dataset")
    return movers


def field_of(sample: Any, name: str) -> Any:
    """Read a field of a sample, or compute one that `OVER_TIME` names.

    Args:
        sample: The sample.
        name: Name of the field.

    Returns:
        Its value.

    Raises:
        MissingPartError: if the sample has no movers, or courses are not stored for so long.
    """
    match = OVER_TIME.fullmatch(name)
    if match is None:
        return getattr(sample, name)
    if match[1]:
        return getattr(sample.motion, match[1])(float(match[2]))
    return sample.motion.flow() if name == "flow" else sample.motion.moving


class SampleMotion:
    """What moves in a sample: its content at other times.

    Times are seconds after the sample's own, negative for earlier ones: from its earliest scan to
    `after_s` of the recipe's movers."""

    def __init__(self, sample: Any, *, grid: GridSpec):
        """Read the tables of a sample.

        Args:
            sample: A sample with movers.
            grid: Its grid.
        """
        self.movers, self._sample, self._grid = stored_movers(sample), sample, grid
        times = sample.scan_times
        self._now_s = float(times[0])
        self._begin_s, self._end_s = float(times.min()), float(sample.course_end)

    def at(self, after_s: float) -> float:
        """Check a time, and return it as the movers' courses have it, seconds.

        Raises:
            MissingPartError: if courses are not stored for it.
        """
        time_s = self._now_s + after_s
        if not self._begin_s <= time_s <= self._end_s:
            raise MissingPartError(
                f"{after_s:g} s after the sample's time: courses are stored from "
                f"{self._begin_s - self._now_s:g} to {self._end_s - self._now_s:g} s; generate the "
                "dataset with another movers.after_s"
            )
        return time_s

    @cached_property
    def moving(self) -> Mask:
        """(*grid.shape): voxels that a mover with a speed above 0 touches now."""
        return self.passed(0.0)

    def passed(self, after_s: float) -> Mask:
        """Voxels (*grid.shape) that a mover touches now or at a time, of those that move now or
        are elsewhere then."""
        now, then = (np.column_stack(self.movers.poses(self.at(t))) for t in (0.0, after_s))
        # five columns of places and headings, then those of velocities
        goes = (now != then)[:, :5].any(axis=1) | now[:, 5:].any(axis=1)
        # -1, no mover, picks the last entry: voxels without one do not move
        moves = np.append(goes, False)
        return np.asarray(moves[self._sample.voxel_mover] | moves[self.voxels(after_s)])

    @lru_cache(maxsize=8)  # noqa: B019 (so many maps are few; every row of the bench asks for them)
    def voxels(self, after_s: float) -> NDArray[np.int8]:
        """Which mover touches each voxel (*grid.shape) at a time; see `mover_voxels`."""
        return mover_voxels(self.movers, self._grid, self._sample.origin, self.at(after_s))

    def occupancy(self, after_s: float) -> Mask:
        """Occupied voxels (*grid.shape) at a time: those of solids that stand, and of movers."""
        return np.asarray(self._sample.static_occupancy | (self.voxels(after_s) >= 0))

    def tudf(self, after_s: float) -> Field:
        """Truncated distances (*grid.shape) at a time, metres; see `Sample.tudf`."""
        return distance_field(self.occupancy(after_s), self._grid)

    def flow(self) -> Field:
        """Velocity (*grid.shape, 3), metres a second in the world's axes, of the mover at the
        centre of each voxel that it touches; 0 elsewhere."""
        number = self._sample.voxel_mover
        flow = np.zeros((*self._grid.shape, 3), np.float32)
        position, _, speed, turn = self.movers.poses(self._now_s)
        index = np.argwhere(number >= 0)
        m = number[tuple(index.T)]
        centres = self._sample.origin + (index + 0.5) * self._grid.voxel_m
        arm, velocity = centres - position[m], speed[m].copy()
        # a turn about the mover's vertical axis
        velocity[:, 0] -= turn[m] * arm[:, 1]
        velocity[:, 1] += turn[m] * arm[:, 0]
        flow[tuple(index.T)] = velocity
        return flow
