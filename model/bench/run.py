"""Run the bench: every method on every test map of a dataset, reconstruction and planning, by all
cores.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Field, Floats, Ints, Mask
from scenegen.base.errors import DatasetError, MissingPartError, empty_split
from scenegen.base.executors import Counted, Executor, check_together, chunked, counted, unheard
from scenegen.base.workers import ALONE
from scenegen.dataset.read import AnyDataset, Rows, Split
from scenegen.draw.sample import rng_of
from scenegen.model.bench.methods import Method, answers, check_rows, tune
from scenegen.model.bench.metrics import (
    METRICS,
    PLAN_METRICS,
    Metric,
    ScoredMap,
    find_metrics,
    measure,
    metrics_of,
)
from scenegen.model.bench.reliability import count_map
from scenegen.model.bench.trials import (
    Measurement,
    Trials,
    draw_trials,
    line_blocked,
    risk_of,
    run_trial,
)
from scenegen.model.bench.visibility import CLASSES, UNOBSERVED, UNSCORED, Case, walled
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import HORIZONS, BenchConfig, PlanConfig, Thresholds
from scenegen.model.targets import Target, targets_of, truth_of
from scenegen.truth import distance_field
from scenegen.view.look import evenly

CHUNK = 10
"""Samples a task of a worker."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodResult:
    """One method on one dataset, sample by sample and trial by trial."""

    reconstruction: Floats
    """(N, 3 + classes, metrics): over the whole map, over its unknown voxels, then by class of
    voxels; and last over the whole map again, at the tuned thresholds. Of a method that draws, the
    means over its draws."""
    thresholds: Thresholds
    """The tuned ones."""
    trials: tuple[Measurement, ...]
    unmarked: tuple[Measurement, ...] = ()
    """The same trials in maps of real places, planned without knowing which voxels are unknown in
    the map: in `trials`, the planner holds these for occupied. () where all is known."""
    learned: bool
    """Whether the method was trained, or may have been: see `Method.learned`."""
    probabilities: list[Floats]
    """Of every map, see `scenegen.model.bench.reliability.count`; empty unless asked for."""
    best: Floats | None = None
    """(N, metrics): of a method that draws, the best of its draws, over the whole map."""
    metrics: Mapping[str, Metric] = field(default_factory=lambda: METRICS)
    """The metrics of `reconstruction`, by name."""

    @property
    def without_marks(self) -> "MethodResult":
        """The method with the trials of `unmarked`."""
        return replace(self, trials=self.unmarked)

    def values(self, metric: str, region: int = 0) -> Floats:
        """Return the values of a metric.

        Args:
            metric: Its name.
            region: Row of `reconstruction`, for a metric of maps.

        Returns:
            (N,) of every map, or (trials,) of every trial.
        """
        if metric in PLAN_METRICS:
            return np.array([PLAN_METRICS[metric].of(trial) for trial in self.trials], float)
        return self.reconstruction[:, region, [*self.metrics].index(metric)]


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetResult:
    """All methods on one dataset."""

    kind: str
    dataset: AnyDataset
    config: BenchConfig
    numbers: Sequence[int]
    """(N,): the samples' numbers in the split."""
    worlds: Ints
    """(N,): the samples' worlds."""
    known_share: float
    """The mean share of a sample's voxels that are known: 1 but for maps of real places."""
    trial_worlds: Ints
    """(trials,): the trials' worlds."""
    trial_places: tuple[tuple[int, int], ...]
    """Each trial's sample by its number in the split, and the trial's own number within the
    sample."""
    excluded: Counter[str]
    """Drawn trials that are not valid, by reason."""
    methods: dict[str, MethodResult]
    without_truth: tuple[str, ...] = ()
    """Predicted targets whose metrics are not measured: the dataset lacks a part for the truth."""

    @property
    def metrics(self) -> Mapping[str, Metric]:
        """The metrics of maps, by name."""
        return next(iter(self.methods.values())).metrics

    @property
    def marks_unknown(self) -> bool:
        """True for maps of real places, planned twice: see `MethodResult.unmarked`."""
        return any(method.unmarked for method in self.methods.values())

    def worlds_of(self, metric: str) -> Ints:
        """Worlds of the values that `MethodResult.values` returns for a metric."""
        return self.trial_worlds if metric in PLAN_METRICS else self.worlds


