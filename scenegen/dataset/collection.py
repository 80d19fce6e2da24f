"""Several datasets, or some of their samples, read as one.

A *collection* is a folder of datasets: those that its `collection.json` lists, otherwise all
datasets in it. A *selection* is a JSON file that lists samples of datasets by number, without
copies.
"""

import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from lidarsim.parameters import short_repr
from scenegen import SPLITS
from scenegen.base.errors import DatasetError, printable
from scenegen.base.files import write_atomic
from scenegen.base.limits import MAX_MANIFEST_BYTES, MAX_SOURCES
from scenegen.base.paths import DATA, check_type
from scenegen.base.reading import read_bounded, sha256_of
from scenegen.base.stores import is_remote
from scenegen.dataset.locate import locate
from scenegen.dataset.read import AnyDataset, Dataset, Piece, Split
from scenegen.dataset.schema import NAME, Digest, SplitName


class Collection(AnyDataset):
    """Several datasets, or some of their samples, read as one.

    Args:
        datasets: The datasets, which share a grid.
        name: Name for messages.
        chosen: Chosen samples of some datasets: position of the dataset → split → rising sample
            numbers. Other datasets are used completely.

    Raises:
        DatasetError: if there is no dataset, or they cannot be read together; see `check_together`.
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
        """Identifies the samples and their order."""
        chosen = [
            {split: list(numbers) for split, numbers in self.chosen[n].items()}
            if n in self.chosen
            else None
            for n in range(len(self.datasets))
        ]
        # the choice belongs to the identity: other samples of the same datasets are other data
        parts = [dataset.digest for dataset in self.datasets]
        return sha256_of(repr((parts, chosen)).encode())

    def _pieces(self, split: str) -> list[Piece]:
        pieces, first_world = list[Piece](), 0
        for n, dataset in enumerate(self.datasets):
            numbers = self.chosen[n].get(split, ()) if n in self.chosen else None
            pieces += dataset.split(split).pieces_of(numbers, first_world)
            # worlds of later datasets are numbered on, so that numbers stay unique
            first_world += _worlds(dataset, split)
        return pieces

    def world(self, split: str, number: int) -> dict[str, bytes]:
        """Files of a world; see `AnyDataset.world`.

        Returns:
            Contents by name.
        """
        dataset, local_number = self._world(split, number)
        return dataset.world(split, local_number)

    def compile(self, split: str, number: int) -> Any:
        """Compile a world; see `AnyDataset.compile`.

        Returns:
            The world.
        """
        dataset, local_number = self._world(split, number)
        return dataset.compile(split, local_number)

    def _world(self, split: str, number: int) -> tuple[Dataset, int]:
        """The dataset of a world, and the world's number in it."""
        for dataset in self.datasets:
            if number < (worlds := _worlds(dataset, split)):
                return dataset, number
            number -= worlds
        raise DatasetError(f"{self.name}: has no such world in its {split} split")

    def __repr__(self) -> str:
        return f"<Collection: {self.name}, {len(self.datasets)} datasets>"


def _worlds(dataset: Dataset, split: str) -> int:
    """Number of worlds in a split of a complete dataset."""
    return dataset.manifest.numbering(split).count(dataset.manifest.counts[split])


