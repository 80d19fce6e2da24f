"""How a run goes: its steps, its pauses, and its looks at validation."""

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import torch
from torch import nn

from lidarsim.grid import Floats
from scenegen.base.errors import DatasetError
from scenegen.base.executors import chunked
from scenegen.draw.sample import rng_of
from scenegen.model.bench.methods import best_of, ious_by_threshold, judged_by
from scenegen.model.bench.metrics import ScoredMap, measure, metrics_of
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds, TrainConfig
from scenegen.model.losses import loss_of
from scenegen.model.network import Output
from scenegen.model.training.card import Scalars
from scenegen.model.training.data import Key, Maps, epoch_batches, load, views
from scenegen.model.training.device import Group, autocast
from scenegen.model.training.run_folder import Progress


@torch.inference_mode()
def validate(
    network: nn.Module, maps: Maps, config: TrainConfig, group: Group, workers: int
) -> Scalars:
    """Means over samples: the losses (of each batch for all its samples), and the bench's metrics
    at the paper's thresholds, over whole maps; a map that has no value of a metric is left out of
    it.

    And ``largest``, the largest probability anywhere: while it stays below the threshold, nothing
    is ever occupied; ``best_iou``, the mean IoU at the best threshold of these maps; and this
    threshold, ``best_probability`` or, of a network that predicts distances alone,
    ``best_distance_m``.
    """
    network.eval()
    targets: Any = network.targets
    loss, usual = loss_of(config.loss, maps.grid, targets=targets), Thresholds()
    sums = defaultdict[str, Floats](lambda: np.zeros(2))  # of values, and of how many they are
    largest, ious, judged = 0.0, list[Floats](), ""
    metrics = {
        name: metric for name, metric in metrics_of(targets).items() if not metric.bench_only
    }
    mine = chunked(range(len(maps)), config.batch)[group.rank :: group.size]
    with closing(load(maps, mine, workers=workers, pinned=False)) as loaded:
        for batch in loaded:
            placed = {name: values.to(group.device) for name, values in batch.items()}
            count = len(placed["tudf"])
            with autocast(group.device, group.precision):
                output = Output(*network(placed))
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
                known = truth.get("known", np.ones(maps.grid.shape, bool))
                judged = judged_by(prediction)
                ious.append(ious_by_threshold(prediction, truth["occupancy"], known))
                scored_map = ScoredMap(
                    prediction=prediction,
                    truth=truth,
                    grid=maps.grid,
                    thresholds=usual,
                    scored=known,
                    certain=truth.get("certain"),
                )
                scores = measure(scored_map, metrics)[0]
                for name, value in zip(metrics, scores.tolist(), strict=True):
                    if math.isfinite(value):  # a map without such voxels says nothing of them
                        sums[name] += (value, 1)
    everywhere = group.gather((dict(sums), largest, ious, judged))
    every_sum, tops, every_iou, judges = zip(*everywhere, strict=True)
    means = dict.fromkeys(metrics, math.nan)
    for name in [name for theirs in every_sum for name in theirs]:
        total, number = sum(theirs.get(name, np.zeros(2)) for theirs in every_sum)
        means[name] = float(total / number)
    mean_ious = np.mean([iou for theirs in every_iou for iou in theirs], axis=0)
    judged = max(judges)  # a process without a map has none
    return {
        **means,
        "largest": max(tops),
        "best_iou": float(mean_ious.max()),
        f"best_{judged}": getattr(best_of(judged, mean_ious, usual), judged),
    }


STREAM_INTERVAL = 5000
"""Maps of a stream between two looks at validation, unless a run says otherwise."""


class Course:
    """All steps of a run, numbered from 0, over `maps`, as `config` says. A *round* is what lies
    between two looks at validation: a pass over the maps, or `STREAM_INTERVAL` maps of a stream,
    unless the configuration says otherwise.

    Raises DatasetError for a stream without a budget."""

    def __init__(self, maps: Maps, config: TrainConfig):
        self._maps, self._config = maps, config
        self.batch = min(config.batch, len(maps))
        """Maps a step."""
        self._pass = len(maps) // self.batch
        self._order = maps.order(self.batch)
        if self._order is not None and config.maps is None:
            raise DatasetError(
                f"{maps.sources[0].name}: has no end; say how many maps to see with --maps"
            )
        interval = config.interval or (None if self._order is None else STREAM_INTERVAL)
        self.round = self._pass if interval is None else max(interval // self.batch, 1)
        """Steps of a round; the last may be shorter."""
        self._most = (
            config.epochs * self._pass if config.maps is None else max(config.maps // self.batch, 1)
        )
        self._falls = config.schedule == "decay"
        """Whether the learning rate rises and falls; else it is constant."""
        self._warmup = math.ceil(config.warmup_share * self._most) if self._falls else 0
        self.latest_decay = self._most
        """The step at which the learning rate begins to fall, unless validation stalls before."""
        if self._falls:
            self.latest_decay -= math.ceil(config.decay_share * self._most)

    def steps(self, progress: Progress) -> range:
        """The steps of the round that comes next; none where the run ends.

        Where validation has stalled, the run ends (constant), or its decay begins, as `progress`
        then says.
        """
        first = progress.epoch * self.round
        if progress.waited >= self._config.patience:
            if not self._falls:
                return range(0)
            if progress.decay is None and first < self.latest_decay:
                progress.decay = first
        return range(first, min(first + self.round, self.end(progress.decay)))

    def end(self, decay: int | None) -> int:
        """How many steps the run has, where validation stalled at step `decay`; None for not at
        all."""
        if decay is None or not self._falls:
            return self._most
        share = self._config.decay_share
        return decay + min(math.ceil(decay * share / (1 - share)), self._most - self.latest_decay)

    def rate(self, step: int, decay: int | None) -> float:
        """The learning rate of `step`: up a line, then level, and from the decay on down a line to
        0 at the end. "constant" has no warm-up, either: no rate depends on the budget."""
        peak, end = self._config.lr, self.end(decay)
        begin = self.latest_decay if decay is None else decay
        if step < self._warmup:
            return peak * (step + 1) / self._warmup
        return peak if step < begin else peak * (end - step) / (end - begin)

    def batches(self, first: int, count: int) -> Iterator[list[Key]]:
        """The keys of `Maps` that steps `first`, `first` + 1, … see, `count` batches: one pass
        after the other, or a stream's own, in which no map comes twice."""
        config, maps = self._config, self._maps
        if self._order is not None:
            for n in range(first, first + count):
                order = self._order[n]
                turns = views(maps, config, len(order), rng_of(config.seed, n, 0))
                yield list(zip(order, turns.tolist(), strict=True))
            return
        begun, step = divmod(first, self._pass)
        passes = (
            epoch_batches(maps, config, epoch, first=step if epoch == begun else 0)
            for epoch in itertools.count(begun)
        )
        yield from itertools.islice(itertools.chain.from_iterable(passes), count)
