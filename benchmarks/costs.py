"""What costs IoU in real places: the voxels that are wrong, by how the scan saw them; and pictures.

    python benchmarks/costs.py MAPS     # "What costs IoU" and the pictures of docs/results/real.md

MAPS is the folder that `real.py` takes. Each method has the threshold that is best for it in the
mean of the places. The tables are printed; `--pictures` names the folder for a picture of each
place.
"""

import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import measuring
import numpy as np
from PIL import Image
from real import (
    NETWORKS,
    POSES,
    THRESHOLDS,
    UNLEARNED,
    Table,
    best_in,
    is_mean,
    level_of,
    maps_to_complete,
)
from scipy import ndimage
from scoring import maps_in, titled
from tyro.conf import Positional

from lidarsim.grid import Floats, Ints
from scenegen import Dataset
from scenegen.dataset.read import Split
from scenegen.draw.scored import scored_voxels
from scenegen.model.bench.methods import Method, rows_of
from scenegen.model.bench.visibility import CLASSES, UNSCORED, classify
from scenegen.view.look import Guess, look_into
from scenegen.view.stills import draw, to_bytes

MISSED = (
    "missed: holds a return",
    "missed: crossed by a ray",
    "missed: hidden, its column holds a return",
    "missed: hidden, its column holds none",
    "missed: inside",
    "missed: out of view, above the sensor",
    "missed: out of view, below it",
)
"""Occupied voxels that were not said to be, by how the scan saw them, see `CLASSES`."""
INVENTED = (
    "invented: touches what is there",
    "invented: crossed by a ray",
    "invented: elsewhere",
)
"""Free voxels that were said to be occupied."""
GROUPS = MISSED + INVENTED
COLOURS = 96
"""Of a picture: it is half as large as with all."""


class Counts(NamedTuple):
    """What some maps lose, by threshold and by group."""

    iou: Floats
    """(maps, thresholds)."""
    lost: Floats
    """(maps, thresholds, groups): points of IoU that a group's wrong voxels cost."""
    there: Ints
    """(groups,): the voxels of all maps."""
    said: Ints
    """(thresholds, groups): those of them that are said to be occupied."""


class Options(measuring.Options):
    """What is completed."""

    real: Positional[Path | None] = None
    """folder of the maps"""
    network: Sequence[str] = NETWORKS
    """a bundled one's name, a file or a run"""
    maps: int = POSES
    """maps of each place, at most"""
    pictures: Path | None = None
    """folder for them, by the last method"""


