"""Calibrate a network on the validation worlds of datasets."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.dataset.read import Dataset, Split
from scenegen.errors import DatasetError, empty_split
from scenegen.model.checkpoint import CheckpointError, save_network
from scenegen.model.completion.completer import open_network
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import PlanConfig
from scenegen.model.evaluation.planning.careful import plan_carefully
from scenegen.model.evaluation.planning.trials import draw_trials
from scenegen.model.evaluation.pretrained import Pretrained
from scenegen.model.evaluation.run import check_middle
from scenegen.model.evaluation.tuning import spread
from scenegen.model.evaluation.visibility import UNOBSERVED, classify, scored_layers
from scenegen.model.uncertainty import fit
from scenegen.model.uncertainty.calibration import KEY, Calibration, corrected
from scenegen.run.workers import run as run_workers
from scenegen.sample import Sample

LEAST_WORLDS = 20
"""Fewer promise no bound of a risk of .05, nor a temperature."""
CHUNK = 10
"""Samples a task of a worker."""
Look = Callable[[Prediction, Sample, Split, int], Any]
"""Makes of a prediction for a sample, by its number in a split, what is kept of it."""


def calibrate(
    weights: str | Path,
    folders: Sequence[Path],
    out: Path,
    *,
    split: str = "val",
    samples: int | None = None,
    trials: int = 4,
    seed: int = 0,
    workers: int = 1,
    on_start: Callable[[str, int], None] = lambda what, total: None,
    on_done: Callable[[int], None] = lambda samples: None,
) -> Calibration:
    """Calibrate the network at `weights`, a .safetensors file, on `split` of the datasets, at most
    `samples` maps of each, evenly spread, with `trials` planned on each map at every risk; and
    write it with its calibration to `out`.

    All worlds count the same, whichever dataset they are of. Raises DatasetError for too few worlds
    or another grid, CheckpointError for a network that does not tell its class weight.
    """
    network, grid, about = open_network(weights)
    weight = 1.0
    if "occupancy" in network.tasks:
        try:
            weight = float(about["settings"]["loss"]["occupied_weight"])
            if not weight > 0:
                raise ValueError
        except (KeyError, TypeError, ValueError):
            raise CheckpointError(
                f"{weights}: tells of no class weight above 0 of its loss; train it again"
            ) from None
    method, datasets = Pretrained(str(weights)), [Dataset(folder) for folder in folders]
    about = {name: value for name, value in about.items() if name != KEY}
    for dataset in datasets:
        if not len(dataset.split(split)):
            raise DatasetError(f"{dataset.folder}: {empty_split(split)}, or give another --split")
        if dataset.grid != grid:
            raise DatasetError(
                f"{dataset.folder}: its maps are on {dataset.grid}, the network's on {grid}"
            )
        if trials:
            check_middle(dataset, "give --trials 0")
    indices = [spread(len(one.split(split)), samples or len(one.split(split))) for one in datasets]
    several = [
        {one.split(split)[n].world for n in chosen}
        for one, chosen in zip(datasets, indices, strict=True)
    ]
    if (worlds := sum(map(len, several))) < LEAST_WORLDS:
        raise DatasetError(
            f"{', '.join(str(folder) for folder in folders)}: {worlds} worlds in split {split}, "
            f"expected "
            f"{LEAST_WORLDS} at least; generate a larger one"
        )

    def look(what: str, at: Look) -> list[Any]:
        """What `at` makes of every map, summed by world."""
        on_start(what, sum(map(len, indices)))
        found: dict[tuple[int, int], Any] = {}
        for number, (dataset, chosen) in enumerate(zip(datasets, indices, strict=True)):
            tasks = [chosen[n : n + CHUNK] for n in range(0, len(chosen), CHUNK)]
            for several in run_workers(
                partial(_work, dataset.folder, split, method, at), tasks, workers
            ):
                for world, one in several:
                    held = found.get((number, world))
                    found[number, world] = (
                        one
                        if held is None
                        else tuple(a + b for a, b in zip(held, one, strict=True))
                    )
                on_done(len(several))
        return [found[key] for key in sorted(found)]

    maps = look("voxels", partial(_count, weight, grid))
    counted = [scores for scores, _ in maps]
    predicted = "occupancy" in network.tasks
    chances = fit.CHANCES if predicted else ()
    risks, margins = fit.fit_margins(np.stack(counted), fit.near_bins(grid, chances))
    made: dict[str, Any] = {
        "worlds": len(counted),
        "class_weight": weight,
        "temperature": fit.fit_temperature(np.sum([logits for _, logits in maps], axis=0))
        if predicted
        else None,
        "step_m": fit.STEP_M,
        "chances": chances,
        "risks": risks,
        "margins": margins,
        "datasets": tuple(str(dataset.manifest.digest) for dataset in datasets),
    }
    found = Calibration(**made)
    if trials:
        losses = look("paths", partial(_collisions, found, grid, trials, seed))
        shares = np.array([collided / count for collided, count in losses if count])
        found = Calibration(**made | {"path_risks": fit.path_risks(shares)})
    # as it is read again: lists for tuples
    save_network(out, network, grid, about | {KEY: json.loads(json.dumps(found.said()))})
    return found


def _work(
    folder: Path, split: str, method: Pretrained, at: Look, indices: Sequence[int]
) -> list[tuple[int, tuple[Any, ...]]]:
    samples, found = Dataset(folder).split(split), []
    for index in indices:
        sample = samples[index]
        found.append(
            (int(sample.world), at(method.completion(sample, samples), sample, samples, index))
        )
    return found


def _count(
    weight: float, grid: GridSpec, said: Prediction, sample: Sample, split: Split, index: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Scores and logits of a map's unknown voxels."""
    layers = scored_layers(sample, grid, split.home(index).tables)
    classes = classify(sample, lidar=split.dataset.lidar, grid=grid, scored=layers)
    unknown, probability = np.isin(classes, UNOBSERVED), said.occupancy_probability
    distance, chance = (
        said.distance(Thresholds(), grid),
        None if probability is None else corrected(probability, weight),
    )
    scores = fit.count_scores(distance, chance, sample.tudf, unknown, grid)
    if probability is None:
        return scores, np.zeros((1, 2), np.int64)
    return scores, fit.count_logits(probability, sample.occupancy, unknown, weight)


def _collisions(
    found: Calibration,
    grid: GridSpec,
    trials: int,
    seed: int,
    said: Prediction,
    sample: Sample,
    split: Split,
    index: int,
) -> tuple[NDArray[np.float64], int]:
    """How many of a map's trials collide at each risk, and how many there are."""
    key = (int(sample.world), int(sample.viewpoint))
    rng, plan = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key)), PlanConfig()
    goals = draw_trials(sample.occupancy, grid, plan, count=trials, rng=rng).goals
    collided = np.zeros(len(found.risks))
    distance = said.distance(Thresholds(), grid)
    for n, risk in enumerate(found.risks):
        low = found.low(distance, said.occupancy_probability, risk)
        for goal in goals:
            done = plan_carefully(low <= 0, low, goal, grid, plan)
            collided[n] += sample.occupancy.reshape(-1)[done.voxels].any()
    return collided, len(goals)
