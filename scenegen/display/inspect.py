"""What is in a dataset, in a folder of datasets, or in a world: counts, sizes, statistics, and what
does not fit."""

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Sensor
from scenegen import SPLITS
from scenegen.dataset.choose import FIGURES
from scenegen.dataset.manifest import NAME
from scenegen.dataset.read import Dataset, Split
from scenegen.dataset.trust import load
from scenegen.errors import DatasetError, printable
from scenegen.run.workers import run
from scenegen.stores.cache import bytes_in

SHAPES = (
    "planes",
    "height fields",
    "spheres",
    "capsules",
    "ellipsoids",
    "cylinders",
    "boxes",
    "meshes",
)
"""What MuJoCo's codes of shapes stand for."""
AT_ONCE = 200
"""Samples that a process measures before it tells of them."""
MOST_MEASURED = 200
"""Samples of a split that are measured, unless all are."""
MOST_LISTED = 1000
"""The most datasets of a list."""
MOST_BEYOND = 0.4
"""The share of a map beyond its sensor's range from which on it is told; of the presets' maps it is
0.06."""


@dataclass(frozen=True, eq=False)
class Spread:
    """How numbers spread, of which there may be too many to keep."""

    count: int = 0
    mean: float = 0.0
    squares: float = 0.0
    """The sum of their squared differences from the mean."""
    least: float = math.inf
    most: float = -math.inf

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """That of `values`."""
        if not values:
            return cls()
        return cls(
            len(values),
            float(np.mean(values)),
            float(np.var(values)) * len(values),
            min(values),
            max(values),
        )

    def __add__(self, other: "Spread") -> "Spread":
        """That of both (Chan, Golub, LeVeque: Updating formulae for computing sample variances,
        1979, eq. 2.1)."""
        count = self.count + other.count
        if not self.count or not other.count:
            return self if self.count else other
        apart, share = other.mean - self.mean, other.count / count
        squares = self.squares + other.squares + apart * apart * self.count * share
        least, most = min(self.least, other.least), max(self.most, other.most)
        return Spread(count, self.mean + apart * share, squares, least, most)

    def said(self) -> dict[str, float | None]:
        """{mean, std, min, max}, None each where there is no number."""
        if not self.count:
            return dict.fromkeys(("mean", "std", "min", "max"))
        std = math.sqrt(self.squares / self.count)
        return {"mean": self.mean, "std": std, "min": self.least, "max": self.most}


def inspect(
    folder: Path,
    *,
    most: int | None = MOST_MEASURED,
    values: bool = False,
    workers: int = 1,
    on_start: Callable[[int], None] = lambda samples: None,
    on_done: Callable[[int], None] = lambda samples: None,
) -> dict[str, Any]:
    """A summary of the dataset in `folder`; statistics are taken over at most `most` samples a
    split, evenly spread, or over all where that is None, by `workers` processes.

    Shares are of all voxels or of all rays, {mean, std, min, max} over samples, None where no
    sample has the figure. With `values`, every split has those of the measured samples, too, by
    figure. `on_start` is called with the number of samples that are measured, once processes run,
    `on_done` with that of every few. Raises DatasetError.
    """
    dataset = Dataset(folder, partial=True)
    it = dataset.manifest
    found = {
        **{
            "kind": it.kind,
            "seed": it.seed,
            "complete": it.complete,
            "digest": it.digest,
            "fields": list(it.fields),
        },
        **{
            "grid": it.parameters["grid"],
            "rejected": it.rejected,
            "mapping": it.parameters.get("mapping"),
        },
    }
    if it.sources:
        found["sources"] = [
            {"kind": one.kind, "seed": one.seed, "digest": one.digest, "taken": entry["taken"]}
            for one, entry in zip(it.sources, it.parameters["sources"], strict=True)
        ]
    splits = [split for split in map(dataset.split, SPLITS) if len(split)]
    tasks = [(split.name, chosen) for split in splits for chosen in _chosen(split, most)]
    measured: list[tuple[dict[str, Spread], dict[str, list[float]]]] = [({}, {})] * len(tasks)
    begun = partial(on_start, sum(len(chosen) for _, chosen in tasks))
    with closing(
        run(partial(_measure, dataset, values), enumerate(tasks), workers, begun)
    ) as results:
        for number, spreads, rows in results:
            measured[number] = spreads, rows
            on_done(len(tasks[number][1]))
    said = {split.name: _describe(split, tasks, measured, values) for split in splits}
    size = bytes_in(folder)
    samples = sum(split["samples"] for split in said.values())
    return {
        **found,
        "samples": samples,
        "bytes": size,
        "bytes_per_sample": size / max(samples, 1),
        "splits": said,
    }


