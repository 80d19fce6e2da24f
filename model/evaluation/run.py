"""Run the bench: every method on every test map of a dataset, reconstruction and planning, by all
cores."""

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from scenegen.cli.show import Showing, counted, silent
from scenegen.dataset.read import Dataset, Rows, Split
from scenegen.display.look import evenly
from scenegen.errors import DatasetError, empty_split
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import BenchConfig, Thresholds
from scenegen.model.evaluation.methods import Method, check_rows
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS, measure
from scenegen.model.evaluation.planning.measure import (
    Measurement,
    Trials,
    draw_trials,
    risk_of,
    run_trial,
)
from scenegen.model.evaluation.study import Study, study_map
from scenegen.model.evaluation.visibility import (
    CLASSES,
    UNOBSERVED,
    certain_distances,
    classify,
    scored_voxels,
    seen_occupancy,
    walled,
)
from scenegen.run import Executor, check_together
from scenegen.run.workers import ALONE
from scenegen.sample import Sample, rng_of
from scenegen.truth import distance_field

CHUNK = 10
"""Samples a task of a worker."""
TUNED = 50
"""Validation samples on which thresholds are tuned, at most."""
PROBABILITIES = np.arange(0.05, 1.0, 0.05)
DISTANCES_M = np.arange(0.05, 0.85, 0.05)


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodResult:
    """One method on one dataset, sample by sample and trial by trial."""

    reconstruction: Floats
    """(N, 3 + classes, metrics): over the whole map, over its unknown voxels, then by class of
    voxels; and last over the whole map again, at the tuned thresholds."""
    thresholds: Thresholds
    """The tuned ones."""
    trials: tuple[Measurement, ...]
    learned: bool
    """Whether the method was trained, or may have been: see `Method.learned`."""
    studies: tuple[Study, ...]
    """By sample; () unless asked for."""
    careful: list[Floats]
    """(settings, figures) of each trial that was studied."""

    def values(self, metric: str, region: int = 0) -> Floats:
        """A metric by its name: of every map, (N,), over a region of `reconstruction`, or of every
        trial, (trials,)."""
        if metric in PLAN_METRICS:
            return np.array([PLAN_METRICS[metric].of(trial) for trial in self.trials], float)
        return self.reconstruction[:, region, [*METRICS].index(metric)]


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetResult:
    """All methods on one dataset."""

    kind: str
    dataset: Dataset
    config: BenchConfig
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

    def worlds_of(self, metric: str) -> Ints:
        """The worlds of what `MethodResult.values` gives."""
        return self.trial_worlds if metric in PLAN_METRICS else self.worlds


class _OfMap(NamedTuple):
    """What one method gave on one sample; see `MethodResult`."""

    reconstruction: Floats
    trials: list[Measurement]
    study: Study | None
    """None unless asked for."""


class _Found(NamedTuple):
    """What one sample gave."""

    number: int
    world: int
    known_share: float
    excluded: Counter[str]
    methods: list[_OfMap]


def check_middle(
    dataset: Dataset, instead: str = "bench datasets whose maps lie around the sensor"
) -> None:
    """Raise DatasetError, with what to do `instead`, where plans, which begin in a map's middle,
    would not begin at the sensor."""
    for _, mapping, _ in dataset.settings:
        if not mapping.centred:
            raise DatasetError(
                f"{dataset.folder}: its maps lie {list(mapping.map_ahead_m)} m ahead of the "
                f"sensor, and plans begin in a map's middle; {instead}"
            )


def check_whole(dataset: Dataset, instead: str) -> None:
    """Raise DatasetError, with what to do `instead`, for maps of real places, of which not all is
    known."""
    if dataset.manifest.known is not None:
        raise DatasetError(
            f"{dataset.folder}: its samples are of maps of real places, which do not know all; "
            f"{instead}"
        )


def filled(dataset: Dataset, split: str) -> Split:
    """A split of a dataset. Raises DatasetError where it is empty."""
    found = dataset.split(split)
    if not len(found):
        raise DatasetError(f"{dataset.folder}: {empty_split(split)}, or give another --split")
    return found


