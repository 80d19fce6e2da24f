"""Endless datasets without a disk: sample i is drawn on access, or in advance. Readers, in order or
in batches of different worlds, can save and restore their position."""

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
from lidarsim.parameters import short_repr
from scenegen.base.errors import DatasetError, check_int
from scenegen.base.files import Json
from scenegen.base.limits import MAX_BATCH, MAX_SAMPLES, MAX_SEED, MAX_WORKERS
from scenegen.base.reading import sha256_of
from scenegen.dataset.generation import with_parts
from scenegen.dataset.manifest import schema_of
from scenegen.draw.mixture import MIXED, fraction, is_mixed, read_components, seeds
from scenegen.draw.sample import Sample, SampleSequence, Schema, rng_of
from scenegen.draw.source import DrawnWorlds
from scenegen.streams.mixture import (
    Ahead,
    Component,
    Mixture,
    PackedUnit,
    Slot,
    component_of,
    pack_sample,
    record_type,
    unpack,
    weighted_sources,
)
from scenegen.worlds.mapping import Sensing

KEPT_BYTES = 256 << 20
"""Size of packed units that a process keeps in memory, least recently used first to go: with
default maps, about 2500 units."""
AHEAD = 4
"""Units per worker that are drawn in advance."""


class Stream(SampleSequence):
    """Samples by number. `stream[i]` depends only on the sources, the seed, the split and i.

    The first n samples of a stream of one source are those of the dataset with its seed and split,
    bit for bit. In a mixture, this holds for the samples of each source. Distances (`tudf`) are
    computed on access.

    It follows the conventions of `torch.utils.data`: `len`, `[i]`, `__getitems__`; each process,
    forked or spawned, draws for itself. Only one thread of a process may use it at a time.
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
        self.workers = check_int("stream: workers =", workers, 0, MAX_WORKERS)
        self.mixture = mixture
        self._samples = check_int("stream: samples =", samples, 1, MAX_SAMPLES)
        parts = [
            # units of a round identify the order: weights 1:2 and 2:4 give the same stream
            {"drawn": part.described(), "units": units}
            for part, units in zip(mixture.components, mixture.units, strict=True)
        ]
        self.digest = sha256_of(json.dumps(parts, sort_keys=True).encode())
        """Identifies the samples and their order."""
        # grid and known space are the same for all components, see `Mixture`
        first = mixture.components[0].recipe
        self.grid, self.lidar, self.known = first.grid, first.lidar, first.known
        self.settings = tuple(
            Sensing(part.recipe.lidar, part.recipe.mapping, part.recipe.noise.spelled())
            for part in mixture.components
        )
        """How the samples of each part are sensed. `lidar` and `mapping` are those of the first
        part."""
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
        """Read several samples; torch calls this for a batch. All workers draw their units in
        parallel."""
        places = [self.mixture.place(self._checked(index)) for index in indices]
        self._prepare(dict.fromkeys(slot for slot, _ in places))
        samples = []
        for slot, view in places:
            part, _ = slot
            packed = self._unit(slot)[view]
            samples.append(unpack(packed, self._records[part], self._schemas[part]))
        return samples

    def __repr__(self) -> str:
        return f"<Stream: {len(self)} samples, {self.name}, {self.split}>"

    def __iter__(self) -> "Reader":
        return iter(Reader(self))

    def batches(self, size: int, *, rank: int = 0, ranks: int = 1, loaders: int = 1) -> "Batches":
        """Divide the samples into batches; see `Batches`.

        Args:
            size: Number of samples of a batch, over all ranks.
            rank: Number of this process.
            ranks: Number of processes that share each batch.
            loaders: Number of loader processes of each rank, or a multiple.

        Raises:
            DatasetError: if a number is invalid, or the stream is shorter than one round.
        """
        return Batches(self, size, rank=rank, ranks=ranks, loaders=loaders)

    def part(self, index: int) -> tuple[int, int]:
        """Number of the part of sample `index`, and the sample's number in that part's dataset."""
        (part, unit), view = self.mixture.place(self._checked(index))
        return part, unit * self.mixture.components[part].viewpoints + view

    @property
    def schema(self) -> Schema:
        """Schema of the samples; if parts differ, that of the first."""
        return self._schemas[0]

    @property
    def schemas(self) -> Sequence[Schema]:
        """Schemas of the parts."""
        return self._schemas

    def expect(self, indices: Iterable[int]) -> None:
        """Announce which samples will be read, in this order. Workers then draw them in advance."""
        # a generator: there may be 10**9 samples
        self._coming = (self.mixture.place(index)[0] for index in indices)

    def close(self) -> None:
        """End the worker processes. Later requests start new ones."""
        if self._ahead is not None:
            self._ahead.close()
        self._ahead = None

    def __getstate__(self) -> dict[str, Any]:
        # a copy in another process draws for itself
        return {**self.__dict__, "_units": {}, "_ahead": None, "_coming": iter(())}

    def _forget(self) -> None:
        """Reset the state of a process."""
        self._units, self._bytes = dict[Slot, PackedUnit](), 0
        self._coming = iter(())
        self._ahead = None
        self._process = os.getpid()

    def _prepare(self, slots: Iterable[Slot]) -> None:
        """Have workers draw missing units of `slots`, and then announced ones."""
        # workers belong to the process that started them
        if self._process != os.getpid():
            self._forget()
        # torch's loader processes are daemons, which may not start processes
        if not self.workers or multiprocessing.current_process().daemon:
            return
        if self._ahead is None:
            self._ahead = Ahead(self._make, self.workers)
        # empties the pipes, so that no worker waits to send
        self._ahead.collect()
        missing = [slot for slot in slots if slot not in self._units]
        for slot in missing:
            self._ahead.give(slot)
        room = AHEAD * self.workers + 2 * len(missing) - self._ahead.under_way
        while room > 0 and (later := next(self._coming, None)) is not None:
            if later not in self._units and later not in self._ahead:
                self._ahead.give(later)
                room -= 1

    def _unit(self, slot: Slot) -> PackedUnit:
        """Packed samples of a unit, which becomes the most recently used one."""
        unit = self._units.pop(slot, None)
        if unit is None:
            unit = self._make(slot) if self._ahead is None else self._ahead.take(slot)
            self._bytes += sum(map(len, unit))
        self._units[slot] = unit
        # the unit just read stays, however large it is
        while self._bytes > KEPT_BYTES and len(self._units) > 1:
            self._bytes -= sum(map(len, self._units.pop(next(iter(self._units)))))
        return unit


def _unit_of(
    components: Sequence[Component], records: Sequence[np.dtype], slot: Slot
) -> PackedUnit:
    """Draw and pack the unit of a slot, in any process. Raises GenerationError."""
    part, unit = slot
    return tuple(
        pack_sample(sample, records[part]) for sample in components[part].draw(unit).samples
    )


class ReadPosition:
    """Position of a reader: a count of what was read.

    Args:
        of: Identity of what is read, which a state must match.
        unit: Name of the count: "samples" or "batches".
        maximum: Maximum of the count.
    """

    def __init__(self, of: Json, unit: str, maximum: int):
        self._of, self._unit, self._limit = dict(of), unit, maximum
        self._done = 0

    def state_dict(self) -> dict[str, Any]:
        """The position, as a few bytes of JSON. For batches, it is the same on all ranks.

        Torch's loader reads batches before it hands them out. With a loader, count the batches that
        you received instead.
        """
        return {**self._of, self._unit: self._done}

    def load_state_dict(self, state: Any) -> None:
        """Restore a position.

        Raises:
            DatasetError: if the state belongs to another stream, or is invalid.
        """
        if not isinstance(state, Mapping):
            raise DatasetError(
                f"state of a stream: {short_repr(state)}: expected what state_dict() gave"
            )
        for name, expected in self._of.items():
            if state.get(name) != expected:
                raise DatasetError(
                    f"state of a stream: its {name} is {short_repr(state.get(name))}, expected "
                    f"{short_repr(expected)}: it is of another one"
                )
        where = f"state of a stream: its {self._unit} ="
        self._done = check_int(where, state.get(self._unit), 0, self._limit)


class Reader(ReadPosition, Iterator[Sample]):
    """A stream's samples in order, from 0 or from a restored position."""

    def __init__(self, stream: Stream):
        super().__init__({"stream": stream.digest[:16]}, "samples", len(stream))
        self._stream = stream

    def __iter__(self) -> "Reader":
        self._stream.expect(range(self._done, self._limit))
        return self

    def __next__(self) -> Sample:
        if self._done >= self._limit:
            raise StopIteration
        sample = self._stream[self._done]
        self._done += 1
        return sample