def _chosen(split: Split, most: int | None) -> list[NDArray[np.int64]]:
    """Numbers of the samples that are measured, some at a time."""
    count = len(split)
    found = (
        np.arange(count)
        if most is None
        else np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))
    )
    return np.split(found, range(AT_ONCE, len(found), AT_ONCE))


def _describe(
    split: Split, tasks: Sequence[Any], measured: Sequence[Any], values: bool
) -> dict[str, Any]:
    """What is told of a split, from what was measured by task."""
    mine = [
        (chosen, *found)
        for (name, chosen), found in zip(tasks, measured, strict=True)
        if name == split.name
    ]
    spreads = {
        name: sum((found[name] for _, found, _ in mine), start=Spread()).said() for name in FIGURES
    }
    rows = (
        {name: [value for _, _, found in mine for value in found[name]] for name in FIGURES}
        if values
        else {}
    )
    return {
        "samples": len(split),
        "worlds": split.count_worlds(),
        "sampled": sum(len(chosen) for chosen, _, _ in mine),
        "statistics": spreads,
        **({"values": rows} if values else {}),
    }


def _measure(
    dataset: Dataset, values: bool, task: tuple[int, tuple[str, NDArray[np.int64]]]
) -> tuple[int, dict[str, Spread], dict[str, list[float]]]:
    """The number of a task, how the figures of its samples spread, and, if asked for, their values,
    where they have any."""
    number, (name, chosen) = task
    split = dataset.split(name)
    rows: dict[str, list[float]] = {name: [] for name in FIGURES}
    for sample in (split[index] for index in chosen.tolist()):
        for name, figure in FIGURES.items():
            if not math.isnan(value := figure(sample)):
                rows[name].append(value)
    return number, {name: Spread.of(found) for name, found in rows.items()}, rows if values else {}


def inspect_all(folder: Path) -> list[dict[str, Any]]:
    """A line for each dataset in a folder's folders: its `folder`, and its kind, samples and
    digest, or its `fault`."""
    found = []
    for path in sorted(folder.glob(f"*/{NAME}"))[:MOST_LISTED]:
        row: dict[str, Any] = {"folder": str(path.parent)}
        try:
            it = load(path.parent)
            samples = {
                name: sum(one.samples for one in it.shards if one.split == name) for name in SPLITS
            }
            row |= {
                "kind": it.kind,
                "samples": samples,
                "complete": it.complete,
                "digest": it.digest,
            }
        except DatasetError as error:
            row["fault"] = printable(error)
        found.append(row)
    return found


def inspect_world(path: Path) -> dict[str, Any]:
    """What stands in the world of an MJCF file. Raises SceneError for one that cannot serve."""
    from scenegen.source import read_world  # which loads what compiles worlds

    world = read_world(path)
    codes, counts = np.unique(world.solids.shape, return_counts=True)
    solids = {SHAPES[int(code)]: int(count) for code, count in zip(codes, counts, strict=True)}
    if len(world.solids.mesh_filled):
        solids["meshes"] = len(world.solids.mesh_filled)
    return {
        "world": str(path),
        "solids": solids,
        "triangles": len(world.solids.triangles),
        "flight_bounds": world.flight_bounds.tolist(),
        "unseen": list(world.unseen),
    }


def misfits(grid: GridSpec, lidar: Sensor) -> list[str]:
    """What of a map its sensor can hardly know, in a line each."""
    half = np.array(grid.extent_m) / 2
    centres = np.stack(
        np.meshgrid(*(np.linspace(-edge, edge, 41) for edge in half), indexing="ij"), axis=-1
    )
    beyond = float((np.linalg.norm(centres, axis=-1) > lidar.max_range_m).mean())
    if beyond <= MOST_BEYOND:
        return []
    return [
        f"{100 * beyond:.0f} % of the map lie beyond the sensor's {lidar.max_range_m:g} m: "
        f"nothing is ever seen there; "
        "take a smaller grid, or a sensor that sees farther"
    ]
