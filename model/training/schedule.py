"""The schedule of a run: its steps, learning rates and rounds, and validation."""

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import closing
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from lidarsim.grid import Floats, GridSpec
from scenegen.base.errors import DatasetError
from scenegen.base.executors import chunked
from scenegen.draw.sample import rng_of
from scenegen.model.bench.methods import best_of, ious_by_threshold, judged_by
from scenegen.model.bench.metrics import Metric, ScoredMap, measure, metrics_of
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds, TrainConfig
from scenegen.model.losses import loss_of
from scenegen.model.network import Output
from scenegen.model.targets import Target
from scenegen.model.training.card import Scalars
from scenegen.model.training.data import Key, Maps, epoch_batches, load_batches, views
from scenegen.model.training.device import Group, autocast
from scenegen.model.training.run_folder import Progress


@torch.inference_mode()
def validate(
    network: nn.Module, maps: Maps, config: TrainConfig, group: Group, workers: int
) -> Scalars:
    """Measure a network on validation maps.

    Args:
        network: The network, on the device of `group`.
        maps: Validation maps.
        config: Settings of the run.
        group: Processes that share the maps.
        workers: Processes that read samples, for each process of the group.

    Returns:
        Means over maps, by name: the terms of the loss, and the bench's metrics over whole maps at
        the paper's thresholds. A map without a value of a metric, such as one without near voxels,
        does not count for it. Besides:

        - ``largest``: the largest probability in any voxel. Nothing is predicted occupied while it
          is below the threshold.
        - ``best_iou``: the mean IoU at the best threshold for these maps.
        - ``best_probability``, or ``best_distance_m`` if only distances are predicted: this
          threshold.

    Raises:
        DatasetError: if a sample cannot be read.
    """
    network.eval()
    targets: Any = network.targets
    loss, usual = loss_of(config.loss, maps.grid, targets=targets), Thresholds()
    sums = defaultdict[str, Floats](lambda: np.zeros(2))  # sum and number of values
    largest, ious, judged = 0.0, list[Floats](), ""
    metrics = validated_metrics(targets)
    mine = chunked(range(len(maps)), config.batch)[group.rank :: group.size]
    # closed at once, also after an error: loader processes would outlive it
    with closing(load_batches(maps, mine, workers=workers, pinned=False)) as loaded:
        for batch in loaded:
            placed = {name: values.to(group.device) for name, values in batch.items()}
            count = len(placed["tudf"])
            with autocast(group.device, group.precision):
                output = Output(*network(placed))
            # the mean of a batch counts for each of its maps; the last batch may be smaller
            for name, value in loss(output, placed).items():
                sums[name] += np.array([value.item() * count, count])
            predicted = {
                name: values.numpy(force=True)
                for name, values in output.predictions(targets, maps.grid).items()
            }
            if "occupancy_probability" in predicted:
                largest = max(largest, float(predicted["occupancy_probability"].max()))
            for n in range(count):
                prediction = Prediction.of({name: maps[n] for name, maps in predicted.items()})
                truth = {name: values[n].numpy() for name, values in batch.items()}
                scored = scored_map(prediction, truth, maps.grid)
                judged = judged_by(prediction)
                ious.append(ious_by_threshold(prediction, truth["occupancy"], scored.scored))
                scores = measure(scored, metrics)[0]
                for name, value in zip(metrics, scores.tolist(), strict=True):
                    if math.isfinite(value):  # NaN if the map has no voxels to measure
                        sums[name] += (value, 1)
    gathered = group.gather((dict(sums), largest, ious, judged))
    all_sums, all_largest, all_ious, all_judged = zip(*gathered, strict=True)
    means = dict.fromkeys(metrics, math.nan)
    for name in [name for theirs in all_sums for name in theirs]:
        total, number = sum(theirs.get(name, np.zeros(2)) for theirs in all_sums)
        means[name] = float(total / number)
    mean_ious = np.mean([iou for theirs in all_ious for iou in theirs], axis=0)
    judged = max(all_judged)  # "" in a process without a map, and the same in all others
    return {
        **means,
        "largest": max(all_largest),
        "best_iou": float(mean_ious.max()),
        f"best_{judged}": getattr(best_of(judged, mean_ious, usual), judged),
    }


def validated_metrics(targets: Mapping[str, Target]) -> dict[str, Metric]:
    """Return the metrics that validation measures of a network with some targets, by name."""
    return {name: metric for name, metric in metrics_of(targets).items() if not metric.bench_only}


