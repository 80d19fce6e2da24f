"""What the bench compares: completers, the truth itself, and predictions that somebody else made."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Protocol

import h5py
import numpy as np

from lidarsim import GridSpec
from model.complete import MapCompleter, Prediction
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError
from scenegen.sample import Sample

FIELDS = ("occupancy_probability", "tudf")
"""Names of a prediction's parts in a predictions file."""


class Method(Protocol):
    """A row of the tables. Methods travel to worker processes."""

    @property
    def name(self) -> str:
        """How the method is called in tables."""
        ...

    def completion(self, sample: Sample, *, split: str, grid: GridSpec) -> Prediction:
        """What the method says about a sample's map."""
        ...


@dataclass(frozen=True)
class Completed:
    """A completer, shown nothing but what was seen."""

    completer: MapCompleter

    @property
    def name(self) -> str:
        """The completer's."""
        return self.completer.name

    def completion(self, sample: Sample, *, split: str, grid: GridSpec) -> Prediction:
        """See `Method.completion`."""
        return self.completer.complete(sample.observed, sample.free, grid=grid)


@dataclass(frozen=True)
class Truth:
    """The truth as if it had been predicted: the ceiling, and what the planner itself loses."""

    name: str = "truth"

    def completion(self, sample: Sample, *, split: str, grid: GridSpec) -> Prediction:
        """See `Method.completion`."""
        return Prediction(occupancy_probability=sample.occupancy.astype(np.float32), tudf=sample.tudf)


@dataclass(frozen=True)
class Predicted:
    """Predictions in an HDF5 file: `occupancy_probability` and/or `tudf`, float32 (N, *grid.shape), and who is who:
    attribute `dataset` (the dataset's digest), `world` and `viewpoint`, int64 (N,), and `split`, an attribute."""

    path: Path
    name: str = field(default="predicted")

    def check(self, dataset: Dataset, split: str) -> None:
        """Raise DatasetError unless the file predicts every sample of `split` of `dataset`, on its grid, in numbers."""
        try:
            with h5py.File(self.path, "r") as file:
                self._check(file, dataset, split)
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot be read as HDF5: {error}") from None

    def _check(self, file: h5py.File, dataset: Dataset, split: str) -> None:
        digest, digest_here = file.attrs.get("dataset"), dataset.manifest["digest"]
        if digest != digest_here:
            raise DatasetError(
                f"{self.path}: predicts dataset {str(digest)[:12]}…, not {dataset.folder} ({digest_here[:12]}…); "
                "predict this one, and copy its digest into the attribute `dataset`"
            )
        if file.attrs.get("split") != split:
            raise DatasetError(f"{self.path}: predicts split {file.attrs.get('split')!r}, expected {split!r}")
        parts = [name for name in FIELDS if name in file]
        if not parts or "world" not in file or "viewpoint" not in file:
            raise DatasetError(
                f"{self.path}: expected world, viewpoint, and at least one of {', '.join(FIELDS)}; "
                f"found {', '.join(file) or 'nothing'}"
            )
        missing = [name for name in dataset.split(split).names if name[1:] not in self._rows]
        if missing:
            raise DatasetError(
                f"{self.path}: {len(missing)} of {len(dataset.split(split))} samples are missing, the first is world "
                f"{missing[0][1]}, viewpoint {missing[0][2]}; predict all of split {split}"
            )
        for name in parts:
            if file[name].shape[1:] != dataset.grid.shape:
                raise DatasetError(
                    f"{self.path}: {name} holds maps of {file[name].shape[1:]}, expected {dataset.grid.shape}"
                )
            for row in self._rows.values():
                if not np.isfinite(file[name][row]).all():
                    raise DatasetError(f"{self.path}: {name}[{row}] holds NaN or infinity; every voxel needs a number")

    @cached_property
    def _rows(self) -> dict[tuple[int, int], int]:
        """Row of every (world, viewpoint)."""
        with h5py.File(self.path, "r") as file:
            pairs = zip(file["world"][:].tolist(), file["viewpoint"][:].tolist(), strict=True)
            return {pair: row for row, pair in enumerate(pairs)}

    def completion(self, sample: Sample, *, split: str, grid: GridSpec) -> Prediction:
        """See `Method.completion`."""
        row = self._rows[int(sample.world), int(sample.viewpoint)]
        with h5py.File(self.path, "r") as file:
            return Prediction(**{name: file[name][row].astype(np.float32) for name in FIELDS if name in file})
