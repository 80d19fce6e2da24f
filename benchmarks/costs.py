"""What costs IoU in real places: the voxels that are wrong, by how the scan saw them; and pictures.

    python benchmarks/costs.py MAPS     # "What costs IoU" and the pictures of docs/results/real.md

MAPS is the folder that `real.py` takes. Each method has the threshold that is best for it in the
mean of the places. The tables are printed; `--pictures` names the folder for a picture of each
place.
"""

import io
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import measuring
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from real import NETWORKS, POSES, THRESHOLDS, is_mean, maps_to_complete
from scipy import ndimage
from scoring import networks, split_of, titled

from scenegen.dataset.read import Dataset
from scenegen.display.figures import draw_completions
from scenegen.display.look import Guess, look_into
from scenegen.display.panels import to_bytes
from scenegen.model.completion.unlearned import Conservative, Extrude, Returns
from scenegen.model.evaluation.methods import Completed, Method
from scenegen.model.evaluation.statistics import line
from scenegen.model.evaluation.visibility import CLASSES, UNSCORED, classify, scored_voxels
from scenegen.sample import Sample

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
    """Voxels of some maps by group."""

    there: NDArray[np.int64]
    """(maps, groups)."""
    said: NDArray[np.int64]
    """(maps, thresholds, groups): those that are said to be occupied."""

    @property
    def either(self) -> NDArray[np.int64]:
        """(maps, thresholds): voxels that are occupied, or said to be."""
        occupied = self.there[:, None, : len(MISSED)].sum(axis=2)
        invented: NDArray[np.int64] = self.said[..., len(MISSED) :].sum(axis=2)
        return occupied + invented

    @property
    def iou(self) -> NDArray[np.float64]:
        """(maps, thresholds)."""
        return self.said[..., : len(MISSED)].sum(axis=2) / np.maximum(self.either, 1)

    def size(self, group: int) -> float:
        """The share of a group in what is occupied."""
        return float(self.there[:, group].sum() / self.there[:, : len(MISSED)].sum())

    def share(self, group: int, threshold: int) -> tuple[float, float]:
        """The points of IoU that a group costs, a mean over maps, and its recall."""
        said = self.said[:, threshold, group]
        wrong = self.there[:, group] - said if group < len(MISSED) else said
        lost = 100 * (wrong / np.maximum(self.either[:, threshold], 1)).mean()
        return float(lost), float(said.sum() / max(self.there[:, group].sum(), 1))


Table = dict[str, dict[str, Counts]]
"""What was counted, by place and by method."""


