"""Does a network know better than constant velocity where movers will be? See
docs/results/movers.md.

    python benchmarks/horizons.py RUN --home DATA... --elsewhere DATA...

It measures a network which that page says how to train, and which takes the four inputs below: what
each of two scans saw. Its target is the map half a second later.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import measuring
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scoring import RESULTS, publish, titled, told
from tyro.conf import Positional

import scenegen
from lidarsim.grid import Field, Floats, GridSpec, Mask, iou
from lidarsim.voxelization import ObservedGrid, voxelize
from scenegen import Sample
from scenegen.model.bench.moving import Later, about_movers, flow, tracked, tracks
from scenegen.model.bench.statistics import holm, paired_p
from scenegen.model.completion.completer import Completer

if TYPE_CHECKING:
    from torch import Tensor

AFTER_S = 0.5
WEIGHT = 10
"""In the loss, of a voxel about a mover; others have 1. Occupied ones have five times as much."""
NEAR_M = 0.3
"""Completed voxels so near to the returns of a mover move with it."""
THRESHOLDS = np.linspace(0.05, 0.95, 19)
INPUTS = "now", "now_free", "before", "before_free"
NETWORK = "network"
RIVALS = "its completion stays", "its completion at constant velocity"
MADE = "returns", "`tracked`", "truth stays", "`flow`"
"""Other rows, told beside them."""


def now(sample: Any, grid: GridSpec, sensor: Any) -> Mask:
    """Channel of the voxels that hold a return of the latest scan."""
    return scan_of(sample, 0).observed


def now_free(sample: Any, grid: GridSpec, sensor: Any) -> Mask:
    """Channel of the voxels that its rays crossed."""
    return scan_of(sample, 0).free


def before(sample: Any, grid: GridSpec, sensor: Any) -> Mask:
    """As `now`, of the scan before."""
    return scan_of(sample, 1).observed


def before_free(sample: Any, grid: GridSpec, sensor: Any) -> Mask:
    """As `now_free`, of the scan before."""
    return scan_of(sample, 1).free


@lru_cache(2)  # two channels of each scan
def scan_of(sample: Any, number: int) -> ObservedGrid:
    """What a scan saw, latest first, in the sample's map."""
    return voxelize(sample.scans()[number], sample.grid, sample.origin)


class Soon(Later):
    """Occupancy after `AFTER_S`; voxels about movers weigh more."""

    def __init__(self) -> None:
        super().__init__(AFTER_S)

    @property
    def metrics(self) -> Mapping[str, Any]:  # type: ignore[override]
        """None: this script measures it."""
        return {}

    def truth(self, sample: Sample, grid: GridSpec) -> NDArray[Any]:
        """(*grid.shape) uint8: 1 for occupied, and 2 more about movers."""
        return super().truth(sample, grid) + 2 * about_movers(sample, AFTER_S).astype(np.uint8)

    def loss(self, output: "Tensor", batch: Mapping[str, "Tensor"], objective: Any) -> "Tensor":
        """Weighted binary cross-entropy, see `Target.loss`."""
        from torch import where
        from torch.nn.functional import softplus

        occupied, about = batch["soon"] % 2 == 1, batch["soon"] >= 2
        weight = where(about, WEIGHT, 1.0) * where(occupied, objective.config.occupied_weight, 1.0)
        return (weight * softplus(where(occupied, -output, output).float())).mean()


class Options(measuring.Options):
    """The network, and what it is measured on."""

    run: Positional[Path]
    """the folder of its training; with --smoke, it is trained there"""
    home: Sequence[Path]
    """datasets of the kinds that it learned from"""
    elsewhere: Sequence[Path]
    """datasets of other kinds"""
    figures: Path = RESULTS / "movers.csv"


