"""Completions as chunks of an HDF5 file: written in order, or kept in files of a part each until
all are there."""

import hashlib
import io
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np

from scenegen.dataset.read import Rows, Split
from scenegen.errors import DatasetError
from scenegen.files import whole
from scenegen.model.calibration import RISK
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.protocol import PARTS, SURE

Chunks: TypeAlias = dict[str, list[bytes]]
"""Maps by the name of what they tell, each compressed as HDF5 has it, in the order of `PARTS` and
`SURE`."""


def write_predictions(
    out: Path, samples: Split, completer: Completer, parts: Iterable[Chunks]
) -> None:
    """Write what docs/bench.md calls a predictions file to `out`, whole or not: a split's `parts`,
    in order."""
    dataset = samples.dataset
    about = {"dataset": dataset.manifest.digest, "split": samples.name, "method": completer.name}
    with new_hdf5(out) as file:
        file.attrs.update(about | ({} if completer.calibration is None else {"risk": RISK}))
        file["world"] = np.array([world for _, world, _ in samples.names], dtype=np.int64)
        file["viewpoint"] = np.array(
            [viewpoint for _, _, viewpoint in samples.names], dtype=np.int64
        )
        _fill(file, len(samples), dataset.grid.shape, parts)


class _Disk(io.FileIO):
    """What HDF5 writes to. A disk that refuses ends the writing at once; all that HDF5 must still
    write to close the file, and would fail at again and again, then goes nowhere."""

    refused = False

    def write(self, content: Any) -> int:
        """All of `content`. Raises the first OSError, and no other."""
        left = memoryview(content)
        try:
            while left.nbytes and not self.refused:
                left = left[super().write(left) :]
        except OSError:
            self.refused = True
            raise
        return memoryview(content).nbytes

    def truncate(self, size: int | None = None) -> int:
        """The same."""
        return 0 if self.refused else super().truncate(size)


@contextmanager
def new_hdf5(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to fill, which then stands at `path`, whole or not. Raises as `whole`."""
    with whole(path) as draft, _Disk(draft, "r+") as disk, h5py.File(disk, "w") as file:
        yield file


def _fill(file: h5py.File, count: int, shape: tuple[int, ...], parts: Iterable[Chunks]) -> None:
    """Write `count` maps, in the same order however they are parted, so that the file has the same
    bytes."""
    row = 0
    for part in parts:
        for name in part:
            if name not in file:
                packed = {"compression": "gzip", "compression_opts": 1}
                file.create_dataset(name, (count, *shape), np.float32, chunks=(1, *shape), **packed)
        for chunks in zip(*part.values(), strict=True):
            for name, chunk in zip(part, chunks, strict=True):
                file[name].id.write_direct_chunk((row, 0, 0, 0), chunk)
            row += 1


@dataclass(frozen=True)
class Kept:
    """Parts in a folder, one a file, for whichever run finds all of them."""

    folder: Path
    """Beside what they are to become; its name tells of what they are, so that no others are taken
    for them."""

    @classmethod
    def beside(cls, out: Path, samples: Split, completer: Completer, batch: int) -> "Kept":
        """Those of a split, completed `batch` maps at once by a network that was opened from a
        file."""
        assert completer.path is not None
        network = hashlib.sha256(completer.path.read_bytes()).hexdigest()
        about = json.dumps([samples.dataset.manifest.digest, samples.name, network, batch])
        return cls(out.with_name(f"{out.name}.{hashlib.sha256(about.encode()).hexdigest()[:12]}"))

    def path(self, rows: Rows) -> Path:
        """The file of a part."""
        return self.folder / f"{rows.numbers[0]:08d}.h5"

    def write(self, rows: Rows, chunks: Chunks, shape: tuple[int, ...]) -> None:
        """Keep the maps of `rows`, of `shape`. Raises as `whole`."""
        with new_hdf5(self.path(rows)) as file:
            _fill(file, len(rows.numbers), shape, [chunks])

    def read(self, rows: Rows) -> Chunks:
        """The maps of `rows`. Raises DatasetError."""
        path = self.path(rows)
        try:
            with h5py.File(path, "r") as file:
                there = [name for name in PARTS | SURE if name in file]
                places = [(n, 0, 0, 0) for n in range(len(rows.numbers))]
                return {
                    name: [file[name].id.read_direct_chunk(place)[1] for place in places]
                    for name in there
                }
        except Exception as error:  # h5py's errors share no base
            raise DatasetError(
                f"{path}: cannot be read ({error}); remove it, and give the same command again"
            ) from None
