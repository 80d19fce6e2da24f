"""Every metric once: of reconstruction, which compares a completed map with the truth (Table I),
and of planning.

One more metric of maps is an entry of `METRICS`, or a user's own, as ``--metric module:Object``.
"""

import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lidarsim.grid import Field, Floats, GridSpec, Mask
from lidarsim.jit import kernel
from lidarsim.parameters import short_repr
from scenegen.base.errors import ScenegenError, own_code
from scenegen.model.bench.statistics import Scale
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import (
    FIGURES,
    HORIZONS,
    NEAR_M,
    OWN_METRICS,
    Thresholds,
    import_named,
    target_name,
)
from scenegen.model.targets import Target, target_called

NAN = float("nan")


class Sums(NamedTuple):
    """Sums over some voxels of one map; errors are predicted less true distances, metres."""

    voxels: float
    """Voxels whose true distance is certain: the sums of errors, and those of voxels near an
    obstacle, are over these alone; hits, alarms and misses are over all."""
    error: float
    size: float
    """Absolute errors."""
    square: float
    near: float
    """Voxels near an obstacle; the next three are over these alone."""
    near_error: float
    near_size: float
    near_square: float
    hits: float
    """Voxels that are occupied and predicted to be."""
    alarms: float
    """Voxels that are predicted to be occupied, and are not."""
    misses: float
    """Voxels that are occupied, and not predicted to be."""

    def share(self, part: float, whole: float) -> float:
        """Divide two sums.

        Args:
            part: The part.
            whole: The whole.

        Returns:
            The share; 0 of nothing, and 1 where nothing is occupied and nothing predicted.
        """
        # a map without obstacles that is predicted as such is right, and 0 / 0 would punish it
        nothing = self.hits + self.alarms + self.misses == 0
        return 1.0 if nothing else part / whole if whole else 0.0


def _mean(total: float, count: float) -> float:
    return total / count if count else NAN


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoredMap:
    """A completed map beside its truth. Arrays are (*grid.shape)."""

    prediction: Prediction
    truth: Mapping[str, NDArray[Any]]
    """By target: always ``occupancy``, bool, and ``tudf``, metres; several channels come first."""
    grid: GridSpec
    thresholds: Thresholds
    scored: Mask
    """Voxels that count: above the ground's underside, and known in a map of a real place."""
    certain: Mask | None = None
    """Voxels whose true distance is certain; None: all."""
    sample: Any = None
    """The sample; None in validation."""

    @cached_property
    def occupied(self) -> Mask:
        """Voxels that are predicted to be occupied, at the thresholds."""
        return self.prediction.occupied(self.thresholds)

    @cached_property
    def distance(self) -> Field:
        """Predicted distances, metres."""
        return self.prediction.distance(self.thresholds, self.grid)


@dataclass(frozen=True)
class Metric:
    """One figure of a map, or of a trial."""

    title: str
    """What people call it."""
    of: Callable[[Any], float]
    """Its value for a `ScoredMap`, the `Sums` over a region of it, or a trial's `Measurement`, as
    `needs` says; NaN where there is nothing to measure."""
    needs: Literal["distance", "occupancy", "map", "trial", "path"] = "map"
    """Distance or occupancy: it is a function of `Sums`, which has a value in every region. Map: it
    is a function of the `ScoredMap`, and has a value for whole maps alone. Trial: all trials have a
    value. Path: only trials that found a path have one."""
    better: Literal["higher", "lower", "nearer to 0"] = "higher"
    unit: str = ""
    tested: tuple[Literal["map", "unobserved", "unmarked"], ...] = ()
    """Where methods are compared in pairs by it: over the voxels of the whole map, or the unknown
    ones; in planning, "map" means all trials, "unmarked" the trials of `MethodResult.unmarked`."""
    bench_only: bool = False
    """Whether it takes too long for validation during training."""

    @property
    def label(self) -> str:
        """Title and unit."""
        return ", ".join(filter(None, (self.title, self.unit)))

    @property
    def scale(self) -> Scale:
        """Kind of its values, which decides how intervals are computed."""
        return "outcome" if self.needs == "trial" else "amount" if self.unit else "share"


