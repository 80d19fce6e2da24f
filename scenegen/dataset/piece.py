"""The samples of one shard that a split has; errors of a damaged dataset."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.grid import Ints
from scenegen.base.errors import BrokenError, DatasetError, raised_as
from scenegen.dataset.schema import ShardEntry


def advised(folder: Path, mark: str = "/", of: Any = BrokenError) -> AbstractContextManager[None]:
    """Raise errors of a damaged dataset as DatasetErrors with its folder and advice.

    Args:
        folder: Folder of the dataset.
        mark: Text between the folder and the message.
        of: Classes of errors that are caught.
    """
    return raised_as(
        DatasetError, f"{folder}{mark}", "; copy the dataset again, or generate it", of=of
    )


class Rows(NamedTuple):
    """Samples of a split by number: a task for a worker."""

    split: str
    numbers: Sequence[int]

    def __str__(self) -> str:
        return f"{self.split} samples {self.numbers[0]} to {self.numbers[-1]}"


@dataclass(frozen=True, eq=False)
class Piece:
    """Samples of a split that lie in one shard."""

    dataset: Any
    """Its `scenegen.dataset.read.Dataset`; that module imports this one."""
    entry: ShardEntry
    rows: Ints | None = None
    """Rows of the shard, in order; None for all."""
    first_world: int = 0
    """Offset of world numbers, so that worlds of a collection have different numbers."""

    def __len__(self) -> int:
        return self.entry.samples if self.rows is None else len(self.rows)

    def row(self, position: int) -> int:
        """Row in the shard of the sample at a position in this piece."""
        return position if self.rows is None else int(self.rows[position])

    def names(self) -> Ints:
        """World and viewpoint numbers of its samples, (2, N). Raises BrokenError."""
        manifest, split = self.dataset.manifest, self.entry.split
        rows = np.arange(self.entry.samples) if self.rows is None else self.rows
        places = manifest.first_place(self.entry) + rows
        world, viewpoint = manifest.numbering(split).name(places)
        return np.array([world + self.first_world, viewpoint])
