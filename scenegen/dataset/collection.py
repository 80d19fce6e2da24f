"""Several datasets, or some of their samples, read as one."""

from collections.abc import Mapping, Sequence
from typing import Any

from scenegen.dataset.read import AnyDataset, Dataset, Piece
from scenegen.errors import DatasetError, short
from scenegen.files import sha256_of


class Collection(AnyDataset):
    """Several datasets, or some of their samples, read as one.

    Args:
        datasets: The datasets, which share a grid.
        name: What errors call it.
        chosen: For some of the datasets, by their number, the samples of each split that are taken,
            by their numbers in it, rising; all of the others.

    Raises:
        DatasetError: The datasets have different grids, two of them are the same, or a world that
            was given as a file is in two splits.
    """

    def __init__(
        self,
        datasets: Sequence[Dataset],
        name: str,
        chosen: Mapping[int, Mapping[str, Sequence[int]]] | None = None,
    ):
        super().__init__()
        if not datasets:
            raise DatasetError(f"{name}: holds no dataset")
        self.datasets = tuple(datasets)
        self.name = name
        self.grid, self.lidar = datasets[0].grid, datasets[0].lidar
        self.chosen = chosen or {}
        check_together(self.datasets)

    @property
    def digest(self) -> str:
        """What tells its samples from all others."""
        chosen = [
            {split: list(numbers) for split, numbers in self.chosen[n].items()}
            if n in self.chosen
            else None
            for n in range(len(self.datasets))
        ]
        parts = [dataset.digest for dataset in self.datasets]
        return sha256_of(repr((parts, chosen)).encode())

    def _pieces(self, split: str) -> list[Piece]:
        pieces, first_world = list[Piece](), 0
        for n, dataset in enumerate(self.datasets):
            numbers = self.chosen[n].get(split, ()) if n in self.chosen else None
            pieces += dataset.split(split).taken(numbers, first_world)
            first_world += _worlds(dataset, split)
        return pieces

    def world(self, split: str, number: int) -> dict[str, bytes]:
        """See `Dataset.world`."""
        dataset, own = self._world(split, number)
        return dataset.world(split, own)

    def compile(self, split: str, number: int) -> Any:
        """See `Dataset.compile`."""
        dataset, own = self._world(split, number)
        return dataset.compile(split, own)

    def _world(self, split: str, number: int) -> tuple[Dataset, int]:
        """The dataset of a world, and its number there."""
        for dataset in self.datasets:
            if number < (worlds := _worlds(dataset, split)):
                return dataset, number
            number -= worlds
        raise DatasetError(f"{self.name}: has no such world in its {split} split")

    def __repr__(self) -> str:
        return f"<Collection: {self.name}, {len(self.datasets)} datasets>"


def _worlds(dataset: Dataset, split: str) -> int:
    """How many worlds a split of a complete dataset has."""
    return dataset.manifest.numbering(split).count(dataset.manifest.counts[split])


def check_together(datasets: Sequence[Dataset]) -> None:
    """Raise DatasetError unless `datasets` can be read as one: of one grid, no two with the same
    samples, and no world in two splits, as far as manifests say; `verify` looks at the worlds
    themselves."""
    by_parameters = dict[str, Dataset]()
    split_of_world = dict[str, tuple[str, Dataset]]()
    for dataset in datasets:
        first = datasets[0]
        if dataset.grid != first.grid:
            raise DatasetError(
                f"{dataset.name}: its grid is {dataset.grid}, that of {first.name} is "
                f"{first.grid}; read datasets together that share it"
            )
        # the counts and the size of shards decide no sample
        drawn_by = {
            name: value
            for name, value in dataset.manifest.parameters.items()
            if name not in ("counts", "shard_samples", "software", "fields")
        }
        other = by_parameters.setdefault(repr(drawn_by), dataset)
        if other is not dataset:
            raise DatasetError(
                f"{dataset.name}: holds the same samples as {other.name}; leave one of the two out"
            )
        for split, scenes in (dataset.manifest.scenes or {}).items():
            for scene in scenes:
                before, owner = split_of_world.setdefault(scene.sha256, (split, dataset))
                if before != split:
                    raise DatasetError(
                        f"{dataset.name}: its {split} world {short(scene.file)} is a {before} "
                        f"world of {owner.name}; no world may be in two splits"
                    )
