"""Does a network know better than constant velocity where movers will be? See
docs/results/movers.md.

    python benchmarks/horizons.py RUN --home DATA... --elsewhere DATA...

It measures a network which that page says how to train, and which takes the four inputs below: what
each of two scans saw. Its target is the map half a second later.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
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
from scenegen.model.bench.moving import Later, about_movers, flow, tracks
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
RIVALS = "its completion stays", "its completion at constant velocity"
ROWS = "network", *RIVALS, "returns", "truth stays", "`flow`"


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
    workers: int = 2
    """processes"""
    figures: Path = RESULTS / "movers.csv"


def main() -> None:
    """Choose thresholds on validation maps of `home`; test on both; print the tables."""
    places = {name: [Path("data") / name] for name in ("home", "elsewhere")}
    given = measuring.parse(Options, run=Path("run"), **places)
    if given.smoke:
        learn(given)
    with ProcessPoolExecutor(given.workers) as pool:
        (_, known, _), *tested = (
            zip(*filter(None, pool.map(measured, *maps_of(given.run, *part))), strict=True)
            for part in ((given.home, "val"), (given.home, "test"), (given.elsewhere, "test"))
        )
    at = np.nanmean(known, axis=0).argmax(axis=1)[:, None]
    lines, tests = [], {}
    for where, (worlds, about, whole) in zip(("home", "elsewhere"), tested, strict=True):
        moving, everywhere = (
            np.take_along_axis(np.array(part), at[None], axis=2)[:, :, 0].T
            for part in (about, whole)
        )
        rows = [
            (name, [told(one, worlds, ".3f", "share") for one in pair])
            for name, *pair in zip(ROWS, moving, everywhere, strict=True)
        ]
        lines += titled(f"## After {AFTER_S} s, {where}", ("IoU about movers", "IoU"), rows)
        for rival in (1, 2):
            tests[f"network less {ROWS[rival]}, {where}"] = moving[0], moving[rival], worlds
    rng = np.random.default_rng(0)
    adjusted = holm([paired_p(*test, rng=rng) for test in tests.values()])
    rows = [
        (label, [told(one - other, worlds, "+.3f"), f"{p:.3g}"])
        for (label, (one, other, worlds)), p in zip(tests.items(), adjusted, strict=True)
    ]
    lines += titled("## Does a network know where movers will be?", ("IoU, moving", "p"), rows)
    publish(given, lines)


def maps_of(run: Path, datasets: Sequence[Path], split: str) -> Iterator[tuple[Any, ...]]:
    """What `measured` is given for every map of a split, argument by argument."""
    numbers = [(path, n) for path in datasets for n in range(len(scenegen.load(path, split=split)))]
    return zip(*((run, path, split, n) for path, n in numbers), strict=True)


def measured(run: Path, path: Path, split: str, number: int) -> tuple[str, Floats, Floats] | None:
    """Measure a map.

    Returns:
        The name of its world; and IoU about movers and of the whole map of every row at every
        threshold, (rows, thresholds) each. None if nothing moves in it.
    """
    sample: Any = scenegen.load(path, split=split)[number]
    if not sample.motion.passed(AFTER_S).any():
        return None
    later, about = sample.motion.occupancy(AFTER_S), about_movers(sample, AFTER_S)
    answers = volumes(network_of(run), sample)
    moving = [[iou(one[about] > at, later[about]) for at in THRESHOLDS] for one in answers]
    whole = [[iou(one > at, later) for at in THRESHOLDS] for one in answers]
    return f"{path.name} {sample.world}", np.array(moving), np.array(whole)


@lru_cache(1)
def network_of(run: Path) -> Completer:
    """The network of a run, which may be made of this script's code."""
    own = ",".join(f"horizons:{name}" for name in (*INPUTS, "Soon"))
    return Completer.from_pretrained(f"{own}@{run}")


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


def volumes(network: Completer, sample: Sample) -> list[Field]:
    """Each row's answer for the map after `AFTER_S`: probabilities (*grid.shape)."""
    said = network(sample)
    still = said.occupancy_probability
    soon, truth = said.others["soon"], sample.occupancy
    return [soon, still, carried(still, sample), sample.observed, truth, flow(sample)(AFTER_S)]


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


if __name__ == "__main__":
    main()
