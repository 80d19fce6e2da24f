"""Occupancy at later times, of datasets with movers: targets, their metrics, and rows of the bench
that say by simple rules how it goes on."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from lidarsim.grid import Floats, GridSpec, Mask, iou
from lidarsim.scan import Scan
from scenegen.base.errors import MissingPartError
from scenegen.dataset.read import Split
from scenegen.draw.sample import Sample
from scenegen.model.bench.metrics import NAN, Metric, ScoredMap
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import HORIZONS
from scenegen.model.targets import Occupancy
from scenegen.truth import distance_field

RAYS = 4
"""Rays of the other scan about a point that must all go on behind it."""
BEHIND_M = 0.3
"""How far behind it, metres."""
CELL_M = 0.1
"""Edge of the cells by which returns are linked, metres: all pairs of many would fill memory."""
LINK_M = 0.6
"""Points at most this far apart are of one mover, metres."""
FASTEST_MPS = 8.0
"""The greatest speed of a mover, metres a second."""
NEAR_M = 0.6
"""How near to the way of a mover free voxels count in the IoU of movers, metres."""


class Later(Occupancy):
    """Occupancy some time after the sample's: movers have moved. Outputs are logits."""

    part = ""

    def __init__(self, after_s: float):
        """Fix the time.

        Args:
            after_s: How long after the sample's time, seconds.
        """
        self.after_s, self.end = after_s, f"+{after_s:g}"

    @property
    def metrics(self) -> Mapping[str, Metric]:  # type: ignore[override]
        """IoU over all scored voxels, and over those of them about movers."""
        title, about = f"IoU after {self.after_s:g} s", partial(self.iou, about=True)
        moving = f"{title}, about movers"
        return {
            "iou": Metric(title, self.iou),
            # validation has no samples
            "moving_iou": Metric(moving, about, tested=("map",), bench_only=True),
        }

    def iou(self, scored_map: ScoredMap, *, about: bool = False) -> float:
        """Compute the IoU at that time. The answer of a method that predicts nothing for it is its
        occupancy now.

        Args:
            scored_map: The map and its truth.
            about: Whether only voxels `about_movers` count.

        Returns:
            From 0 to 1; NaN without such voxels.
        """
        name, counted = f"occupancy{self.end}", scored_map.scored
        if about:
            counted = counted & about_movers(scored_map.sample, self.after_s)
        predicted = scored_map.prediction.others.get(name, scored_map.occupied)
        predicted = predicted > np.float32(scored_map.thresholds.probability)
        if not counted.any():
            return NAN
        return iou(predicted[counted], scored_map.truth[name][counted])

    def truth(self, sample: Sample, grid: GridSpec) -> NDArray[Any]:
        """Compute the occupancy at that time.

        Args:
            sample: The sample.
            grid: Its grid; not used.

        Returns:
            Mask (*grid.shape).

        Raises:
            MissingPartError: It has no movers, or courses are not stored for so long.
        """
        return sample.motion.occupancy(self.after_s)


def about_movers(sample: Any, after_s: float) -> Mask:
    """Voxels that a moving mover touches now or at a later time, and those near them that nothing
    which stands occupies: there, who calls too much occupied pays for it.

    Args:
        sample: A sample with movers.
        after_s: Seconds after its time.

    Returns:
        Mask (*grid.shape).
    """
    passed = sample.motion.passed(after_s)
    near = distance_field(passed, sample.grid) <= NEAR_M
    return np.asarray(passed | (near & ~sample.static_occupancy))


OverTime = Callable[[float], Mask]
"""Occupancy (*grid.shape) as a function of the seconds after a sample's time."""


