"""What a study measured, map by map and trial by trial, in one small file: all verdicts come from
it alone."""

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen.errors import DatasetError, short
from scenegen.files import read_bounded, write_whole
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.run import DatasetResult
from scenegen.model.evaluation.statistics import figure

MOST_BYTES = 1 << 26
TREE = "about"
"""The member of the archive that is JSON."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """All rows on one dataset."""

    where: str
    """The name of its worlds, or "" for the presets."""
    kind: str
    rows: tuple[str, ...]
    worlds: NDArray[np.int32]
    """(N,): of the maps."""
    trial_worlds: NDArray[np.int32]
    """(trials,)"""
    maps: NDArray[np.float16]
    """(METRICS, rows, N): over the whole map."""
    trials: NDArray[np.float16]
    """(PLAN_METRICS, rows, trials); NaN where there is no path."""

    @classmethod
    def of(cls, where: str, result: DatasetResult) -> "Measured":
        """What is kept of a bench, in half precision, three digits of each."""
        found = result.methods.values()
        maps = np.array([row.reconstruction[:, 0] for row in found], np.float16)
        trials = np.array(
            [
                [[of.of(trial) for trial in row.trials] for of in PLAN_METRICS.values()]
                for row in found
            ]
        )
        return cls(
            where=where,
            kind=result.kind,
            rows=tuple(result.methods),
            worlds=result.worlds.astype(np.int32),
            trial_worlds=result.trial_worlds.astype(np.int32),
            maps=np.moveaxis(maps, -1, 0),
            trials=np.moveaxis(trials.astype(np.float16), 1, 0),
        )

    @classmethod
    def joined(cls, parts: Sequence["Measured"]) -> "Measured":
        """Rows that were measured one by one on the same dataset."""
        return replace(
            parts[0],
            rows=tuple(row for part in parts for row in part.rows),
            maps=np.concatenate([part.maps for part in parts], axis=1),
            trials=np.concatenate([part.trials for part in parts], axis=1),
        )

    def values(self, metric: str, row: str) -> NDArray[np.float64]:
        """The metric of every map, or of every trial."""
        names, held = (METRICS, self.maps) if metric in METRICS else (PLAN_METRICS, self.trials)
        return held[list(names).index(metric), self.rows.index(row)].astype(np.float64)

    def worlds_of(self, metric: str) -> NDArray[np.int32]:
        """The worlds of those values."""
        return self.worlds if metric in METRICS else self.trial_worlds

    def means(self) -> dict[str, dict[str, Any]]:
        """Every metric of every row, {mean, std, low, high, n}."""
        return {
            row: {
                name: figure(self.values(name, row), self.worlds_of(name), metric.scale)
                for name, metric in (METRICS | PLAN_METRICS).items()
            }
            for row in self.rows
        }


ARRAYS = ("worlds", "trial_worlds", "maps", "trials")


@dataclass(frozen=True, kw_only=True)
class Records:
    """A study's measurements."""

    runs: Mapping[str, Mapping[str, Any]]
    """What is told of every run."""
    measured: tuple[Measured, ...]

    def write(self, path: Path) -> None:
        """Write a NumPy archive. Raises DatasetError where the disk refuses."""
        tree = {
            "runs": self.runs,
            "datasets": [[one.where, one.kind, one.rows] for one in self.measured],
        }
        arrays = {
            f"{name}{n}": getattr(one, name)
            for n, one in enumerate(self.measured)
            for name in ARRAYS
        }
        memory = io.BytesIO()
        members: dict[str, Any] = {TREE: np.array(json.dumps(tree)), **arrays}
        np.savez_compressed(memory, **members)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, memory.getvalue())

    @classmethod
    def read(cls, path: Path) -> "Records":
        """What `write` wrote. Raises DatasetError for anything else."""
        try:
            with np.load(io.BytesIO(read_bounded(path, MOST_BYTES)), allow_pickle=False) as archive:
                tree = json.loads(str(archive[TREE]))
                measured = []
                for n, (where, kind, rows) in enumerate(tree["datasets"]):
                    arrays = {name: archive[f"{name}{n}"] for name in ARRAYS}
                    for of, counted, worlds in (
                        ("maps", METRICS, "worlds"),
                        ("trials", PLAN_METRICS, "trial_worlds"),
                    ):
                        if arrays[of].shape != (len(counted), len(rows), len(arrays[worlds])):
                            raise ValueError(f"{of} of {kind} are {arrays[of].shape}")
                    measured.append(Measured(where=where, kind=kind, rows=tuple(rows), **arrays))
            return cls(runs=tree["runs"], measured=tuple(measured))
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from None
        except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise DatasetError(
                f"{path}: is no records of a study ({short(error)}); expected what reproduce wrote"
            ) from None


def presets(measured: Sequence[Measured]) -> dict[str, Measured]:
    """Those on the presets' worlds, by kind."""
    return {one.kind: one for one in measured if not one.where}