def surface(occupied: Mask, scored: Mask) -> Mask:
    """Find the occupied voxels that border on a free one.

    Args:
        occupied: Occupied voxels (*shape).
        scored: Voxels that count (*shape). Others, and those beyond the map, are no neighbours.

    Returns:
        (*shape): scored, occupied voxels with a scored, free voxel among their six neighbours.
    """
    # voxels that do not count erode nothing, as those beyond the border: nobody knows what is there
    buried = ndimage.binary_erosion(occupied | ~scored, border_value=1)
    return occupied & scored & ~buried


def chamfer(scored_map: ScoredMap) -> float:
    """Compute the symmetric chamfer distance between the predicted and the true surface, metres.

    It is the mean of two means: over predicted surface voxels of the distance to the nearest true
    one, and the reverse, between voxels' centres and without truncation. If both surfaces are
    empty, it is 0. If one is, nothing is near, and it is the diagonal of the map: left out, a
    method that predicts nothing would gain.
    """
    surfaces = [
        surface(occupied, scored_map.scored)
        for occupied in (scored_map.occupied, scored_map.truth["occupancy"])
    ]
    count = sum(mask.any() for mask in surfaces)
    if count < 2:
        return count * float(np.linalg.norm(scored_map.grid.extent_m))
    # from both sides, so that neither a surface too much nor one too few goes unnoticed
    voxels = sum(
        ndimage.distance_transform_edt(~far)[near].mean() / 2
        for near, far in (surfaces, surfaces[::-1])
    )
    return float(voxels) * scored_map.grid.voxel_m


def ghosts(scored_map: ScoredMap) -> float:
    """Compute how many of the ghosts are predicted to be occupied: voxels that hold a return of
    some scan, and nothing now.

    Returns:
        A share; NaN without ghosts.
    """
    seen = scored_map.sample.observed & ~scored_map.truth["occupancy"] & scored_map.scored
    return float(scored_map.occupied[seen].mean()) if seen.any() else NAN


METRICS = {
    "rmse": Metric("RMSE", lambda s: _mean(s.square, s.voxels) ** 0.5, "distance", "lower", "m"),
    "mae": Metric("MAE", lambda s: _mean(s.size, s.voxels), "distance", "lower", "m"),
    "near_rmse": Metric(
        "Near-RMSE",
        lambda s: _mean(s.near_square, s.near) ** 0.5,
        "distance",
        "lower",
        "m",
        tested=("map",),
    ),
    "near_mae": Metric(
        "Near-MAE",
        lambda s: _mean(s.near_size, s.near),
        "distance",
        "lower",
        "m",
        tested=("map",),
    ),
    "bias": Metric("bias", lambda s: _mean(s.error, s.voxels), "distance", "nearer to 0", "m"),
    "near_bias": Metric(
        "Near-bias", lambda s: _mean(s.near_error, s.near), "distance", "nearer to 0", "m"
    ),
    "iou": Metric(
        "IoU",
        lambda s: s.share(s.hits, s.hits + s.alarms + s.misses),
        "occupancy",
        tested=("map", "unobserved"),
    ),
    "f1": Metric(
        "F1",
        lambda s: s.share(2 * s.hits, 2 * s.hits + s.alarms + s.misses),
        "occupancy",
        tested=("map",),
    ),
    "precision": Metric("precision", lambda s: s.share(s.hits, s.hits + s.alarms), "occupancy"),
    "recall": Metric("recall", lambda s: s.share(s.hits, s.hits + s.misses), "occupancy"),
    # two distance transforms of the whole map
    "chamfer": Metric("chamfer distance", chamfer, better="lower", unit="m", bench_only=True),
}
"""Reconstruction: the paper's ten, section "Quantitative Reconstruction Results", and ours."""
PLAN_METRICS = {
    "success_blocked": Metric(
        "success, blocked line",
        lambda trial: trial.success if trial.line_blocked else NAN,
        "trial",
        tested=("map",),
    ),
    "success": Metric("success", lambda trial: trial.success, "trial", tested=("map",)),
    "hits": Metric(
        "hits", lambda trial: trial.hits_obstacle, "trial", "lower", tested=("unmarked",)
    ),
    "crossed_hits": Metric(
        "hits in crossed voxels only", lambda trial: trial.hits_crossed_only, "trial", "lower"
    ),
    "length": Metric("length", lambda trial: trial.length_m, "path", "lower", "m"),
    "min_clearance": Metric(
        "least clearance", lambda trial: trial.min_clearance_m, "path", unit="m"
    ),
    "avg_clearance": Metric(
        "mean clearance", lambda trial: trial.mean_clearance_m, "path", unit="m"
    ),
}
"""Planning: success, length and clearances are the paper's, section "Planning with Predicted
Distance Fields"; the first leads the tables, and `hits` those of maps of real places."""