def check_together(datasets: Sequence[Dataset]) -> None:
    """Check that datasets can be read as one: the same grid, no samples twice, no world in two
    splits.

    Only manifests are compared; `verify` compares the worlds themselves.

    Args:
        datasets: The datasets.

    Raises:
        DatasetError: if they cannot be read as one.
    """
    by_parameters = dict[str, Dataset]()
    split_of_world = dict[str, tuple[str, Dataset]]()
    for dataset in datasets:
        first = datasets[0]
        if dataset.grid != first.grid:
            raise DatasetError(
                f"{dataset.name}: its grid is {dataset.grid}, that of {first.name} is "
                f"{first.grid}; read datasets together that share it"
            )
        # these parameters do not change any sample
        identity = {
            name: value
            for name, value in dataset.manifest.parameters.items()
            if name not in ("counts", "shard_samples", "software", "fields")
        }
        same_samples = by_parameters.setdefault(repr(identity), dataset)
        if same_samples is not dataset:
            raise DatasetError(
                f"{dataset.name}: holds the same samples as {same_samples.name}; leave one of the "
                "two out"
            )
        for split, scenes in (dataset.manifest.scenes or {}).items():
            for scene in scenes:
                # only worlds from files have digests here; drawn worlds of splits differ by their
                # seeds
                before, owner = split_of_world.setdefault(scene.sha256, (split, dataset))
                if before != split:
                    raise DatasetError(
                        f"{dataset.name}: its {split} world {short_repr(scene.file)} is a {before} "
                        f"world of {owner.name}; no world may be in two splits"
                    )


COLLECTION = "collection.json"
SELECTION_SUFFIX = ".json"

FilePath = Annotated[str, Meta(pattern=r"\A[^\x00-\x1f\x7f]{1,4096}\Z")]
"""Without control characters: the system rejects NUL, and errors must be one line."""
Paths = Annotated[list[FilePath], Meta(min_length=1, max_length=MAX_SOURCES)]
Numbers = list[Annotated[int, Meta(ge=0)]]