class Batches(ReadPosition, Iterator[list[int]]):
    """Sample numbers of each batch; a torch batch sampler. `batches[n]` depends only on the
    stream's seed, `size`, `loaders` and n.

    A *row* is V consecutive samples of one world (see `Mixture.row`). The stream is cut into blocks
    of `size` rows. A block gives V batches: batch v has the v-th sample of each row. The order of
    the rows is random, drawn from the seed and the block's number. Hence no batch has two samples
    of a row, and each sample comes once. A row has the same position in all batches of its block.
    Rank r of `ranks` takes every `ranks`-th position from r on, so that ranks never draw the same
    units.

    With `loaders` > 1, consecutive batches alternate between `loaders` blocks. Torch deals batches
    to its loader processes in the same way, so that they never draw the same units. `loaders` may
    also be a multiple of their number.
    """

    def __init__(self, stream: Stream, size: int, *, rank: int, ranks: int, loaders: int):
        size = check_int("stream: size =", size, 1, MAX_BATCH)
        ranks = check_int("stream: ranks =", ranks, 1, MAX_WORKERS)
        rank = check_int("stream: rank =", rank, 0, ranks - 1)
        loaders = check_int("stream: loaders =", loaders, 1, MAX_WORKERS)
        if size % ranks:
            raise DatasetError(
                f"batches of a stream: size = {size} does not divide among {ranks} ranks; use a "
                f"multiple"
            )
        self._stream, self._size, self._loaders = stream, size, loaders
        self._mine = slice(rank, None, ranks)
        self._row = stream.mixture.row
        # complete rounds only: all ranks and loaders get equally many batches
        self._count = len(stream) // (self._row * size * loaders) * self._row * loaders
        if not self._count:
            raise DatasetError(
                f"batches of a stream: {len(stream)} samples are fewer than one round of "
                f"{self._row * size * loaders}; give the stream more samples, or a smaller size"
            )
        place = {"stream": stream.digest[:16], "size": size, "loaders": loaders}
        super().__init__(place, "batches", self._count)

    def __len__(self) -> int:
        """Number of batches of complete rounds of `loaders` blocks. Samples after these are not
        used."""
        return self._count

    def __getitem__(self, number: int) -> list[int]:
        """Sample numbers of batch `number`, or of this rank's part of it. Raises IndexError."""
        if not 0 <= number < self._count:
            raise IndexError(f"batch {short_repr(number)} of {self._count}")
        turn, offset = divmod(number, self._row * self._loaders)
        view, block_offset = divmod(offset, self._loaders)
        block = turn * self._loaders + block_offset
        rng = rng_of(self._stream.seed, block)
        # all ranks draw the same order, and each takes its part
        rows = block * self._size + rng.permutation(self._size)[self._mine]
        return (rows * self._row + view).tolist()

    def __iter__(self) -> "Batches":
        if self._done == self._count:  # after a complete pass, start again
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
    **parts: Any,
) -> Stream:
    """Make a stream: samples by number, drawn on access. The first n are those that
    `scenegen.generate` makes with this seed and split. It does not need torch.

    Args:
        worlds: Name of a kind, "mixed" for all kinds, a recipe or its TOML file, an MJCF file, a
            map, or a folder of these; or several, as a list or a mapping to weights. Samples come
            in proportion to the weights, by a fixed rule (docs/stream.md).
        seed: Seed of all random numbers.
        split: "train", "val" or "test". Splits share no world, because draws are seeded with the
            split.
        samples: Length of the stream.
        workers: Number of processes that draw in advance; with 0, samples are drawn on access in
            this process.
        engine: Name of the engine that casts rays.
        parts: Optional parts of samples, as of `scenegen.generate`, such as `movers="light"`.

    Returns:
        The stream. Reading a sample may raise GenerationError, IndexError and TypeError.

    Raises:
        RecipeError: if a recipe is invalid.
        SceneError: if a file cannot be used as a world.
        DatasetError: if a number, the split or the engine is invalid.
        UsageError: if there is no such part.
    """
    seed = check_int("stream: seed =", seed, 0, MAX_SEED)
    entries = [entry for pair in weighted_sources(worlds) for entry in _unmixed(*pair, seed)]
    components = [
        component_of(source, seed=seed, split=split, engine=engine) for source, _ in entries
    ]
    # several components of one kind must not draw the same worlds
    part_seeds = seeds([component.recipe.kind for component in components], seed)
    for n, (source, _) in enumerate(entries):
        # a Component that the user made keeps its seed
        if isinstance(components[n].source, DrawnWorlds) and components[n] is not source:
            components[n] = replace(components[n], seed=part_seeds[n])
    if parts:
        components = [
            replace(each, recipe=with_parts(each.recipe, parts, each.source)) for each in components
        ]
    mixture = Mixture(components, [weight for _, weight in entries])
    return Stream(mixture, seed=seed, split=split, samples=samples, workers=workers)


def _unmixed(source: Any, weight: Any, seed: int) -> list[tuple[Any, Any]]:
    """Split a part of several kinds into parts of one kind, which share its weight."""
    file = (
        Path(source) if isinstance(source, str | Path) and str(source).endswith(".toml") else None
    )
    if source != MIXED and (file is None or not is_mixed(file)):
        return [(source, weight)]
    components = read_components(file, seed=seed)
    unit_weight = fraction(weight, str(source)) / sum(share for _, share in components)
    return [(recipe, unit_weight * share) for recipe, share in components]