def find_metrics(names: Sequence[str]) -> tuple[dict[str, Metric], dict[str, Target]]:
    """Import a user's own metrics.

    Args:
        names: Each ``module:Object``: a `Metric`, a class of one, a function of a `ScoredMap`, or a
            class of a `Target`, which brings the metrics of its own.

    Returns:
        The metrics by name, and the targets by `target_name`.

    Raises:
        ScenegenError: There is no such object, it is something else, or its name is taken.
    """
    metrics, targets = dict[str, Metric](), dict[str, Target]()
    for name in names:
        if name in HORIZONS:
            targets[name] = target_called(name)
            continue
        entry, short = import_named(OWN_METRICS, name), name.rpartition(":")[2]
        if inspect.isclass(entry):
            entry = entry()
        # its metrics are measured under the target's name, see `metrics_of`
        if isinstance(entry, Target):
            targets[target_name(name)] = entry
            continue
        metrics[short] = _own_metric(name, short, entry, metrics)
    return metrics, targets


def _own_metric(name: str, short: str, entry: Any, taken: Collection[str]) -> Metric:
    """Make a user's own metric of a `Metric` or a function. `name` is for errors, `short` that of
    its column, which is not one of `taken`."""
    if not isinstance(entry, Metric) and callable(entry):
        entry = Metric(short.replace("_", " "), entry)
    if not isinstance(entry, Metric) or entry.needs in ("trial", "path"):
        raise ScenegenError(
            f"metric {name}: expected a scenegen.model.bench.metrics.Metric of maps, a "
            "function of a map, or a Target"
        )
    hints = get_type_hints(Metric)
    for field in ("needs", "better"):
        if (value := getattr(entry, field)) not in get_args(hints[field]):
            raise ScenegenError(
                f"metric {name}: {field} = {value!a}, expected one of "
                f"{', '.join(get_args(hints[field]))}"
            )
    if short in (*METRICS, *PLAN_METRICS, *taken):
        raise ScenegenError(f"metric {name}: there is a metric called {short}; rename it")
    return entry


def metrics_of(targets: Mapping[str, Target], names: Sequence[str] = ()) -> dict[str, Metric]:
    """List the metrics of maps: `METRICS`, those of targets, and a user's own.

    Args:
        targets: Targets by name; a metric of theirs is called ``<target>_<metric>``, and is a
            `Metric` or a function of a `ScoredMap`.
        names: A user's own metrics; see `find_metrics`.

    Returns:
        The metrics by name.

    Raises:
        ScenegenError: As in `find_metrics`.
    """
    of_targets = dict[str, Metric]()
    if targets.keys() & HORIZONS.keys():
        of_targets["ghosts"] = Metric("ghosts kept", ghosts, better="lower", bench_only=True)
    for target, kind in targets.items():
        if not isinstance(kind.metrics, Mapping):
            raise ScenegenError(
                f"target {target}: metrics = {short_repr(kind.metrics)}: expected a dict of "
                "functions by name"
            )
        for name, metric in kind.metrics.items():
            short, label = f"{target}_{name}", f"{name} of the target {target}"
            of_targets[short] = _own_metric(label, short, metric, (*FIGURES, *of_targets))
    return {**METRICS, **of_targets, **find_metrics(names)[0]}


