"""Calibrate a network's probabilities on the validation worlds of datasets."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from lidarsim.grid import Field, Floats, Ints, Mask
from scenegen.base.errors import DatasetError, reraise_as
from scenegen.base.executors import Counted, Executor, check_together, chunked, counted, unheard
from scenegen.base.files import Json
from scenegen.base.workers import ALONE
from scenegen.dataset.parameters import plain
from scenegen.dataset.read import AnyDataset
from scenegen.model.bench.methods import answers
from scenegen.model.bench.run import check_whole, filled
from scenegen.model.bench.visibility import UNOBSERVED, Case
from scenegen.model.calibration import (
    KEY,
    Calibration,
    away_of,
    corrected_logit,
    denial,
    familiar,
)
from scenegen.model.checkpoint import CheckpointError, save_network
from scenegen.model.completion.completer import Completer, open_network
from scenegen.view.look import evenly

LOGIT, MAX_LOGIT = 0.05, 20.0
"""Width of the bins of logits, and where they end."""
LOGITS = np.arange(-MAX_LOGIT + 0.5 * LOGIT, MAX_LOGIT, LOGIT)
"""The middles of these bins."""
LEVELS = np.arange(1, 21) / 20
"""Shares of validation maps at which it is kept how many returns are denied."""


def count_logits(
    probability: Field,
    occupied: Mask,
    unknown: Mask,
    class_weight: float,
) -> Ints:
    """Count the unknown voxels of a map by their logit, with the class weight inverted.

    Args:
        probability: Predicted probabilities (*shape).
        occupied: True occupancy (*shape).
        unknown: Voxels to count (*shape).
        class_weight: Weight of occupied voxels in the network's loss.

    Returns:
        (logits, 2): free and occupied voxels.
    """
    # a histogram is all that the fit needs: a map has 256,000 voxels, and there may be thousands
    steps = (corrected_logit(probability[unknown], class_weight) + MAX_LOGIT) / LOGIT
    # probabilities near 0 and 1 have logits beyond the bins, and go to the outermost ones
    at = np.clip(steps.astype(np.int64), 0, len(LOGITS) - 1)
    return np.bincount(2 * at + occupied[unknown], minlength=2 * len(LOGITS)).reshape(-1, 2)


def fit_temperature(counts: Ints, powers: Floats) -> float:
    """Fit the temperature (Guo et al. 2017) of least negative log-likelihood.

    Args:
        counts: Counted logits of each map, (maps, logits, 2), see `count_logits`.
        powers: Exponent of the temperature on each map, (maps,).

    Returns:
        The temperature.
    """

    def loss(log_temperature: float) -> float:
        # a power of T is a factor of log T
        scaled = LOGITS / np.exp(log_temperature * powers)[:, None]
        surprise = np.logaddexp(0, np.stack([scaled, -scaled], axis=2))
        return float((counts * surprise).sum())

    # a search over the logarithm keeps the temperature positive
    return math.exp(minimize_scalar(loss, bounds=(-3, 3), method="bounded").x)


MIN_WORLDS = 20
"""Fewer are too few for a temperature."""
CHUNK = 10
"""Samples a task of a worker."""


class _Task(NamedTuple):
    """Maps of one dataset that a worker completes."""

    dataset: int
    """The dataset's number among those given."""
    source: AnyDataset
    numbers: list[int]
    """The samples' in their split."""


class _Counted(NamedTuple):
    """Counts of one map, from which the calibration is computed."""

    dataset: int
    number: int
    """The sample's in its split."""
    world: int
    logits: Ints
    """See `count_logits`."""
    denied: float
    """See `denial`."""


