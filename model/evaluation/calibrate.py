"""Calibrate a network on the validation worlds of datasets: its margins, temperature and the risk
of paths."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from operator import add
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from scenegen.cli.show import Showing, counted, silent
from scenegen.dataset.parts import plain
from scenegen.dataset.read import Dataset
from scenegen.display.look import evenly
from scenegen.errors import DatasetError, raised_as
from scenegen.files import Json
from scenegen.model.calibration import (
    KEY,
    Calibration,
    away_of,
    bins,
    corrected,
    corrected_logit,
    denial,
    distance_bins,
    familiar,
)
from scenegen.model.checkpoint import CheckpointError, save_network
from scenegen.model.completion.completer import Completer, open_network
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import NEAR_M, PlanConfig, Thresholds
from scenegen.model.evaluation.run import check_middle, check_whole, filled, trials_of
from scenegen.model.evaluation.study import TOLD, Setting, run_settings
from scenegen.model.evaluation.visibility import UNOBSERVED, Case
from scenegen.run import Executor, check_together, chunked
from scenegen.run.workers import ALONE
from scenegen.sample import rng_of

RISKS = (0.5, 0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01, 0.005, 0.002, 0.001)
"""Risks that bounds are made for, as far down as the worlds allow."""
STEP_M = 0.1
"""Width of the bins of predicted distance."""
CHANCES = (0.01, 0.03, 0.1, 0.3, 0.6)
"""Edges of the bins of probability, where it is predicted."""
SCORE_M = 0.02
"""Scores are counted in steps of this, and rounded up."""
LOGIT, MOST_LOGIT = 0.05, 20.0
"""Width of the bins of logits, and where they end."""
LOGITS = np.arange(-MOST_LOGIT + 0.5 * LOGIT, MOST_LOGIT, LOGIT)
"""The middles of these bins."""
FOLDS = 5
LEVELS = np.arange(1, 21) / 20
"""Shares of validation maps at which it is kept how many returns are denied."""


def count_logits(
    probability: Field,
    occupied: Mask,
    unknown: Mask,
    class_weight: float,
) -> Ints:
    """How many of a map's `unknown` voxels have which logit, the class weight inverted: (logits,
    2), free and occupied ones apart. The arrays have one shape."""
    steps = (corrected_logit(probability[unknown], class_weight) + MOST_LOGIT) / LOGIT
    at = np.clip(steps.astype(np.int64), 0, len(LOGITS) - 1)
    return np.bincount(2 * at + occupied[unknown], minlength=2 * len(LOGITS)).reshape(-1, 2)


def fit_temperature(counts: Ints, powers: Floats) -> float:
    """The temperature (Guo et al. 2017) at which the counted logits of maps (maps, logits, 2), each
    with its power (maps,) of it, have the least negative log-likelihood."""

    def loss(log_temperature: float) -> float:
        scaled = LOGITS / np.exp(log_temperature * powers)[:, None]
        surprise = np.logaddexp(0, np.stack([scaled, -scaled], axis=2))
        return float((counts * surprise).sum())

    return math.exp(minimize_scalar(loss, bounds=(-3, 3), method="bounded").x)


def count_scores(
    distance: Field,
    chance: Field | None,
    true: Field,
    unknown: Mask,
    grid: GridSpec,
) -> Ints:
    """How many of a map's `unknown` voxels have which score: (bins, steps), from minus the
    truncation up. The arrays have one shape: predicted distances, `corrected` probabilities where
    there are some, and true distances."""
    chances = () if chance is None else CHANCES
    last = 2 * math.ceil(grid.truncation_m / SCORE_M)
    count = distance_bins(grid, STEP_M)
    said = distance[unknown]
    into = bins(said, None if chance is None else chance[unknown], STEP_M, chances, count)
    score = np.ceil((said - true[unknown]) / SCORE_M - 1e-3).astype(np.int64) + last // 2
    flat = np.bincount(
        into * (last + 1) + np.clip(score, 0, last),
        minlength=count * (len(chances) + 1) * (last + 1),
    )
    return flat.reshape(-1, last + 1)


def fit_margins(
    counts: Ints, near: Mask, risks: tuple[float, ...] = RISKS
) -> tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]:
    """Risks, and the margins for each (risks, bins), metres, from the scores (worlds, bins, steps)
    of `count_scores`, summed over the maps of a world. `near` (bins,) tells the bins of near
    voxels. Of `risks`, those remain that so many worlds can promise: at least 1 / (worlds + 1)."""
    kept = tuple(risk for risk in risks if (1 - risk) * (len(counts) + 1) <= len(counts) + 1e-9)
    summed = counts.cumsum(axis=2)
    fold = np.arange(len(counts)) % min(FOLDS, len(counts))
    groups = np.stack([np.ones_like(near), near, ~near]).astype(np.float64)  # (groups, bins)
    rows = []
    for risk in kept:
        folds = [shape(counts[fold != one].sum(axis=0), risk) for one in range(fold.max() + 1)]
        added = _added(summed, np.stack(folds)[fold], groups, risk)
        rows.append(shape(counts.sum(axis=0), risk) + added)
    middle = counts.shape[2] // 2
    steps = np.maximum.accumulate(np.minimum(rows, 2 * middle))  # a smaller risk, no nearer bound
    return kept, tuple(map(tuple, np.round(SCORE_M * (steps - middle), 6).tolist()))


def shape(counts: Ints, risk: float) -> Ints:
    """By bin, the least score (bins,), in steps, that a share 1 - `risk` of the scores (bins,
    steps) do not exceed; the greatest there is where a bin is empty."""
    summed, last = counts.cumsum(axis=1), counts.shape[1] - 1
    enough = summed >= (1 - risk) * summed[:, -1:]
    return np.where(summed[:, -1] > 0, enough.argmax(axis=1), last)


def _added(summed: Ints, shapes: Ints, groups: Floats, risk: float) -> int:
    """The fewest steps which, added to each world's `shapes` (worlds, bins), cover enough of all
    `groups` (groups, bins); `summed` (worlds, bins, steps) are sums of scores up to each."""
    last = summed.shape[2] - 1
    voxels = summed[:, :, -1] @ groups.T  # (worlds, groups)
    worlds = (voxels > 0).sum(axis=0)
    needed = np.minimum((1 - risk) * (worlds + 1), worlds)
    for step in range(last + 1):
        at = np.minimum(shapes + step, last)
        covered = np.take_along_axis(summed, at[:, :, None], axis=2)[:, :, 0] @ groups.T
        shares = np.divide(covered, voxels, out=np.zeros_like(covered), where=voxels > 0)
        if (shares.sum(axis=0) >= needed - 1e-9).all():
            return step
    return last


def path_risks(collided: Floats) -> tuple[float, ...]:
    """What share of paths collides at most, by risk of the bounds that they were planned on, from
    the shares (worlds, risks) of every world's trials in which one did; risks fall.

    Conformal risk control (Angelopoulos et al. 2024): a world's loss is the greatest at this risk
    or any smaller one, so that it is monotone; and a new world may lose all.
    """
    monotone = np.maximum.accumulate(collided[:, ::-1], axis=1)[:, ::-1]
    return tuple(((monotone.sum(axis=0) + 1) / (len(collided) + 1)).tolist())


def near_bins(grid: GridSpec, chances: tuple[float, ...]) -> Mask:
    """Which bins of the margins hold voxels that are predicted to be near an obstacle."""
    edges = np.arange(distance_bins(grid, STEP_M)) * STEP_M
    return np.repeat(edges < NEAR_M - 1e-9, len(chances) + 1)


LEAST_WORLDS = 20
"""Fewer promise no bound of a risk of .05, nor a temperature."""
CHUNK = 10
"""Samples a task of a worker."""
Measure = Callable[[Prediction, Case], tuple[Any, ...]]
"""What is measured of a prediction for a sample; results are summed by world."""


class _Task(NamedTuple):
    """Maps of one dataset that a worker completes."""

    dataset: int
    """The dataset's number among those given."""
    folder: Path
    numbers: list[int]
    """The samples' in their split."""