class _MethodOnSample(NamedTuple):
    """Results of one method on one sample; see `MethodResult`."""

    reconstruction: Floats
    """(3 + classes, metrics)"""
    best: Floats | None
    """(metrics,)"""
    trials: list[Measurement]
    unmarked: list[Measurement]
    probabilities: Floats | None
    """See `scenegen.model.bench.reliability.count`; None unless asked for."""


class _SampleResult(NamedTuple):
    """Results of all methods on one sample."""

    number: int
    """The sample's in its split."""
    world: int
    known_share: float
    excluded: Counter[str]
    methods: list[_MethodOnSample]


def check_middle(
    dataset: AnyDataset, instead: str = "bench datasets whose maps lie around the sensor"
) -> None:
    """Check that maps lie around the sensor, since plans begin in their middle.

    Args:
        dataset: The dataset.
        instead: Advice that ends the error's message.

    Raises:
        DatasetError: They lie elsewhere.
    """
    for mapping in (sensing.mapping for sensing in dataset.settings):
        if not mapping.centred:
            raise DatasetError(
                f"{dataset.name}: its maps lie {list(mapping.map_ahead_m)} m ahead of the "
                f"sensor, and plans begin in a map's middle; {instead}"
            )


def check_whole(dataset: AnyDataset, instead: str) -> None:
    """Check that all of every map is known.

    Args:
        dataset: The dataset.
        instead: Advice that ends the error's message.

    Raises:
        DatasetError: These are maps of real places.
    """
    if any(part.manifest.known is not None for part in dataset.datasets):
        raise DatasetError(
            f"{dataset.name}: its samples are of maps of real places, which do not know all; "
            f"{instead}"
        )


def filled(dataset: AnyDataset, split: str) -> Split:
    """Return a split that has samples.

    Args:
        dataset: The dataset.
        split: Name of the split.

    Returns:
        The split.

    Raises:
        DatasetError: It is empty.
    """
    samples = dataset.split(split)
    if not len(samples):
        raise DatasetError(f"{dataset.name}: {empty_split(split)}, or give another --split")
    return samples


def bench(
    dataset: AnyDataset,
    methods: Sequence[Method],
    config: BenchConfig,
    *,
    kind: str | None = None,
    execute: Executor = ALONE,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
) -> DatasetResult:
    """Measure methods on a dataset, with the same goals for every method.

    Args:
        dataset: The dataset.
        methods: The methods.
        config: Figures to measure, and on how many samples and trials.
        kind: Measure only samples of this kind of worlds.
        execute: Measures a few samples at a time.
        on_start: Called with the number of samples once the work has begun.
        on_done: Called with the number of samples of each part that is done.

    Returns:
        The results of all methods.

    Raises:
        DatasetError: The split is empty, or `execute` leaves samples to other processes: a report
            is of all of them.
    """
    split = filled(dataset, config.split)
    check_middle(dataset)
    if config.reliability:
        check_whole(dataset, "leave --reliability out")
    kind = kind or dataset.kind
    of_kind = split.by_kind().get(kind)
    if of_kind is None:
        raise DatasetError(f"{dataset.name}: holds no {kind} in its {config.split} split")
    numbers = [of_kind[n] for n in evenly(len(of_kind), config.samples or len(of_kind))]
    tasks = [Rows(config.split, part) for part in chunked(numbers, CHUNK)]
    check_together(execute, "a report takes")
    # here and not in the workers: each would complete the validation maps again
    tuned = [tune(method, dataset, config.thresholds) for method in methods]
    targets = measured_targets(methods, config, split, numbers[0])
    predicted = {
        name
        for method in methods
        for name, target in getattr(method, "targets", {}).items()
        if target.metrics
    }
    metrics = metrics_of(targets, config.metrics)
    # a tenth more than asked for: not every sample has as many valid goals
    trials_each = math.ceil(1.1 * config.trials / len(numbers))
    work = partial(_bench_samples, dataset, methods, tuned, targets, trials_each, config)
    chunks = counted(execute, work, tasks, total=len(numbers), on_start=on_start, on_done=on_done)
    # in the split's order, whichever worker was first: reports are the same on every machine
    samples = sorted(chain.from_iterable(chunks), key=lambda sample: sample.number)
    # (trial's number within its sample, sample): first trials come first, so that a cut to the
    # number asked for leaves all samples about as many
    trials = sorted(
        (trial, n)
        for n, sample in enumerate(samples)
        for trial in range(len(sample.methods[0].trials))
    )[: config.trials]
    by_method = zip(*(sample.methods for sample in samples), strict=True)
    return DatasetResult(
        kind=kind,
        dataset=dataset,
        config=config,
        numbers=[sample.number for sample in samples],
        worlds=np.array([sample.world for sample in samples]),
        known_share=float(np.mean([sample.known_share for sample in samples])),
        trial_worlds=np.array([samples[n].world for _, n in trials], np.int64),
        trial_places=tuple((samples[n].number, trial) for trial, n in trials),
        excluded=sum((sample.excluded for sample in samples), start=Counter()),
        methods={
            method.name: _joined(method, best, metrics, results, trials)
            for method, best, results in zip(methods, tuned, by_method, strict=True)
        },
        without_truth=tuple(sorted(predicted - targets.keys())),
    )