def main() -> None:
    """Print the tables, and draw the pictures."""
    given = measuring.parse(Options, maps=2, network=["columns"], pictures=Path())
    methods = rows_of(UNLEARNED, given.network)
    with tempfile.TemporaryDirectory() as folder:
        every = maps_to_complete(given, Path(folder))
        places = {name: one for name, one in every.items() if is_mean(name)} or every
        counts: Table = {name: counted(dataset, methods) for name, dataset in places.items()}
        best = best_in(counts, list(places))
        print("\n".join(tables(counts, best)))
        last = methods[-1].name
        if not given.pictures:
            return
        for name, dataset in places.items():
            order = np.argsort(counts[name][last].iou[:, best[last]])
            drawn = drawn_map(dataset, int(order[len(order) // 2]), methods[-1], best[last])
            (given.pictures / f"{name.strip('`')}.png").write_bytes(drawn)


def counted(dataset: Dataset, methods: list[Method]) -> dict[str, Counts]:
    """The voxels of a dataset's maps by group, as each method completes them."""
    samples = maps_in(dataset)
    groups = [groups_of(samples, index) for index in range(len(samples))]
    there = np.array(list(map(sums, groups)))
    found = {}
    for method in methods:
        rows = []
        for sample, group in zip(samples, groups, strict=True):
            level = level_of(method.completion(sample, samples), dataset.grid)
            rows.append([sums(group[level >= threshold]) for threshold in THRESHOLDS])
        said = np.array(rows)  # (maps, thresholds, groups)
        wrong = np.where(np.arange(len(GROUPS)) < len(MISSED), there[:, None] - said, said)
        right = said[..., : len(MISSED)].sum(axis=2)
        either = np.maximum(right + wrong.sum(axis=2), 1)
        lost = 100 * (wrong / either[..., None])
        found[method.name] = Counts(right / either, lost, there.sum(axis=0), said.sum(axis=0))
    return found


def sums(groups: Ints) -> Ints:
    """How many voxels are of each group."""
    return np.bincount(groups.ravel(), minlength=len(GROUPS))[: len(GROUPS)]


def groups_of(samples: Split, index: int) -> Ints:
    """What each voxel (*grid.shape) of a sample would be if it were wrong, an index into `GROUPS`;
    `UNSCORED` where no score counts it."""
    sample, grid = samples[index], samples.dataset.grid
    seen = classify(sample, grid=grid)
    is_of = {name: seen == number for number, name in enumerate(CLASSES)}
    told = sample.observed.any(axis=2, keepdims=True)
    above = grid.centres(sample.origin)[..., 2] > sample.position[2]
    hidden, out = is_of["occluded"], is_of["out_of_view"]
    missed = [is_of["observed"], is_of["crossed"], hidden & told, hidden, is_of["interior"]]
    beside = ndimage.binary_dilation(sample.occupancy, np.ones((3, 3, 3)))
    first = len(MISSED)
    groups = np.where(
        sample.occupancy,
        np.select([*missed, out & above], range(first - 1), first - 1),
        np.select([beside, is_of["crossed"]], (first, first + 1), first + 2),
    )
    scored_here = scored_voxels(sample, grid, samples.home(index).tables.world)
    return np.where(scored_here, groups, UNSCORED)


def tables(counts: Table, best: dict[str, int]) -> list[str]:
    """What costs IoU, by group: for every method, then of the last one in every place."""
    *_, last = best
    places = list(counts.values())
    rows, by_place = [], []
    for n, group in enumerate(GROUPS):
        missed = n < len(MISSED)
        sizes = [found[last].there[n] / found[last].there[: len(MISSED)].sum() for found in places]
        cells = [f"{100 * np.mean(sizes):.0f} %" if missed else ""]
        for method, number in best.items():
            of_method = [found[method] for found in places]
            lost = [one.lost[:, number, n].mean() for one in of_method]
            recalls = [one.said[number, n] / max(one.there[n], 1) for one in of_method]
            recall = f" · {100 * np.mean(recalls):.0f} %" if missed else ""
            cells.append(f"{np.mean(lost):.1f}{recall}")
        rows.append((group, cells))
        by_place.append((group, [f"{one:.1f}" for one in lost]))  # of the last method
    heads = (f"{name} at {THRESHOLDS[number]:g}" for name, number in best.items())
    lines = titled("## What costs IoU", ("of what is occupied", *heads), rows)
    return lines + titled(f"By place, `{last}`:", counts, by_place)


def drawn_map(dataset: Dataset, index: int, method: Method, threshold: int) -> bytes:
    """A picture of a scan, the truth, and what a method says of known voxels."""

    def guess(samples: Split, index: int) -> list[Guess]:
        sample = samples[index]
        said = method.completion(sample, samples)
        here = scored_voxels(sample, dataset.grid, samples.home(index).tables.world)
        occupied = said.occupancy_probability >= THRESHOLDS[threshold]
        tudf = said.distance(None, dataset.grid)
        return [Guess(name=method.name, occupied=occupied & here, tudf=tudf)]

    shown = look_into(maps_in(dataset), index, guess)
    file = io.BytesIO(to_bytes(draw([shown]), ".png"))
    picture, small = Image.open(file).convert("RGB"), io.BytesIO()
    picture.quantize(COLOURS).save(small, "PNG", optimize=True)
    return small.getvalue()


if __name__ == "__main__":
    main()
