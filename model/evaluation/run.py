"""Run the bench: every method on every test map of a dataset, reconstruction and planning, by all cores."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarsim.parameters import check, number
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, empty_split
from scenegen.model.completion.protocol import Thresholds
from scenegen.model.evaluation.difficulty import describe
from scenegen.model.evaluation.methods import Method
from scenegen.model.evaluation.metrics import METRICS
from scenegen.model.evaluation.planning.config import PlanConfig
from scenegen.model.evaluation.planning.measure import Measurement, run_trial
from scenegen.model.evaluation.planning.trials import draw_trials
from scenegen.model.evaluation.reconstruction import ReconstructionConfig, measure
from scenegen.model.evaluation.tuning import tune
from scenegen.model.evaluation.visibility import CLASSES, UNOBSERVED, classify
from scenegen.workers import run as run_workers

CHUNK = 10
"""Samples a task of a worker."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is measured, and how much of it."""

    split: str = "test"
    """The split that is measured; calibration looks at val."""
    samples: int | None = None
    """At most this many of the split's samples, evenly spread; None for all."""
    trials: int = number(2000, least=1, whole=True)
    """Valid planning trials a dataset, spread over its samples (the paper's number)."""
    seed: int = number(0, least=0, whole=True)
    """Seed of goals, bootstraps and permutations."""
    thresholds: Thresholds = field(default_factory=Thresholds)
    reconstruction: ReconstructionConfig = field(default_factory=ReconstructionConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodResult:
    """One method on one dataset, sample by sample and trial by trial."""

    reconstruction: NDArray[np.float64]
    """(N, 2 + classes, metrics): over the whole map, over its unknown voxels, then by class of voxels."""
    tuned: NDArray[np.float64]
    """(N, metrics): over the whole map, at the tuned thresholds."""
    thresholds: Thresholds
    """The tuned ones."""
    trials: tuple[Measurement, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetResult:
    """All methods on one dataset."""

    kind: str
    digest: str
    worlds: NDArray[np.int64]
    """(N,): the samples' worlds."""
    trial_worlds: NDArray[np.int64]
    """(trials,): the trials' worlds."""
    excluded: Counter[str]
    """Drawn trials that are not valid, by reason."""
    difficulty: NDArray[np.float64]
    """(N, descriptors) of the samples."""
    methods: dict[str, MethodResult]


@dataclass(frozen=True)
class _Task:
    folder: Path
    indices: tuple[int, ...]
    methods: tuple[Method, ...]
    tuned: tuple[Thresholds, ...]
    trials_each: int
    config: BenchConfig


@dataclass(frozen=True, eq=False)
class _Outcome:
    """What a task found, by sample number: worlds, metrics and trials of every method."""

    indices: tuple[int, ...]
    worlds: list[int]
    difficulty: list[NDArray[np.float64]]
    reconstruction: list[list[NDArray[np.float64]]]
    tuned: list[list[NDArray[np.float64]]]
    trials: list[list[list[Measurement]]]
    excluded: Counter[str]


def bench(
    dataset: Dataset,
    methods: Sequence[Method],
    config: BenchConfig,
    *,
    workers: int = 1,
    on_start: Callable[[int], None] = lambda total: None,
    on_done: Callable[[int], None] = lambda samples: None,
) -> DatasetResult:
    """Measure `methods` on `dataset`, with the same goals for every method.

    `on_start` is told how many samples there are, `on_done` of every few that are finished. Raises DatasetError for an
    empty split.
    """
    split = dataset.split(config.split)
    if not len(split):
        raise DatasetError(f"{dataset.folder}: {empty_split(config.split)}, or give another --split")
    count = min(config.samples or len(split), len(split))
    indices = np.unique(np.linspace(0, len(split) - 1, count).astype(int))
    tuned = tuple(tune(method, dataset, most=50, thresholds=config.thresholds) for method in methods)
    each = math.ceil(1.1 * config.trials / len(indices))
    tasks = [
        _Task(dataset.folder, tuple(part.tolist()), tuple(methods), tuned, each, config)
        for part in np.array_split(indices, math.ceil(len(indices) / CHUNK))
    ]
    outcomes = []
    for outcome in run_workers(_work, tasks, workers, lambda: on_start(len(indices))):
        outcomes.append(outcome)
        on_done(len(outcome.indices))
    outcomes.sort(key=lambda outcome: outcome.indices)
    return _gather(dataset, methods, tuned, outcomes, config)


def _work(task: _Task) -> _Outcome:
    dataset = Dataset(task.folder)
    split, grid, config = dataset.split(task.config.split), dataset.grid, task.config
    found = _Outcome(task.indices, [], [], [], [], [], Counter())
    for index in task.indices:
        sample = split[index]
        classes = classify(sample, lidar=dataset.lidar, grid=grid)
        rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(index,)))
        bounds = _world_bounds(dataset, sample.origin)
        drawn = draw_trials(sample.occupancy, grid, config.plan, count=task.trials_each, rng=rng, bounds=bounds)
        found.excluded.update(drawn.excluded)
        found.worlds.append(int(sample.world))
        found.difficulty.append(describe(sample, grid=grid, config=config.plan))
        rows, tuned_rows, trials = [], [], []
        for method, tuned in zip(task.methods, task.tuned, strict=True):
            completion = method.completion(sample, split=config.split, grid=grid, lidar=dataset.lidar)
            occupied, distance = completion.occupied(config.thresholds), completion.distance(config.thresholds, grid)
            truth = sample.occupancy, sample.tudf
            measured = partial(
                measure, classes=classes, class_count=len(CLASSES), config=config.reconstruction, union=UNOBSERVED
            )
            rows.append(measured(occupied, distance, *truth))
            if tuned == config.thresholds:
                tuned_rows.append(rows[-1][0])
            else:
                tuned_rows.append(measured(completion.occupied(tuned), completion.distance(tuned, grid), *truth)[0])
            trials.append([run_trial(occupied, distance, *truth, goal, grid, config.plan) for goal in drawn.goals])
        found.reconstruction.append(rows)
        found.tuned.append(tuned_rows)
        found.trials.append(trials)
    return found