def measured_targets(
    methods: Sequence[Method], config: BenchConfig, split: Split, index: int
) -> dict[str, Target]:
    """Find the targets whose metrics are measured on a dataset: occupancy at later times, of those
    with movers, and others.

    Args:
        methods: Methods, whose targets count as far as the dataset has their truth.
        config: Names further targets.
        split: The split.
        index: Number of a sample by which the dataset's arrays are known.

    Returns:
        Targets by name, those with metrics only.

    Raises:
        DatasetError: The dataset lacks the truth of a named target, or a truth is not a map.
        OwnCodeError: A target's code failed.
    """
    named = find_metrics(config.metrics)[1]
    targets, sample, grid = targets_of(HORIZONS), split[index], split.dataset.grid
    for method in methods:
        targets |= getattr(method, "targets", {})
    measured = dict[str, Target]()
    for name, target in (targets | named).items():
        if target.metrics:
            # a method may predict more than the dataset has; what the user names, it must have
            try:
                truth_of(target, name, sample, grid)
            except MissingPartError as error:
                if name in named:
                    raise DatasetError(
                        f"{split.dataset.name}: has no truth of the target {name} ({error})"
                    ) from None
            else:
                measured[name] = target
    return measured


def _joined(
    method: Method,
    tuned: Thresholds,
    metrics: Mapping[str, Metric],
    results: Sequence[_MethodOnSample],
    trials: Sequence[tuple[int, int]],
) -> MethodResult:
    """The result of a method from its results on all samples. Of `trials`, each the number of a
    trial within its sample and the number of that sample, all others are left out."""
    return MethodResult(
        reconstruction=np.array([result.reconstruction for result in results]),
        thresholds=tuned,
        trials=tuple(results[n].trials[trial] for trial, n in trials),
        unmarked=tuple(results[n].unmarked[trial] for trial, n in trials if results[n].unmarked),
        learned=method.learned,
        probabilities=[
            result.probabilities for result in results if result.probabilities is not None
        ],
        best=None if results[0].best is None else np.array([result.best for result in results]),
        metrics=metrics,
    )


def bench_all(
    datasets: Sequence[AnyDataset],
    methods: Sequence[Method],
    config: BenchConfig,
    *,
    execute: Executor,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
) -> list[DatasetResult]:
    """Measure methods on every kind of worlds of some datasets.

    Args:
        datasets: The datasets.
        methods: The methods.
        config: Figures to measure, and on how many samples and trials.
        execute: Measures a few samples at a time.
        on_start: Called for each kind, see `bench`.
        on_done: Called for each kind, see `bench`.

    Raises:
        DatasetError: A file of predictions is not of all datasets, two datasets have samples of one
            kind, or as in `bench`.
    """
    # before hours of work: a file of predictions may lack the last dataset
    check_rows(methods, datasets, config.split)
    tables = [
        (dataset, kind)
        for dataset in datasets
        # one without samples is refused when it is measured
        for kind in dataset.split(config.split).by_kind() or (dataset.kind,)
    ]
    kinds = [kind for _, kind in tables]
    if len(set(kinds)) < len(kinds):
        raise DatasetError(
            f"two datasets of one kind ({', '.join(kinds)}): the tables hold one a kind; give one "
            f"of each"
        )
    return [
        bench(
            dataset,
            methods,
            config,
            kind=kind,
            execute=execute,
            on_start=on_start,
            on_done=on_done,
        )
        for dataset, kind in tables
    ]