@dataclass(frozen=True)
class Rule:
    """A row that says occupancy now and at later times by a rule."""

    name: str
    rule: Callable[[Sample], OverTime]
    """Of module level, since rows travel to processes."""
    learned: bool = False

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`.

        Args:
            sample: The sample.
            split: Its split; not used.

        Returns:
            Its occupancy now, and at `HORIZONS` as far as courses are stored.

        Raises:
            MissingPartError: The rule needs what the sample lacks.
        """
        later, others = self.rule(sample), dict[str, Mask]()
        with suppress(MissingPartError):
            for name, after_s in HORIZONS.items():
                others[name] = later(after_s)
        return Prediction(later(0.0).astype(np.float32), others=others)


def moved(sample: Sample) -> OverTime:
    """The truth, also at later times: the ceiling."""
    return sample.motion.occupancy


def flow(sample: Any) -> OverTime:
    """The truth now, of which each voxel of a mover goes straight on at its velocity."""
    velocity, moving = sample.motion.flow(), sample.voxel_mover >= 0
    centres, still = sample.grid.centres(sample.origin)[moving], sample.static_occupancy
    return lambda after_s: still | _holding([centres + after_s * velocity[moving]], sample)


def tracked(sample: Sample) -> OverTime:
    """The returns, of which those that moved between the last two scans go straight on: by
    observations alone.

    Returns have come if the scan before saw on behind their place, and have left if the latest scan
    sees on behind it. A group that came and a group that left are one mover if each is the nearest
    of the other. All other returns stay."""
    movers = tracks(sample)
    # a return of what stands still may share a voxel with one that moved, and is left out, too
    gone = _holding([points for came, _, left in movers for points in (came, left)], sample)
    still = sample.observed & ~gone
    return lambda after_s: still | _holding([p + after_s * v for p, v, _ in movers], sample)


MOVED, FLOW, TRACKED = (partial(Rule, rule.__name__, rule) for rule in (moved, flow, tracked))
"""The rows, made without arguments."""


def tracks(sample: Sample) -> list[tuple[Floats, Floats, Floats]]:
    """Find what moved between the last two scans of a sample.

    Args:
        sample: The sample.

    Returns:
        Of each mover: its returns in the latest scan (n, 3), metres in the world; its velocity
        (3,), metres a second; and its returns in the scan before (m, 3).

    Raises:
        MissingPartError: The sample lacks a second scan, or the times of scans.
    """
    scans, times_s = sample.scans()[:2], sample.scan_times
    if times_s is None or len(scans) < 2:
        raise MissingPartError(
            "the row tracked needs the times of two scans; generate the dataset with --movers and "
            "--scans 2"
        )
    elapsed_s = times_s[0] - times_s[1]
    came, left = (_moved(*pair) for pair in (scans, scans[::-1]))
    # two scans at the begin of a flight may be one
    if not (came and left and elapsed_s > 0):
        return []
    now, before = (np.array([group.mean(axis=0) for group in groups]) for groups in (came, left))
    away = cdist(now, before)
    return [
        (came[n], (now[n] - before[m]) / elapsed_s, left[m])
        for n, m in enumerate(away.argmin(axis=1))
        if away[:, m].argmin() == n and away[n, m] <= FASTEST_MPS * elapsed_s
    ]


def _moved(scan: Scan, other: Scan) -> list[Floats]:
    """Groups (n, 3) of returns of a scan behind which all rays of the other about them go on."""
    points = scan.points()
    ways = points - other.pose.position
    distances = np.linalg.norm(ways, axis=1, keepdims=True)
    ends = np.minimum(other.ranges, other.lidar.max_range_m).reshape(-1)
    _, about = KDTree(other.directions.reshape(-1, 3)).query(ways / distances, k=RAYS)
    moved = points[(ends[about] > distances + BEHIND_M).all(axis=1)]
    return linked(moved, cell_m=CELL_M)


def linked(points: Floats, link_m: float = LINK_M, cell_m: float = 0.0) -> list[Floats]:
    """Divide points into groups.

    Args:
        points: (n, 3), metres.
        link_m: Points at most this far apart are of one group, metres.
        cell_m: If above 0, points are linked by the corners of the cells of this size that hold
            them, which is faster where many are in one, metres.

    Returns:
        The points of each group, (m, 3).
    """
    if not len(points):
        return []
    corners, of_corner = points, np.arange(len(points))
    if cell_m:
        cells = np.floor(points / cell_m)
        corners, of_corner = np.unique(cells, axis=0, return_inverse=True)
        corners = corners * cell_m
    tree = KDTree(corners)
    count, member = connected_components(tree.sparse_distance_matrix(tree, link_m))
    return [points[member[of_corner] == n] for n in range(count)]


def _holding(groups: Sequence[Floats], sample: Any) -> Mask:
    """Voxels (*grid.shape) that hold points, given in groups (n, 3), in the world."""
    held = np.zeros(sample.grid.shape, bool)
    for points in groups:
        index = sample.grid.index(points, sample.origin)
        held[tuple(index[((index >= 0) & (index < held.shape)).all(axis=1)].T)] = True
    return held