def bench(
    dataset: Dataset,
    methods: Sequence[Method],
    config: BenchConfig,
    *,
    kind: str | None = None,
    execute: Executor = ALONE,
    progress: Showing = silent,
) -> DatasetResult:
    """Measure `methods` on `dataset`, or on its samples of one `kind` of worlds, with the same
    goals for every method.

    `execute` has a few samples measured at a time, and `progress` shows how many are. Raises
    DatasetError for an empty split, and where `execute` leaves samples to others: a report is of
    all of them.
    """
    split = filled(dataset, config.split)
    check_middle(dataset)
    if config.study:
        check_whole(dataset, "leave --study out")
    kind = kind or dataset.manifest.graded
    ours = split.by_kind().get(kind)
    if ours is None:
        raise DatasetError(f"{dataset.folder}: holds no {kind} in its {config.split} split")
    indices = [ours[n] for n in evenly(len(ours), config.samples or len(ours))]
    tasks = [Rows(config.split, indices[n : n + CHUNK]) for n in range(0, len(indices), CHUNK)]
    check_together(execute, "a report takes")
    tuned = [tune(method, dataset, config.thresholds) for method in methods]
    work = partial(
        _work, dataset.folder, methods, tuned, math.ceil(1.1 * config.trials / len(indices)), config
    )
    several = counted(execute, progress, work, tasks, kind, len(indices))
    found: list[_Found] = sorted(chain.from_iterable(several), key=lambda one: one.number)
    # of the trials, the first of every sample first, cut to the number asked for
    turns = sorted(
        (turn, n) for n, one in enumerate(found) for turn in range(len(one.methods[0].trials))
    )[: config.trials]

    def of_method(m: int) -> MethodResult:
        """What all samples gave of one method."""
        given = [one.methods[m] for one in found]
        studies = tuple(one.study for one in given if one.study is not None)
        return MethodResult(
            reconstruction=np.array([one.reconstruction for one in given]),
            thresholds=tuned[m],
            trials=tuple(given[n].trials[turn] for turn, n in turns),
            learned=methods[m].learned,
            studies=studies,
            careful=[studies[n].careful[turn] for turn, n in turns if studies],
        )

    return DatasetResult(
        kind=kind,
        dataset=dataset,
        config=config,
        worlds=np.array([one.world for one in found]),
        known_share=float(np.mean([one.known_share for one in found])),
        trial_worlds=np.array([found[n].world for _, n in turns], np.int64),
        trial_places=tuple((found[n].number, turn) for turn, n in turns),
        excluded=sum((one.excluded for one in found), start=Counter()),
        methods={method.name: of_method(m) for m, method in enumerate(methods)},
    )


def bench_all(
    datasets: Sequence[Dataset],
    methods: Sequence[Method],
    config: BenchConfig,
    *,
    execute: Executor,
    progress: Showing = silent,
) -> list[DatasetResult]:
    """Measure `methods` on every kind of worlds in `datasets`; `progress` shows how many samples of
    it are finished.

    Raises DatasetError where a file of predictions is not of all datasets, and where two datasets
    have samples of one kind; and as `bench` does.
    """
    check_rows(methods, datasets, config.split)
    tables = [
        (dataset, kind)
        for dataset in datasets
        # one without samples is refused when it is measured
        for kind in dataset.split(config.split).by_kind() or (dataset.manifest.graded,)
    ]
    kinds = [kind for _, kind in tables]
    if len(set(kinds)) < len(kinds):
        raise DatasetError(
            f"two datasets of one kind ({', '.join(kinds)}): the tables hold one a kind; give one "
            f"of each"
        )
    return [
        bench(dataset, methods, config, kind=kind, execute=execute, progress=progress)
        for dataset, kind in tables
    ]