def _bench_samples(
    dataset: AnyDataset,
    methods: Sequence[Method],
    tuned: Sequence[Thresholds],
    targets: Mapping[str, Target],
    trials_each: int,
    config: BenchConfig,
    rows: Rows,
) -> list[_SampleResult]:
    """Measure all methods, each with its tuned thresholds, on the samples `rows` of a dataset, with
    `trials_each` planning trials on each, and the metrics of `targets`, too."""
    split, measured = dataset.split(rows.split), []
    metrics = metrics_of(targets, config.metrics)  # by name: not all metrics can be pickled
    for index in rows.numbers:
        sample = split[index]
        case = Case(sample, index, split)
        # by seed and sample, so that goals do not depend on how samples are shared out
        drawn = trials_of(case, config.plan, trials_each, rng_of(config.seed, index))
        truth = true_maps(case, targets)
        results = [
            _bench_method(method, best, case, truth, metrics, drawn.goals, config)
            for method, best in zip(methods, tuned, strict=True)
        ]
        known_share = 1.0 if sample.known is None else float(sample.known.mean())
        excluded = Counter(drawn.excluded)
        measured.append(_SampleResult(index, int(sample.world), known_share, excluded, results))
    return measured


def true_maps(case: Case, targets: Mapping[str, Target]) -> dict[str, NDArray[Any]]:
    """Return the truth of occupancy, distances and further targets of a sample.

    Args:
        case: The sample.
        targets: Further targets by name.

    Returns:
        (*grid.shape) or (channels, *grid.shape), by target.
    """
    sample = case.sample
    truth: dict[str, NDArray[Any]] = {"occupancy": sample.occupancy, "tudf": sample.tudf}
    return truth | {
        name: truth_of(target, name, sample, case.grid) for name, target in targets.items()
    }


def scored_map(
    prediction: Prediction, case: Case, truth: Mapping[str, NDArray[Any]], at: Thresholds
) -> ScoredMap:
    """Put a prediction beside the truth of its sample.

    Args:
        prediction: The prediction.
        case: The sample.
        truth: From `true_maps`.
        at: Thresholds of the prediction.

    Returns:
        The pair, without the voxels that do not count.
    """
    return ScoredMap(
        prediction=prediction,
        truth=truth,
        grid=case.grid,
        thresholds=at,
        scored=case.classes != UNSCORED,
        certain=case.certain,
        sample=case.sample,
    )


def _bench_method(
    method: Method,
    tuned: Thresholds,
    case: Case,
    truth: Mapping[str, NDArray[Any]],
    metrics: Mapping[str, Metric],
    goals: Floats,
    config: BenchConfig,
) -> _MethodOnSample:
    """Measure one method on one sample: its map at the usual and at its `tuned` thresholds, its
    paths to `goals` (trials, 3), metres in the map's frame; if asked for, its probabilities. Paths
    and probabilities are those of the first draw."""
    sample, usual = case.sample, config.thresholds
    drawn = answers(method, sample, case.split, config.seed, case.index, draws=config.draws)

    def scores(prediction: Prediction, at: Thresholds) -> Floats:
        """Measure the map at some thresholds.

        Args:
            prediction: The prediction.
            at: Its thresholds.

        Returns:
            (2 + classes, metrics), see `measure`.
        """
        return measure(
            scored_map(prediction, case, truth, at),
            metrics,
            classes=case.classes,
            class_count=len(CLASSES),
            union=UNOBSERVED,
        )

    tables = []
    for prediction in drawn:
        # most often, these are the same
        by_thresholds = {at: scores(prediction, at) for at in {usual, tuned}}
        tables.append(np.vstack([by_thresholds[usual], by_thresholds[tuned][:1]]))
    reconstruction, best = tables[0], None
    if getattr(method, "draws", False):
        reconstruction, best = _over_draws(np.array(tables), metrics)
    trials = plan_all(drawn[0], case, goals, config)
    unmarked = []
    if sample.known is not None:
        unmarked = plan_all(drawn[0], case, goals, config, marked=False)
    probabilities = count_map(drawn[0], case) if config.reliability else None
    return _MethodOnSample(reconstruction, best, trials, unmarked, probabilities)


