"""A dataset without a disk and without an end: sample i is drawn when it is asked for, or ahead of
that; and who reads one, in order or in batches of different worlds, knows how far it has come."""

import json
import multiprocessing
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.engines import DEFAULT
from scenegen.base.errors import DatasetError, short, whole_number
from scenegen.base.files import Json, sha256_of
from scenegen.base.limits import MOST_BATCH, MOST_SAMPLES, MOST_SEED, MOST_WORKERS
from scenegen.dataset.manifest import schema_of
from scenegen.draw.mixture import MIXED, fraction, is_mixed, read_components, seeds
from scenegen.draw.sample import Sample, Samples, Schema, rng_of
from scenegen.draw.source import DrawnWorlds
from scenegen.streams.mixture import (
    Ahead,
    Component,
    Mixture,
    Slot,
    Unit,
    component_of,
    pack,
    parts_of,
    record_type,
    unpack,
)
from scenegen.worlds.mapping import Sensing

KEPT_BYTES = 256 << 20
"""Packed units that a process keeps in memory, those asked for last; with default maps, these are
some 2500."""
AHEAD = 4
"""Units for each worker process that are made before they are asked for."""


class Stream(Samples):
    """Samples by number. `stream[i]` depends on what is drawn, the seed, the split and i alone.

    The first n samples of a stream of one part are those of the dataset with its seed and split,
    bit for bit; those of a mixture's part are, by themselves, those of that part's dataset.
    Distances (`tudf`) are derived when accessed.

    Plain `torch.utils.data` conventions hold: `len`, `[i]`, `__getitems__`, and any process, forked
    or spawned, that it is handed to draws for itself. In one process, one thread at a time may use
    it.
    """

    _ahead: Ahead | None
    _coming: Iterator[Slot]

    def __init__(
        self,
        mixture: Mixture,
        *,
        seed: int,
        split: str,
        samples: int,
        workers: int,
    ):
        self.seed, self.split = seed, split
        self.workers = whole_number("stream: workers =", workers, 0, MOST_WORKERS)
        self.mixture = mixture
        self._samples = whole_number("stream: samples =", samples, 1, MOST_SAMPLES)
        parts = [
            {"drawn": part.described(), "units": units}
            for part, units in zip(mixture.components, mixture.units, strict=True)
        ]
        self.digest = sha256_of(json.dumps(parts, sort_keys=True).encode())
        """What tells this stream from all others that give other samples, or in another order."""
        first = mixture.components[0].recipe
        self.grid, self.lidar, self.known = first.grid, first.lidar, first.known
        self.settings = tuple(
            Sensing(part.recipe.lidar, part.recipe.mapping, part.recipe.noise.spelled())
            for part in mixture.components
        )
        """How the samples of every part are sensed; `lidar` and `mapping` are those of the
        first."""
        self.kind = "+".join(part.recipe.kind for part in mixture.components)
        self.name = f"stream of {', '.join(part.label for part in mixture.components)}, seed {seed}"
        self.mapping = first.mapping
        self._schemas = [schema_of(part.recipe) for part in mixture.components]
        self._records = [record_type(schema) for schema in self._schemas]
        self._make = partial(_unit_of, mixture.components, self._records)
        self._forget()

    def __len__(self) -> int:
        return self._samples

    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Several samples, as torch asks for a batch: their units are made by all workers at
        once."""
        places = [self.mixture.place(self._checked(index)) for index in indices]
        self._prepare(dict.fromkeys(slot for slot, _ in places))
        found = []
        for slot, view in places:
            part, _ = slot
            packed = self._unit(slot)[view]
            found.append(unpack(packed, self._records[part], self._schemas[part]))
        return found

    def __repr__(self) -> str:
        return f"<Stream: {len(self)} samples, {self.name}, {self.split}>"

    def __iter__(self) -> "Reader":
        return iter(Reader(self))

    def batches(self, size: int, *, rank: int = 0, ranks: int = 1, loaders: int = 1) -> "Batches":
        """Which samples each of many batches takes: see `Batches`. Raises DatasetError."""
        return Batches(self, size, rank=rank, ranks=ranks, loaders=loaders)

    def part(self, index: int) -> tuple[int, int]:
        """(which part of the mixture sample `index` is of, from 0; its number in that part's
        dataset)."""
        (part, unit), view = self.mixture.place(self._checked(index))
        return part, unit * self.mixture.components[part].viewpoints + view

    @property
    def schema(self) -> Schema:
        """The schema of its samples; where parts differ, that of the first."""
        return self._schemas[0]

    @property
    def schemas(self) -> Sequence[Schema]:
        """The schemas of its parts."""
        return self._schemas

    def expect(self, indices: Iterable[int]) -> None:
        """Say which samples will be asked for next, in this order: workers then make these ahead of
        need."""
        self._coming = (self.mixture.place(index)[0] for index in indices)

    def close(self) -> None:
        """End the worker processes; what is asked for later begins new ones."""
        if self._ahead is not None:
            self._ahead.close()
        self._ahead = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_units": {}, "_ahead": None, "_coming": iter(())}

    def _forget(self) -> None:
        """Begin anew, as a process of its own."""
        self._units, self._bytes = dict[Slot, Unit](), 0
        self._coming = iter(())
        self._ahead = None
        self._process = os.getpid()

    def _prepare(self, slots: Iterable[Slot]) -> None:
        """Have workers make the units of `slots` that are not there, and then those that come
        next."""
        if (
            self._process != os.getpid()
        ):  # a fork, which has neither the workers nor a claim to them
            self._forget()
        if (
            not self.workers or multiprocessing.current_process().daemon
        ):  # which may have no processes of its own
            return
        if self._ahead is None:
            self._ahead = Ahead(self._make, self.workers)
        self._ahead.collect()
        missing = [slot for slot in slots if slot not in self._units]
        for slot in missing:
            self._ahead.give(slot)
        room = AHEAD * self.workers + 2 * len(missing) - self._ahead.under_way
        while room > 0 and (later := next(self._coming, None)) is not None:
            if later not in self._units and later not in self._ahead:
                self._ahead.give(later)
                room -= 1

    def _unit(self, slot: Slot) -> Unit:
        """A unit's records, which are then those asked for last."""
        unit = self._units.pop(slot, None)
        if unit is None:
            unit = self._make(slot) if self._ahead is None else self._ahead.take(slot)
            self._bytes += sum(map(len, unit))
        self._units[slot] = unit
        while self._bytes > KEPT_BYTES and len(self._units) > 1:
            self._bytes -= sum(map(len, self._units.pop(next(iter(self._units)))))
        return unit