def scored_map(
    prediction: Prediction, truth: Mapping[str, NDArray[Any]], grid: GridSpec
) -> ScoredMap:
    """Put a prediction beside the truth of its map, at the paper's thresholds.

    Args:
        prediction: The prediction.
        truth: Arrays of a batch of `Maps`, of this map, by name.
        grid: The grid.
    """
    return ScoredMap(
        prediction=prediction,
        truth=truth,
        grid=grid,
        thresholds=Thresholds(),
        scored=truth.get("known", np.ones(grid.shape, bool)),
        certain=truth.get("certain"),
    )


STREAM_INTERVAL = 5000
"""Maps of a stream between two validations, unless `TrainConfig.interval` is set."""


class Schedule:
    """All steps of a run, numbered from 0: their learning rates and batches.

    A *round* is the steps between two validations: a pass over the maps, or `STREAM_INTERVAL` maps
    of a stream, unless `TrainConfig.interval` is set.

    Args:
        maps: Training maps.
        config: Settings of the run.

    Raises:
        DatasetError: if the maps are a stream, and `config` has no number of maps to see.
    """

    def __init__(self, maps: Maps, config: TrainConfig):
        self._maps, self._config = maps, config
        self.batch = min(config.batch, len(maps))
        """Maps per step, over all processes."""
        self._pass = len(maps) // self.batch  # steps
        self._order = maps.order(self.batch)
        if self._order is not None and config.maps is None:
            raise DatasetError(
                f"{maps.sources[0].name}: has no end; say how many maps to see with --maps"
            )
        interval = config.interval or (None if self._order is None else STREAM_INTERVAL)
        self.round = self._pass if interval is None else max(interval // self.batch, 1)
        """Steps of a round; the last may be shorter."""
        self._budget = (
            config.epochs * self._pass if config.maps is None else max(config.maps // self.batch, 1)
        )
        """Maximum number of steps."""
        self._decays = config.schedule == "decay"
        """Whether the learning rate rises and falls; else it is constant."""
        # a constant rate has no warm-up either, so that no rate depends on the budget
        self._warmup = math.ceil(config.warmup_share * self._budget) if self._decays else 0
        self.latest_decay = self._budget
        """The step at which the learning rate begins to fall, unless validation stalls before."""
        if self._decays:
            self.latest_decay -= math.ceil(config.decay_share * self._budget)

    def steps(self, progress: Progress) -> range:
        """Return the steps of the next round.

        If validation has stalled, a run with a constant rate ends. With "decay", the decay begins
        now, unless it has begun.

        Args:
            progress: Progress of the run; `progress.decay` is set if the decay begins.

        Returns:
            Numbers of steps; empty if the run has ended.
        """
        first = progress.epoch * self.round
        if progress.waited >= self._config.patience:
            if not self._decays:
                return range(0)
            if progress.decay is None and first < self.latest_decay:
                progress.decay = first
        return range(first, min(first + self.round, self.end(progress.decay)))

    def end(self, decay: int | None) -> int:
        """Number of steps of the run if validation stalled at step `decay`, or never (None)."""
        if decay is None or not self._decays:
            return self._budget
        # of a shorter run, too, the decay is `decay_share`
        share = self._config.decay_share
        return decay + min(math.ceil(decay * share / (1 - share)), self._budget - self.latest_decay)

    def rate(self, step: int, decay: int | None) -> float:
        """Return the learning rate of a step.

        It rises linearly, is constant, and falls linearly to 0 at the end of the run. With the
        schedule "constant", it is the same for all steps.

        Args:
            step: Number of the step.
            decay: The step at which validation stalled; None if it has not.

        Returns:
            The rate, at most `TrainConfig.lr`.
        """
        peak, end = self._config.lr, self.end(decay)
        begin = self.latest_decay if decay is None else decay
        if step < self._warmup:
            return peak * (step + 1) / self._warmup
        return peak if step < begin else peak * (end - step) / (end - begin)

    def batches(self, first: int, count: int) -> Iterator[list[Key]]:
        """Yield the batches of some steps.

        Datasets are seen in passes, each in its own order. In a stream, no map comes twice.

        Args:
            first: Number of the first step.
            count: Number of steps.

        Yields:
            The keys of `Maps` in each batch.
        """
        config, maps = self._config, self._maps
        if self._order is not None:
            for n in range(first, first + count):
                order = self._order[n]
                turns = views(maps, config, len(order), rng_of(config.seed, n, 0))
                yield list(zip(order, turns.tolist(), strict=True))
            return
        first_pass, step = divmod(first, self._pass)
        passes = (
            epoch_batches(maps, config, epoch, first=step if epoch == first_pass else 0)
            for epoch in itertools.count(first_pass)
        )
        yield from itertools.islice(itertools.chain.from_iterable(passes), count)