def _over_draws(tables: Floats, metrics: Mapping[str, Metric]) -> tuple[Floats, Floats]:
    """Return the means over draws of (draws, rows, metrics), without NaN, as (rows, metrics), and
    of the first row each metric's best draw, (metrics,)."""
    # a draw may have nothing to measure where another has
    masked = np.ma.masked_invalid(tables)
    distances = {"higher": np.negative, "lower": np.positive, "nearer to 0": np.abs}
    best = np.full(len(metrics), np.nan)
    for column, metric in enumerate(metrics.values()):
        values = masked[:, 0, column].compressed()
        if len(values):
            best[column] = values[distances[metric.better](values).argmin()]
    return masked.mean(axis=0).filled(np.nan), best


def plan_all(
    prediction: Prediction, case: Case, goals: Floats, config: BenchConfig, *, marked: bool = True
) -> list[Measurement]:
    """Plan to every goal of a sample on its predicted map, and judge in the truth.

    Args:
        prediction: The prediction.
        case: The sample.
        goals: (trials, 3), map frame, metres.
        config: Thresholds and planner.
        marked: See `planner_maps`.

    Returns:
        A measurement of each trial.
    """
    occupied, distance, risk = planner_maps(prediction, case, config, marked=marked)
    sample, grid, plan = case.sample, case.grid, config.plan
    obstacle, crossed = sample.occupancy.reshape(-1), sample.free.reshape(-1)
    measured = []
    for goal in goals:
        trial = run_trial(occupied, distance, *case.truth, goal, grid, plan, risk)
        hits = np.array(trial.hits, np.int64)
        hits = hits[obstacle[hits]]  # without those in unknown voxels
        measured.append(
            replace(
                trial,
                line_blocked=line_blocked(case.truth[0], goal, grid, plan),
                hits_obstacle=len(hits) > 0,
                hits_crossed_only=len(hits) > 0 and bool(crossed[hits].all()),
            )
        )
    return measured


def planner_maps(
    prediction: Prediction, case: Case, config: BenchConfig, *, marked: bool = True
) -> tuple[Mask, Field, Field | None]:
    """Make the maps that the planner gets from a prediction.

    Args:
        prediction: The prediction.
        case: The sample.
        config: Thresholds and planner.
        marked: Whether voxels that are unknown in a map of a real place are occupied, whatever is
            predicted.

    Returns:
        A collision map, distances, metres, and the risk of every voxel for the careful planner,
        (*grid.shape) each.
    """
    at, plan, careful = config.thresholds, config.plan, config.plan.planner == "careful"
    sample, grid = case.sample, case.grid
    if careful:
        at = replace(at, probability=plan.careful_probability)
    occupied, distance = prediction.occupied(at), prediction.distance(at, grid)
    # by it, methods that predict distances and those that do not are refined alike
    if plan.field == "transform":
        distance = distance_field(occupied, grid)
    # the planner is shown where the place ends, which no method can know
    if marked:
        occupied, distance = walled(occupied, distance, sample.known, grid)
    seen = sample.observed | sample.free
    return occupied, distance, risk_of(prediction, occupied, seen, plan) if careful else None


def trials_of(case: Case, plan: PlanConfig, count: int, rng: np.random.Generator) -> Trials:
    """Draw trials on the map of a sample, with goals within its world.

    Args:
        case: The sample.
        plan: The planner.
        count: How many.
        rng: Random numbers.

    Returns:
        The trials.
    """
    world = case.split.home(case.index).tables.world  # those from MJCF files have no box
    origin = case.sample.origin
    bounds = None if world is None else np.array([[0.0] * 3, world["size_m"]]) - origin
    return draw_trials(case.truth[0], case.grid, plan, count=count, rng=rng, bounds=bounds)