def _unit_of(components: Sequence[Component], records: Sequence[np.dtype], slot: Slot) -> Unit:
    """Draw the unit of a slot, in whatever process. Raises GenerationError."""
    part, unit = slot
    return tuple(pack(sample, records[part]) for sample in components[part].draw(unit).samples)


class Place:
    """A count of what was read, of what `of` says, in `unit`, up to `most`."""

    def __init__(self, of: Json, unit: str, most: int):
        self._of, self._unit, self._most = dict(of), unit, most
        self._done = 0

    def state_dict(self) -> dict[str, Any]:
        """How much came, in a few bytes that JSON takes; of batches, the same for all ranks.

        Torch's loader asks for batches ahead of what it hands out: count those yourself where you
        use one.
        """
        return {**self._of, self._unit: self._done}

    def load_state_dict(self, state: Any) -> None:
        """Go on from there. Raises DatasetError for the state of anything else."""
        if not isinstance(state, Mapping):
            raise DatasetError(
                f"state of a stream: {short(state)}: expected what state_dict() gave"
            )
        for name, ours in self._of.items():
            if state.get(name) != ours:
                raise DatasetError(
                    f"state of a stream: its {name} is {short(state.get(name))}, expected "
                    f"{short(ours)}: it is of another one"
                )
        where = f"state of a stream: its {self._unit} ="
        self._done = whole_number(where, state.get(self._unit), 0, self._most)


class Reader(Place, Iterator[Sample]):
    """A stream's samples in order, from 0 or from where a state says."""

    def __init__(self, stream: Stream):
        super().__init__({"stream": stream.digest[:16]}, "samples", len(stream))
        self._stream = stream

    def __iter__(self) -> "Reader":
        self._stream.expect(range(self._done, self._most))
        return self

    def __next__(self) -> Sample:
        if self._done >= self._most:
            raise StopIteration
        sample = self._stream[self._done]
        self._done += 1
        return sample