def calibrate(
    weights: str | Path,
    folders: Sequence[Path],
    out: Path,
    *,
    split: str = "val",
    samples: int | None = None,
    trials: int = 4,
    seed: int = 0,
    execute: Executor = ALONE,
    progress: Showing = silent,
) -> Calibration:
    """Calibrate the network at `weights`, a .safetensors file, on `split` of the datasets, at most
    `samples` maps of each, evenly spread, with `trials` planned on each map at every risk; and
    write it with its calibration to `out`.

    All worlds count the same, whichever dataset they are of, and whatever `execute` has the maps
    completed. Raises DatasetError for too few worlds or another grid, CheckpointError for a network
    that does not tell its class weight, ScenegenError where `execute` leaves maps to others.
    """
    check_together(execute, "a calibration takes")
    network, grid, about = open_network(weights)
    chances = CHANCES if "occupancy" in network.tasks else ()
    weight = _class_weight(weights, about) if chances else 1.0
    method = Completer.from_pretrained(weights)
    datasets = [Dataset(folder) for folder in folders]
    digests = tuple(str(dataset.manifest.digest) for dataset in datasets)
    if len(set(digests)) < len(digests):
        raise DatasetError("one dataset is given twice, and worlds count once; leave one out")
    for dataset in datasets:
        check_whole(dataset, "calibrate on drawn worlds")
        with raised_as(DatasetError, f"{dataset.folder}: "):
            method.check_grid(dataset.grid)
        if trials:
            check_middle(dataset, "give --trials 0")
    tasks = _tasks(datasets, split, samples)

    def measured(label: str, measure: Measure) -> list[Any]:
        """What is measured of every map, summed by world."""
        sums: dict[tuple[int, int], Any] = {}
        total = sum(len(task.numbers) for task in tasks)
        work = partial(_complete, split, method, measure)
        for results in counted(execute, progress, work, tasks, label, total):
            for world, result in results:
                sums[world] = tuple(map(add, sums[world], result)) if world in sums else result
        return [sums[world] for world in sorted(sums)]

    scores, logits, denied = zip(*measured("voxels", partial(_count, weight)), strict=True)
    risks, margins = fit_margins(np.stack(scores), near_bins(grid, chances))
    temperature, levels = None, []
    if chances:
        shares = np.concatenate(denied)
        levels = np.quantile(shares, LEVELS).tolist()
        temperature = fit_temperature(np.concatenate(logits), familiar(away_of(shares, levels)))
    fitted = Calibration(
        worlds=len(scores),
        class_weight=weight,
        temperature=temperature,
        step_m=STEP_M,
        chances=chances,
        risks=risks,
        margins=margins,
        datasets=digests,
        denied=tuple(levels),
    )
    if trials:
        losses = measured("paths", partial(_collisions, fitted, trials, seed))
        shares = np.array([collided / count for collided, count in losses if count])
        fitted = replace(fitted, path_risks=path_risks(shares))
    # as it is read again: lists for tuples
    save_network(out, network, grid, {**about, KEY: plain(asdict(fitted))})
    return fitted