def _world_bounds(dataset: Dataset, origin: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The drawn world's box (2, 3) in the map frame, metres; None for worlds drawn by hand."""
    world = dataset.manifest.tables.get("world")
    return None if world is None else np.array([[0.0, 0.0, 0.0], world["size_m"]]) - origin


def _gather(
    dataset: Dataset,
    methods: Sequence[Method],
    tuned: Sequence[Thresholds],
    outcomes: Sequence[_Outcome],
    config: BenchConfig,
) -> DatasetResult:
    """Tasks' outcomes as one result; of the trials, the first of every sample first, cut to the number asked for."""
    worlds = [world for outcome in outcomes for world in outcome.worlds]
    rows = [row for outcome in outcomes for row in outcome.reconstruction]
    tuned_rows = [row for outcome in outcomes for row in outcome.tuned]
    trials = [sample for outcome in outcomes for sample in outcome.trials]
    turns = sorted((turn, n) for n, sample in enumerate(trials) for turn in range(len(sample[0])))[: config.trials]
    return DatasetResult(
        kind=dataset.manifest.kind,
        digest=str(dataset.manifest.digest),
        worlds=np.array(worlds),
        trial_worlds=np.array([worlds[n] for _, n in turns], dtype=np.int64),
        difficulty=np.array([row for outcome in outcomes for row in outcome.difficulty]),
        excluded=sum((outcome.excluded for outcome in outcomes), start=Counter()),
        methods={
            method.name: MethodResult(
                reconstruction=np.array([row[m] for row in rows]),
                tuned=np.array([row[m] for row in tuned_rows]).reshape(-1, len(METRICS)),
                thresholds=tuned[m],
                trials=tuple(trials[n][m][turn] for turn, n in turns),
            )
            for m, method in enumerate(methods)
        },
    )