class CollectionFile(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Schema of `collection.json`."""

    format: Literal["scenegen-collection"] = "scenegen-collection"
    version: Literal[1] = 1
    datasets: Paths
    """Folders of the datasets, relative to the file's folder."""


class SelectedDataset(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Selected samples of one dataset."""

    path: FilePath
    """Its folder, relative to the file's folder; or its URL."""
    digest: Digest
    samples: dict[SplitName, Numbers]
    """Rising sample numbers by split."""


class SelectionFile(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Schema of a selection's file."""

    format: Literal["scenegen-selection"] = "scenegen-selection"
    version: Literal[1] = 1
    chosen_by: str
    """How the samples were chosen, as options of the command line."""
    datasets: Annotated[list[SelectedDataset], Meta(min_length=1, max_length=MAX_SOURCES)]


Name = str | PurePath


def open_data(
    names: Name | AnyDataset | Sequence[Name | AnyDataset],
    *,
    partial: bool = False,
    checked: bool = False,
    show_progress: bool = False,
) -> AnyDataset:
    """Open a dataset, a collection or a selection.

    Args:
        names: A folder, a selection's file, ``hf://user/name[@revision]`` or
            ``s3://bucket/folder``; or a list of these, which are read as one.
        partial: Whether incomplete datasets are accepted.
        checked: Whether everything that is read is compared with its digest.
        show_progress: Whether a download shows its progress.

    Raises:
        DatasetError: if there is no such dataset, it is damaged, or datasets cannot be read
            together.
    """
    if isinstance(names, AnyDataset):
        return names
    if not isinstance(names, str | PurePath):
        opened = [
            open_data(name, partial=partial, checked=checked, show_progress=show_progress)
            for name in names
        ]
        return opened[0] if len(opened) == 1 else _joined(opened)
    check_type(names, *DATA)
    folder = locate(names, show_progress=show_progress)
    if folder.is_file():
        return _selection(folder, partial=partial, checked=checked)
    # a store or the Hub holds one dataset, and no collection
    if (folder / NAME).exists() or is_remote(names):
        return Dataset(folder, partial=partial, checked=checked)
    members = members_of(folder)
    if not members:
        return Dataset(folder, partial=partial, checked=checked)  # raises an error with advice
    for member in members:
        if not (member / NAME).exists():
            raise DatasetError(
                f"{folder}: incomplete, {member} is no dataset; give the command that made it again"
            )
    datasets = [Dataset(member, partial=partial, checked=checked) for member in members]
    return Collection(datasets, str(folder))


def load(dataset: Any, split: str = "train") -> Split:
    """Open one split of a dataset. Samples are read on access, without a copy in memory.

    Args:
        dataset: A folder of one or several datasets, a selection's file,
            ``hf://user/name[@revision]``, ``s3://bucket/folder``, or a list of these.
        split: "train", "val" or "test".

    Returns:
        A sequence of `scenegen.Sample`. It can be passed to any number of processes, forked or
            spawned, each of which opens the files for itself. `describe()` lists names, types,
            shapes, units and meanings of the fields.

    Raises:
        DatasetError: if there is no such dataset or split, or it is incomplete or damaged.
    """
    return open_data(dataset).split(split)


def members_of(folder: Path) -> list[Path]:
    """Folders of the datasets of a collection: those in its `collection.json`, otherwise all
    datasets in `folder`.

    Raises:
        DatasetError: if the file is damaged.
    """
    path = folder / COLLECTION
    if not path.is_file():
        # sorted: glob has no order, and samples are numbered in the order of datasets
        return sorted(member.parent for member in folder.glob(f"*/{NAME}"))
    return [folder / name for name in _decoded(path, CollectionFile).datasets]


def write_collection(folder: Path, members: Sequence[str]) -> None:
    """Write a `collection.json`.

    Args:
        folder: Folder of the collection.
        members: Folders of its datasets, relative to `folder`.
    """
    document = CollectionFile(datasets=list(members))
    content = msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n"
    write_atomic(folder / COLLECTION, content)


def name_from(folder: Path, dataset: Path) -> str:
    """Path of a dataset in a selection's file.

    Args:
        folder: Folder of the file.
        dataset: Folder of the dataset.
    """
    return os.path.relpath(dataset, folder)


def _joined(opened: Sequence[AnyDataset]) -> Collection:
    """Join opened datasets, collections and selections."""
    datasets, chosen = list[Dataset](), {}
    for source in opened:
        for number, dataset in enumerate(source.datasets):
            if isinstance(source, Collection) and number in source.chosen:
                chosen[len(datasets)] = source.chosen[number]
            datasets.append(dataset)
    return Collection(datasets, ", ".join(source.name for source in opened), chosen)


def _selection(path: Path, *, partial: bool, checked: bool) -> Collection:
    """Open a selection's file."""
    datasets, chosen = list[Dataset](), {}
    for number, selected in enumerate(_decoded(path, SelectionFile).datasets):
        location = selected.path if is_remote(selected.path) else str(path.parent / selected.path)
        dataset = Dataset(locate(location), partial=partial, checked=checked)
        # sample numbers of another version would select other samples
        if dataset.digest != selected.digest:
            raise DatasetError(
                f"{path}: was chosen of a dataset of digest {selected.digest[:8]}…, {location} has "
                f"{dataset.digest[:8]}…; choose again"
            )
        for split in SPLITS:
            numbers = selected.samples.get(split, [])
            # rising, so that samples keep their order and none comes twice
            rising = all(a < b for a, b in pairwise(numbers))
            if not rising or (numbers and numbers[-1] >= len(dataset.split(split))):
                raise DatasetError(
                    f"{path}: datasets[{number}].samples.{split}: expected rising numbers below "
                    f"{len(dataset.split(split))}"
                )
        datasets.append(dataset)
        chosen[number] = dict(selected.samples)
    if not any(any(samples.values()) for samples in chosen.values()):
        raise DatasetError(f"{path}: chooses no sample; choose again with `scenegen take`")
    return Collection(datasets, str(path), chosen)


def _decoded(path: Path, kind: Any) -> Any:
    """Decode a JSON file by a schema. Raises DatasetError if it does not fit."""
    try:
        return msgspec.json.decode(read_bounded(path, MAX_MANIFEST_BYTES), type=kind)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        noun = "collection's list" if kind is CollectionFile else "dataset, collection or selection"
        raise DatasetError(f"{path}: is no {noun} ({printable(error)[:200]})") from None
