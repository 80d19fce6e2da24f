"""The order in which a network reads a stream, in batches of different worlds, and how far it has
read."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from scenegen.errors import DatasetError, short, whole_number
from scenegen.limits import MOST_BATCH, MOST_WORKERS
from scenegen.sample import rng_of


class Place:
    """A count of what was read, of what `of` says, in `unit`, up to `most`."""

    def __init__(self, of: Mapping[str, Any], unit: str, most: int):
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


if TYPE_CHECKING:
    from scenegen.streams.stream import Stream


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

    def __init__(
        self, stream: "Stream", size: int, *, rank: int = 0, ranks: int = 1, loaders: int = 1
    ):
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