def measure(
    scored_map: ScoredMap,
    metrics: Mapping[str, Metric],
    *,
    classes: NDArray[np.uint8] | None = None,
    class_count: int = 1,
    union: Sequence[int] = (),
) -> Floats:
    """Compute the metrics of one map.

    Voxels are near an obstacle at `NEAR_M` metres or less. A map in which nothing is occupied and
    nothing predicted scores 1 in all four occupancy metrics; otherwise a ratio of nothing to
    nothing is 0. Distance metrics over no voxel are NaN.

    Args:
        scored_map: The map and its truth.
        metrics: The metrics.
        classes: Class of every voxel, below `class_count`; a larger number, such as
            `visibility.UNSCORED`, is counted nowhere. By default, scored voxels have class 0.
        class_count: Number of classes.
        union: Classes over which metrics are also computed together.

    Returns:
        (2 + class_count, metrics): over all classes, over those in `union`, and over each class.
        Metrics that need the map have a value in the first row only, and NaN elsewhere.
    """
    if classes is None:
        classes = np.where(scored_map.scored, np.uint8(0), np.uint8(class_count))
    sums, certain = np.zeros((class_count, len(Sums._fields))), scored_map.certain
    grids = (
        scored_map.occupied,
        scored_map.distance,
        scored_map.truth["occupancy"],
        scored_map.truth["tudf"],
        classes,
        np.ones(classes.shape, bool) if certain is None else certain,
    )
    # one compiled pass for all regions: metrics that do not need the map are functions of the sums
    _accumulate(*(*(grid.reshape(-1) for grid in grids), sums))
    rows = [Sums(*row.tolist()) for row in (sums.sum(axis=0), sums[list(union)].sum(axis=0), *sums)]
    # NaN stays where a metric of whole maps has no value in a region
    values = np.full((len(rows), len(metrics)), NAN)
    for column, metric in enumerate(metrics.values()):
        if metric.needs == "map":
            values[0, column] = _value(metric, scored_map)
        else:
            values[:, column] = [_value(metric, row) for row in rows]
    return values


def _value(metric: Metric, case: "ScoredMap | Sums") -> float:
    """A metric of a map or a region; a user's own code may fail, and a worker hands over no
    traceback."""
    with own_code(f"metric {metric.title}: expected a function of a map"):
        value: Any = metric.of(case)  # a user's own may return anything
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ScenegenError(
            f"metric {metric.title}: gave no number; expected one, or NaN where there is nothing "
            "to measure (is a return missing?)"
        ) from None


@kernel
def _accumulate(occupied, distance, true_occupancy, true_distance, classes, certain, sums):
    """Add up the fields of `Sums` by class, in their order: a new sum goes to the end of both."""
    for v in range(len(classes)):
        if classes[v] >= len(sums):
            continue
        row = sums[classes[v]]
        error = float(distance[v]) - float(true_distance[v])
        # in a real place, an unknown voxel may be nearer than the nearest known obstacle
        if certain[v]:
            row[0] += 1.0
            row[1] += error
            row[2] += abs(error)
            row[3] += error * error
        if certain[v] and true_distance[v] <= NEAR_M:
            row[4] += 1.0
            row[5] += error
            row[6] += abs(error)
            row[7] += error * error
        if occupied[v]:
            if true_occupancy[v]:
                row[8] += 1.0
            else:
                row[9] += 1.0
        elif true_occupancy[v]:
            row[10] += 1.0