def main() -> None:
    """Print the tables, and draw the pictures."""
    parser = measuring.options(__doc__)
    parser.add_argument("real", type=Path, nargs="?", metavar="MAPS", help="folder of the maps")
    parser.add_argument("--network", action="append", help="a bundled one's name, a file or a run")
    parser.add_argument("--maps", type=int, default=POSES, help="maps of each place, at most")
    parser.add_argument("--pictures", type=Path, help="folder for them, by the last method")
    given = measuring.parse(parser, maps=2, network=["columns"], pictures=Path())
    unlearned = [Completed(one) for one in (Extrude(), Returns(), Conservative())]
    methods: list[Method] = [*unlearned, *networks(given.network or NETWORKS)]
    with tempfile.TemporaryDirectory() as folder:
        every = maps_to_complete(given, Path(folder))
        places = {name: one for name, one in every.items() if is_mean(name)} or every
        counts = {name: counted(dataset, methods) for name, dataset in places.items()}
        best = {
            one.name: int(
                np.mean([found[one.name].iou.mean(axis=0) for found in counts.values()], 0).argmax()
            )
            for one in methods
        }
        print("\n".join(tables(counts, best)))
        last = methods[-1].name
        for name, dataset in places.items() if given.pictures else ():
            order = np.argsort(counts[name][last].iou[:, best[last]])
            drawn = drawn_map(dataset, int(order[len(order) // 2]), methods[-1], best[last])
            (given.pictures / f"{name.strip('`')}.png").write_bytes(drawn)


def counted(dataset: Dataset, methods: list[Method]) -> dict[str, Counts]:
    """The voxels of a dataset's maps by group, as each method completes them."""
    samples = dataset.split(split_of(dataset))
    groups = [groups_of(samples, index) for index in range(len(samples))]
    there = np.array([sums(group) for group in groups])
    found = {}
    for method in methods:
        said = []
        for sample, group in zip(samples, groups, strict=True):
            guess = method.completion(sample, samples)
            probability: Any = guess.occupancy_probability
            if probability is None:  # of distances alone, a level for thresholds
                distance_m = guess.distance(None, dataset.grid)
                probability = 1 - distance_m / dataset.grid.truncation_m
            said.append([sums(group[probability >= threshold]) for threshold in THRESHOLDS])
        found[method.name] = Counts(there, np.array(said))
    return found


def sums(groups: NDArray[np.uint8]) -> NDArray[np.int64]:
    """How many voxels are of each group."""
    return np.bincount(groups.ravel(), minlength=len(GROUPS))[: len(GROUPS)]


def groups_of(samples: Any, index: int) -> NDArray[np.uint8]:
    """What each voxel (*grid.shape) of a sample would be if it were wrong, an index into `GROUPS`;
    `UNSCORED` where no score counts it."""
    sample, dataset = samples[index], samples.dataset
    seen = classify(sample, lidar=dataset.lidar, grid=dataset.grid)
    is_of = {name: seen == number for number, name in enumerate(CLASSES)}
    told = np.broadcast_to(sample.observed.any(axis=2, keepdims=True), seen.shape)
    above = dataset.grid.centres(sample.origin)[..., 2] > sample.position[2]
    hidden, out = is_of["occluded"], is_of["out_of_view"]
    missed = [is_of["observed"], is_of["crossed"], hidden & told, hidden, is_of["interior"]]
    beside = ndimage.binary_dilation(sample.occupancy, np.ones((3, 3, 3)))
    first = len(MISSED)
    groups = np.where(
        sample.occupancy,
        np.select([*missed, out & above], range(first - 1), first - 1),
        np.select([beside, is_of["crossed"]], (first, first + 1), first + 2),
    )
    scored_here = scored_voxels(sample, dataset.grid, samples.home(index).tables)
    return np.where(scored_here, groups, UNSCORED).astype(np.uint8)


def tables(counts: Table, best: dict[str, int]) -> list[str]:
    """What costs IoU, by group: for every method, then of the last one in every place."""
    *_, last = best
    heads = (f"{name} at {THRESHOLDS[number]:g}" for name, number in best.items())
    lines = titled("## What costs IoU", ("of what is occupied", *heads))
    for n, group in enumerate(GROUPS):
        missed = n < len(MISSED)
        size = 100 * np.mean([found[last].size(n) for found in counts.values()])
        cells = [f"{size:.0f} %" if missed else ""]
        for method, number in best.items():
            shares = [found[method].share(n, number) for found in counts.values()]
            lost, recall = np.mean(np.array(shares), axis=0)
            cells.append(f"{lost:.1f} · {100 * recall:.0f} %" if missed else f"{lost:.1f}")
        lines.append(line(group, cells))
    lines += titled(f"By place, `{last}`:", counts)
    for n, group in enumerate(GROUPS):
        lost_in = [found[last].share(n, best[last])[0] for found in counts.values()]
        lines.append(line(group, [f"{one:.1f}" for one in lost_in]))
    return lines


def drawn_map(dataset: Dataset, index: int, method: Method, threshold: int) -> bytes:
    """A picture of a scan, the truth, and what a method says of known voxels."""

    def guess(sample: Sample, samples: Any) -> list[Guess]:
        said = method.completion(sample, samples)
        probability: Any = said.occupancy_probability
        here = scored_voxels(sample, dataset.grid, samples.home(index).tables)
        occupied, tudf = probability >= THRESHOLDS[threshold], said.distance(None, dataset.grid)
        return [Guess(name=method.name, occupied=occupied & here, tudf=tudf)]

    shown = look_into(dataset.split(split_of(dataset)), index, guess)
    file = io.BytesIO(to_bytes(draw_completions([shown], title=""), ".png"))
    picture, small = Image.open(file).convert("RGB"), io.BytesIO()
    picture.quantize(COLOURS).save(small, "PNG", optimize=True)
    return small.getvalue()


if __name__ == "__main__":
    main()