def main() -> None:
    """Choose thresholds on validation maps of `home`; test on both; print the tables."""
    places = {name: [Path("data") / name] for name in ("home", "elsewhere")}
    given = measuring.parse(Options, run=Path("run"), **places)
    if given.smoke:
        learn(given)
    own = ",".join(f"horizons:{name}" for name in (*INPUTS, "Soon"))
    network = Completer.from_pretrained(f"{own}@{given.run}")
    found = [
        np.array([curve(volume, sample) for volume in volumes(network, sample).values()])
        for _, sample in samples(given.home, "val")
    ]
    at = dict(zip((NETWORK, *RIVALS, *MADE), np.nanmean(found, axis=0).argmax(axis=1), strict=True))
    lines, tests = [], {}
    for where in ("home", "elsewhere"):
        worlds, moving, whole = [], [], []
        for world, sample in samples(getattr(given, where), "test"):
            worlds.append(world)
            later, about = sample.motion.occupancy(AFTER_S), about_movers(sample, AFTER_S)
            answers = {
                name: volume > THRESHOLDS[at[name]]
                for name, volume in volumes(network, sample).items()
            }
            moving.append([iou(one[about], later[about]) for one in answers.values()])
            whole.append([iou(one, later) for one in answers.values()])
        by_row = dict(zip(at, np.array(moving).T, strict=True))
        rows = [
            (name, [told(one, worlds, ".3f", "share"), told(all_, worlds, ".3f", "share")])
            for (name, one), all_ in zip(by_row.items(), np.array(whole).T, strict=True)
        ]
        lines += titled(f"## After {AFTER_S} s, {where}", ("IoU, moving", "IoU"), rows)
        for name in RIVALS:
            tests[f"network less {name}, {where}"] = by_row[NETWORK], by_row[name], worlds
    rng = np.random.default_rng(0)
    adjusted = holm([paired_p(*test, rng=rng) for test in tests.values()])
    rows = [
        (what, [told(one - other, worlds, "+.3f"), f"{p:.3g}"])
        for (what, (one, other, worlds)), p in zip(tests.items(), adjusted, strict=True)
    ]
    lines += titled("## Does a network know where movers will be?", ("IoU, moving", "p"), rows)
    publish(given, lines)


def learn(given: Options) -> None:
    """Draw a few samples, and train on them."""
    for (path,) in (given.home, given.elsewhere):
        scenegen.generate(
            "street",
            2,
            out=path,
            val=1,
            test=4,
            mapping={"scans": 2},
            movers="dense",
        )
    inputs = tuple(f"horizons:{name}" for name in INPUTS)
    settings: Any = {"inputs": inputs, "targets": ("horizons:Soon",), "batch": 2, "maps": 2}
    scenegen.train(*given.home, out=given.run, variant="occ", **settings)


def samples(datasets: Sequence[Path], split: str) -> Iterator[tuple[str, Sample]]:
    """Samples of a split in which something moves, each with the name of its world."""
    for path in datasets:
        part = scenegen.load(path, split=split)
        for sample in part:
            if sample.motion.passed(AFTER_S).any():
                yield f"{path.name} {sample.world}", sample


def volumes(network: Completer, sample: Sample) -> dict[str, Field]:
    """What each row says of the map after `AFTER_S`: probabilities (*grid.shape)."""
    said = network(sample)
    still = said.occupancy_probability
    return {
        NETWORK: said.others["soon"],
        RIVALS[0]: still,
        RIVALS[1]: carried(still, sample),
        "returns": sample.observed,
        "`tracked`": tracked(sample)(AFTER_S),
        "truth stays": sample.occupancy,
        "`flow`": flow(sample)(AFTER_S),
    }


def carried(still: Field, sample: Any) -> Field:
    """A completion in which voxels near returns that moved go on at their velocity."""
    result = still.copy()
    centres = sample.grid.centres(sample.origin)
    moved = []
    for points, velocity, _ in tracks(sample):
        low, high = points.min(axis=0) - NEAR_M, points.max(axis=0) + NEAR_M
        index = np.argwhere(((centres >= low) & (centres <= high)).all(axis=-1))
        near = KDTree(points).query(centres[tuple(index.T)])[0] <= NEAR_M
        moved.append((tuple(index[near].T), velocity))
        result[moved[-1][0]] = 0
    for voxels, velocity in moved:
        to = sample.grid.index(centres[voxels] + AFTER_S * velocity, sample.origin)
        inside = ((to >= 0) & (to < still.shape)).all(axis=1)
        np.maximum.at(result, tuple(to[inside].T), still[voxels][inside])
    return result


def curve(volume: Field, sample: Sample) -> Floats:
    """IoU about movers, at each of `THRESHOLDS`."""
    about = about_movers(sample, AFTER_S)
    later = sample.motion.occupancy(AFTER_S)[about]
    return np.array([iou(volume[about] > at, later) for at in THRESHOLDS])


if __name__ == "__main__":
    main()