class Batches(Place, Iterator[list[int]]):
    """Numbers of the samples in every batch of `size`; a torch batch sampler. `batches[n]` depends
    on the stream's seed, `size`, `loaders` and n alone.

    A *row* is the V samples, one after the other, of one world (see `Mixture.row`). The stream is
    cut into blocks of `size` rows, in order; a block gives V batches, the v-th of the v-th sample
    of each of its rows, which have an order that is drawn from the seed and the block's number. So
    no batch holds two samples of a row, each sample comes once, and the same place in the V batches
    of a block is always the same row: rank r of `ranks` takes every `ranks`-th place from r on, and
    draws units that no other rank draws.

    With `loaders` blocks at a time, batch n is of block n mod `loaders` among these. Torch deals
    batches to its loader processes in just this way, so as many of them draw units that no other
    draws; `loaders` may also be a multiple of their number.
    """

    def __init__(self, stream: Stream, size: int, *, rank: int, ranks: int, loaders: int):
        size = whole_number("stream: size =", size, 1, MOST_BATCH)
        ranks = whole_number("stream: ranks =", ranks, 1, MOST_WORKERS)
        rank = whole_number("stream: rank =", rank, 0, ranks - 1)
        loaders = whole_number("stream: loaders =", loaders, 1, MOST_WORKERS)
        if size % ranks:
            raise DatasetError(
                f"batches of a stream: size = {size} does not divide among {ranks} ranks; use a "
                f"multiple"
            )
        self._stream, self._size, self._loaders = stream, size, loaders
        self._mine = slice(rank, None, ranks)
        self._row = stream.mixture.row
        self._count = len(stream) // (self._row * size * loaders) * self._row * loaders
        if not self._count:
            raise DatasetError(
                f"batches of a stream: {len(stream)} samples are fewer than one round of "
                f"{self._row * size * loaders}; give the stream more samples, or a smaller size"
            )
        place = {"stream": stream.digest[:16], "size": size, "loaders": loaders}
        super().__init__(place, "batches", self._count)

    def __len__(self) -> int:
        """Batches of whole rounds of `loaders` blocks; samples beyond them come in none."""
        return self._count

    def __getitem__(self, number: int) -> list[int]:
        """Batch `number`, or this rank's part of it. Raises IndexError."""
        if not 0 <= number < self._count:
            raise IndexError(f"batch {short(number)} of {self._count}")
        turn, rest = divmod(number, self._row * self._loaders)
        view, within = divmod(rest, self._loaders)
        block = turn * self._loaders + within
        rng = rng_of(self._stream.seed, block)
        rows = block * self._size + rng.permutation(self._size)[self._mine]
        return (rows * self._row + view).tolist()

    def __iter__(self) -> "Batches":
        if self._done == self._count:  # a pass that ended: the next begins anew
            self._done = 0
        self._stream.expect(index for n in range(self._done, self._count) for index in self[n])
        return self

    def __next__(self) -> list[int]:
        if self._done >= self._count:
            raise StopIteration
        self._done += 1
        return self[self._done - 1]


def stream(
    worlds: Any,
    *,
    seed: int = 0,
    split: str = "train",
    samples: int = 10**9,
    workers: int = 0,
    engine: str = DEFAULT,
) -> Stream:
    """Samples by number, drawn when asked for: the first n are those that `scenegen.generate`
    gives with this seed and split. No torch is needed.

    Args:
        worlds: A kind's name, "mixed" for all kinds, a recipe or its TOML file, an MJCF file, a
            map, or a folder of these; or several, as a list, or as a mapping to weights. Samples
            come in proportion to the weights, by a fixed rule (docs/stream.md).
        seed: The same seed gives the same samples.
        split: "train", "val" or "test". No world of one split is in another, because each draw is
            seeded with its split.
        samples: The stream's `len`.
        workers: Processes that draw ahead of need; 0 draws in the process that asks.
        engine: Name of the engine that casts the rays.

    Raises:
        RecipeError, SceneError, DatasetError: What is asked for cannot be. Asking for a sample
            raises GenerationError, IndexError and TypeError, too.
    """
    seed = whole_number("stream: seed =", seed, 0, MOST_SEED)
    parts = [part for what, weight in parts_of(worlds) for part in _unmixed(what, weight, seed)]
    components = [component_of(what, seed=seed, split=split, engine=engine) for what, _ in parts]
    own = seeds([one.recipe.kind for one in components], seed)
    components = [
        replace(one, seed=its) if isinstance(one.source, DrawnWorlds) and one is not what else one
        for one, its, (what, _) in zip(components, own, parts, strict=True)
    ]
    mixture = Mixture(components, [weight for _, weight in parts])
    return Stream(mixture, seed=seed, split=split, samples=samples, workers=workers)


def _unmixed(what: Any, weight: Any, seed: int) -> list[tuple[Any, Any]]:
    """A part of a stream as parts of one kind each, which share its weight."""
    file = Path(what) if isinstance(what, str | Path) and str(what).endswith(".toml") else None
    if what != MIXED and (file is None or not is_mixed(file)):
        return [(what, weight)]
    components = read_components(file, seed=seed)
    part = fraction(weight, str(what)) / sum(share for _, share in components)
    return [(recipe, part * share) for recipe, share in components]
