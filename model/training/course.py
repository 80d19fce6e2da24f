"""The way of a run: which maps every step sees, at what learning rate, and where it ends."""

import math

from scenegen.errors import DatasetError
from scenegen.model.config import TrainConfig
from scenegen.model.training.data import Maps, epoch_batches, stream_batch
from scenegen.model.training.run_folder import Progress

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
        self._warmup = math.ceil(config.warmup_share * self._most)
        self._cosine = config.schedule == "cosine"
        self.latest_decay = (
            self._warmup
            if self._cosine
            else self._most - math.ceil(config.decay_share * self._most)
        )
        """The step at which the learning rate begins to fall, unless validation stalls before."""

    def steps(self, progress: Progress) -> range:
        """The steps of the round that comes next; none where the run ends.

        Where validation has stalled, the run ends (cosine), or its decay begins, as `progress` then
        says.
        """
        first = progress.epoch * self.round
        if progress.epoch - progress.best_epoch > self._config.patience:
            if self._cosine:
                return range(0)
            if progress.decay is None and first < self.latest_decay:
                progress.decay = first
        return range(first, min(first + self.round, self.end(progress.decay)))

    def end(self, decay: int | None) -> int:
        """How many steps the run has, where validation stalled at step `decay`; None for not at
        all."""
        if decay is None or self._cosine:
            return self._most
        share = self._config.decay_share
        return decay + min(math.ceil(decay * share / (1 - share)), self._most - self.latest_decay)

    def rate(self, step: int, decay: int | None) -> float:
        """The learning rate of `step`: up a line; then, for "cosine", down a cosine to 0 at the
        end, and for "decay", level, and from the decay on down a line to 0 at the end."""
        peak, end = self._config.lr, self.end(decay)
        begin = self.latest_decay if decay is None else decay
        if step < self._warmup:
            return peak * (step + 1) / self._warmup
        if self._cosine:
            return peak * 0.5 * (1 + math.cos(math.pi * (step - begin) / (end - begin)))
        return peak if step < begin else peak * (end - step) / (end - begin)

    def batches(self, first: int, count: int) -> list[list[tuple[int, int]]]:
        """The keys of `Maps` that steps `first`, `first` + 1, … see, `count` batches: one pass
        after the other, or a stream's own, in which no map comes twice."""
        found: list[list[tuple[int, int]]] = []
        config = self._config
        if self._order is not None:
            numbers = range(first, first + count)
            return [
                stream_batch(self._order, self._maps, n, seed=config.seed, augment=config.augment)
                for n in numbers
            ]
        while len(found) < count:
            epoch, step = divmod(first + len(found), self._pass)
            keys = epoch_batches(
                self._maps,
                batch=config.batch,
                seed=config.seed,
                epoch=epoch,
                augment=config.augment,
            )
            found += keys[step : step + count - len(found)]
        return found