def _work(
    folder: Path,
    methods: Sequence[Method],
    tuned: Sequence[Thresholds],
    trials_each: int,
    config: BenchConfig,
    rows: Rows,
) -> list[_Found]:
    dataset = Dataset(folder)
    split, grid, usual = dataset.split(rows.split), dataset.grid, config.thresholds
    found = []
    for index in rows.numbers:
        sample = split[index]
        truth = sample.occupancy, sample.tudf
        scored = scored_voxels(sample, grid, split.home(index).tables)
        classes = classify(sample, grid=grid, scored=scored)
        certain = certain_distances(sample, grid)
        solid, gap = walled(*truth, sample.known, grid)
        drawn = trials_of(sample, index, split, config, trials_each)
        trial = partial(
            run_trial, occupancy_truth=solid, tudf_truth=gap, grid=grid, config=config.plan
        )
        seen = seen_occupancy(sample, split) if config.study else None
        given = []
        for method, best in zip(methods, tuned, strict=True):
            said = method.completion(sample, split)
            maps = {at: (said.occupied(at), said.distance(at, grid)) for at in {usual, best}}
            figures = {
                at: measure(
                    *maps[at],
                    *truth,
                    classes=classes,
                    class_count=len(CLASSES),
                    union=UNOBSERVED,
                    certain=certain,
                )
                for at in maps
            }
            occupied, distance, risk = planner_maps(said, sample, grid, config)
            trials = [trial(occupied, distance, goal=goal, risk=risk) for goal in drawn.goals]
            study = None
            if seen is not None:
                study = study_map(
                    said,
                    maps[usual][1],
                    sample,
                    classes=classes,
                    seen=seen,
                    goals=drawn.goals,
                    grid=grid,
                    config=config,
                )
            given.append(_OfMap(np.vstack([figures[usual], figures[best][:1]]), trials, study))
        known = 1.0 if sample.known is None else float(sample.known.mean())
        found.append(_Found(index, int(sample.world), known, Counter(drawn.excluded), given))
    return found


def planner_maps(
    said: Prediction, sample: Sample, grid: GridSpec, config: BenchConfig
) -> tuple[Mask, Field, Field | None]:
    """What the planner of `config` is given of a prediction: a collision map, distances, metres,
    and for the careful planner the risk of every voxel, (*grid.shape) each."""
    at, plan, careful = config.thresholds, config.plan, config.plan.planner == "careful"
    if careful:
        at = dataclasses.replace(at, probability=plan.careful_probability)
    occupied, distance = said.occupied(at), said.distance(at, grid)
    if plan.field == "transform":
        distance = distance_field(occupied, grid)
    occupied, distance = walled(occupied, distance, sample.known, grid)
    seen = sample.observed | sample.free
    return occupied, distance, risk_of(said, occupied, seen, plan) if careful else None


def trials_of(sample: Sample, index: int, split: Split, config: BenchConfig, count: int) -> Trials:
    """The first `count` trials of `sample`, which is number `index` of its `split`."""
    rng = rng_of(config.seed, index)
    world = split.home(index).tables.get("world")  # worlds from MJCF files have no box
    bounds = None if world is None else np.array([[0.0, 0.0, 0.0], world["size_m"]]) - sample.origin
    grid = split.dataset.grid
    solid, _ = walled(sample.occupancy, sample.tudf, sample.known, grid)
    return draw_trials(solid, grid, config.plan, count=count, rng=rng, bounds=bounds)


def tune(method: Method, dataset: Dataset, thresholds: Thresholds) -> Thresholds:
    """The thresholds at which `method` has the largest mean IoU on at most `TUNED` validation
    samples, evenly spread: the same rule for every method.

    Where all do equally well, or the method says nothing about the validation split, `thresholds`
    as they are.
    """
    split = dataset.split("val")
    if not len(split):
        return thresholds
    scores: list[list[float]] = []
    name, candidates = "probability", PROBABILITIES
    for index in evenly(len(split), TUNED):
        sample = split[index]
        scored = scored_voxels(sample, dataset.grid, split.home(index).tables)
        truth = sample.occupancy[scored]
        try:
            completion = method.completion(sample, split)
        except KeyError:  # a file that predicts the test split alone
            return thresholds
        if completion.occupancy_probability is None:
            name, candidates = "distance_m", DISTANCES_M
        row = []
        for value in candidates:
            at = dataclasses.replace(thresholds, **{name: float(value)})
            occupied = completion.occupied(at)[scored]
            union = np.count_nonzero(occupied | truth)
            row.append(np.count_nonzero(occupied & truth) / union if union else 1.0)
        scores.append(row)
    means = np.mean(scores, axis=0)
    if np.ptp(means) < 1e-12:
        return thresholds
    return dataclasses.replace(
        thresholds, **{name: round(float(candidates[int(means.argmax())]), 4)}
    )