def calibrate(
    weights: str | Path,
    datasets: Sequence[AnyDataset],
    out: Path,
    *,
    split: str = "val",
    samples: int | None = None,
    execute: Executor = ALONE,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
) -> Calibration:
    """Calibrate a network's probabilities, and write it with its calibration.

    Each world counts the same, whichever dataset it belongs to.

    Args:
        weights: The network, a .safetensors file.
        datasets: The datasets.
        out: File to write.
        split: The split of the datasets to calibrate on; no training may have seen it.
        samples: At most so many maps of each dataset, evenly spread; None for all.
        execute: Where maps are completed.
        on_start: Called with the number of maps once the work has begun.
        on_done: Called with the number of maps of each part that is done.

    Returns:
        The calibration.

    Raises:
        DatasetError: if there are too few worlds, or a dataset has another grid.
        CheckpointError: if the network predicts no probabilities, or its file has no class weight.
        ScenegenError: if `execute` leaves maps to other processes.
    """
    check_together(execute, "a calibration takes")
    network, grid, about = open_network(weights)
    if "occupancy" not in network.tasks:
        raise CheckpointError(f"{weights}: predicts no probabilities, so there is nothing to fit")
    weight = _class_weight(weights, about)
    method = Completer.from_pretrained(weights)
    digests = tuple(dataset.digest for dataset in datasets)
    if len(set(digests)) < len(digests):
        raise DatasetError("one dataset is given twice, and worlds count once; leave one out")
    for dataset in datasets:
        # in a map of a real place, the truth of some of the voxels that are counted is unknown
        check_whole(dataset, "calibrate on drawn worlds")
        with reraise_as(DatasetError, f"{dataset.name}: "):
            method.check_grid(dataset.grid)
    tasks = _tasks(datasets, split, samples)
    total = sum(len(task.numbers) for task in tasks)
    work = partial(_count_task, split, method, weight)
    parts = counted(execute, work, tasks, total=total, on_start=on_start, on_done=on_done)
    # in the order of the maps, wherever and whenever each was counted
    maps = sorted(
        (item for part in parts for item in part), key=lambda item: (item.dataset, item.number)
    )
    shares = np.array([item.denied for item in maps])
    levels = np.quantile(shares, LEVELS).tolist()
    # as `Calibration.chance` will apply it: unfamiliar maps have less of the temperature or none
    powers = familiar(away_of(shares, levels))
    fitted = Calibration(
        worlds=len({(item.dataset, item.world) for item in maps}),
        class_weight=weight,
        temperature=fit_temperature(np.array([item.logits for item in maps]), powers),
        datasets=digests,
        denied=tuple(levels),
    )
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


def _tasks(datasets: Sequence[AnyDataset], split: str, limit: int | None) -> list[_Task]:
    """All samples of a split, or `limit` of each dataset, evenly spread. Raises DatasetError where
    they are of too few worlds."""
    tasks, worlds = [], set()
    for number, dataset in enumerate(datasets):
        part = filled(dataset, split)
        chosen = evenly(len(part), limit or len(part))
        # two datasets may both have a world 0
        worlds |= {(number, part.names[n][1]) for n in chosen}
        tasks += [_Task(number, dataset, rows) for rows in chunked(chosen, CHUNK)]
    if len(worlds) < MIN_WORLDS:
        folders = ", ".join(dataset.name for dataset in datasets)
        raise DatasetError(
            f"{folders}: {len(worlds)} worlds in split {split}, expected {MIN_WORLDS} at least; "
            f"make a larger {split} split, or give more datasets"
        )
    return tasks


def _count_task(split: str, method: Completer, weight: float, task: _Task) -> list[_Counted]:
    """Complete a task's maps, and count the logits of their unknown voxels."""
    samples, results = task.source.split(split), []
    for number in task.numbers:
        sample = samples[number]
        (prediction,) = answers(method, sample, samples, 0, number, draws=1)
        probability = prediction.occupancy_probability
        unknown = np.isin(Case(sample, number, samples).classes, UNOBSERVED)
        logits = count_logits(probability, sample.occupancy, unknown, weight)
        denied = float(denial(probability, sample.observed, weight))
        results.append(_Counted(task.dataset, number, int(sample.world), logits, denied))
    return results