def _class_weight(weights: str | Path, about: Json) -> float:
    """The weight of occupied voxels in the loss that a network was trained by. Raises
    CheckpointError where its file does not say."""
    with suppress(KeyError, TypeError, ValueError):  # a file of others may hold anything
        weight = float(about["settings"]["loss"]["occupied_weight"])
        if weight > 0:
            return weight
    raise CheckpointError(
        f"{weights}: tells of no class weight above 0 of its loss; train it again"
    )


def _tasks(datasets: Sequence[Dataset], split: str, most: int | None) -> list[_Task]:
    """All samples of a split, or `most` of each dataset, evenly spread. Raises DatasetError where
    they are of too few worlds."""
    tasks, worlds = [], set()
    for number, dataset in enumerate(datasets):
        part = filled(dataset, split)
        chosen = evenly(len(part), most or len(part))
        worlds |= {(number, part.names[n][1]) for n in chosen}
        tasks += [_Task(number, dataset.folder, rows) for rows in chunked(chosen, CHUNK)]
    if len(worlds) < LEAST_WORLDS:
        folders = ", ".join(str(dataset.folder) for dataset in datasets)
        raise DatasetError(
            f"{folders}: {len(worlds)} worlds in split {split}, expected {LEAST_WORLDS} at least; "
            f"make a larger {split} split, or give more datasets"
        )
    return tasks


def _complete(
    split: str, method: Completer, measure: Measure, task: _Task
) -> list[tuple[tuple[int, int], tuple[Any, ...]]]:
    """Complete a task's maps: for each, the dataset's number and the world's, and what is
    measured."""
    samples, results = Dataset(task.folder, whole=True).split(split), []
    for number in task.numbers:
        sample = samples[number]
        prediction = method.completion(sample, samples)
        result = measure(prediction, Case(sample, number, samples))
        results.append(((task.dataset, int(sample.world)), result))
    return results


def _count(weight: float, prediction: Prediction, case: Case) -> tuple[Ints, list[Ints], list[Any]]:
    """Scores of a map's unknown voxels; and where there are probabilities, their logits, and what
    share of its returns is denied."""
    sample, grid = case.sample, case.grid
    unknown, probability = np.isin(case.classes, UNOBSERVED), prediction.occupancy_probability
    distance = prediction.distance(Thresholds(), grid)
    chance = None if probability is None else corrected(probability, weight)
    scores = count_scores(distance, chance, sample.tudf, unknown, grid)
    if probability is None:
        return scores, [], []
    logits = count_logits(probability, sample.occupancy, unknown, weight)
    return scores, [logits], [denial(probability, sample.observed, weight)]


def _collisions(
    fitted: Calibration, trials: int, seed: int, prediction: Prediction, case: Case
) -> tuple[Floats, int]:
    """How many of a map's trials collide at each risk, and how many there are."""
    rng = rng_of(seed, int(case.sample.world), int(case.sample.viewpoint))
    goals = trials_of(case, PlanConfig(), trials, rng).goals
    risks = [Setting(by="risk", value=risk) for risk in fitted.risks]
    bounded = replace(prediction, uncertainty=fitted, grid=case.grid)
    measured = run_settings(risks, bounded, case.truth, goals, case.grid, PlanConfig())
    return measured[:, :, TOLD.index("collided")].sum(axis=0), len(goals)
