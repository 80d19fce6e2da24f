"""How completions of real places compare with those of drawn worlds.

    python benchmarks/real.py MAPS                          # docs/results/real.csv
    python benchmarks/real.py MAPS --network runs/mine

MAPS is the folder that `places.py` writes; `places.toml` lists the places, and a map that is
missing is left out. The paper's sensor looks from free space along flights of its own, one
viewpoint each, and scores are over known voxels alone. The planner is not told which voxels the map
does not know. Each place counts once, and intervals are over places. The thresholds of IoU are
those that are best on validation maps of drawn kinds. Real scans are completed, too, and compared
with what the other scans of their place know.
"""

import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import measuring
import numpy as np
import scoring
from places import PLACES
from scipy.stats import mannwhitneyu
from scoring import CAREFUL, Results, drawn, maps_in, maps_of, measured, publish, titled, told
from tyro.conf import Positional

from lidarsim.grid import Floats, GridSpec, Mask
from lidarsim.pose import rotate
from scenegen import Dataset, Prediction, preset
from scenegen.base.reading import sha256_of
from scenegen.draw.scored import scored_voxels
from scenegen.logs.read import read_log
from scenegen.model.bench.methods import Method, Truth, rows_of
from scenegen.model.bench.reliability import REGIONS, count, reliability
from scenegen.model.bench.run import MethodResult
from scenegen.model.bench.statistics import brief
from scenegen.model.calibration import denial
from scenegen.model.config import PlanConfig
from scenegen.model.inputs import PointScan
from scenegen.truth.voxels import resample
from scenegen.worlds.cloud import map_clouds

UNLEARNED = ("empty", "extrude", "conservative")
BASE = "extrude"
"""The method that others are compared with."""
NETWORKS = ("columns", "proposed", "anywhere")
KINDS = ("pillar", "geometric")
"""Home: thresholds are chosen on their validation maps."""
POSES = 24
"""Maps of each place, and of each kind at home."""
TRIALS = 96
"""Of each place."""
PLANNERS = {
    "the careful planner": CAREFUL,
    "the paper's planner with edges checked": PlanConfig(edge_check=True),
}


def leaves_known(method: MethodResult) -> Any:
    """Whether each trial's path (trials,) meets no obstacle and yet fails: it leads through voxels
    that the map of the place does not know."""
    ends = method.values("success") + method.values("hits") + np.isnan(method.values("length"))
    return ends == 0


MET: dict[str, Callable[[MethodResult], Any]] = {
    "hits": lambda method: method.values("hits"),
    "success, blocked line": lambda method: method.values("success_blocked"),
    "success": lambda method: method.values("success"),
    "leaves known space, no hit": leaves_known,
    "no path": lambda method: np.isnan(method.values("length")),
}
"""What becomes of each trial (trials,); the first two lead."""
SCANS = 8
"""Real scans of each place that are completed."""
GRID = GridSpec()
"""Of the maps around them."""
THRESHOLDS = np.arange(1, 20) / 20


class Options(scoring.Options):
    """Those of `scoring`, and what else is completed."""

    real: Positional[Path | None] = None
    """folder of the maps"""
    method: Sequence[str] = UNLEARNED
    """without learning"""
    network: Sequence[str] = NETWORKS
    maps: int = POSES
    trials: int = TRIALS


def main() -> None:
    """Score every place, and write the tables."""
    given = measuring.parse(Options, maps=2, trials=2, network=["columns"])
    if BASE not in given.method:
        sys.exit(f"--method: has to name {BASE}, which the others are compared with")
    methods = rows_of(given.method, given.network)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        home = {
            f"`{kind}`": counted(seen_in(drawn_val(kind, folder, given.maps)), methods)
            for kind in KINDS[: 1 if given.smoke else None]
        }
        best = best_in(home)
        places = real_places(given.real, folder, given.maps)
        counts = {place: counted(seen_in(dataset), methods) for place, dataset in places.items()}
        lines = ious(home | counts, best)
        lines += calibrations(home | counts) + told_apart(counts, home)
        for planner, plan in PLANNERS.items():
            results = measured(places, [*methods, Truth()], given.trials, plan)
            lines += paths_met(planner, results)
        lines += scans(given.real, methods, best)
    publish(given, lines)


def drawn_val(kind: str, folder: Path, maps: int) -> Dataset:
    """Validation maps of a drawn kind, one a flight."""
    return drawn(folder / f"{kind}-val", preset(kind), maps, split="val", viewpoints=1)


def maps_to_complete(given: Any, folder: Path) -> dict[str, Dataset]:
    """Test maps of drawn kinds, their names in backticks, and of real places, one a flight."""
    made = {}
    for kind in KINDS[: 1 if given.smoke else None]:
        made[f"`{kind}`"] = drawn(folder / kind, preset(kind), given.maps, viewpoints=1)
    return made | real_places(given.real, folder, given.maps)


def real_places(maps: Path | None, folder: Path, poses: int) -> dict[str, Dataset]:
    """A dataset of each of `PLACES` in which flights fit and whose map lies in the folder `maps`,
    by its name."""
    found: dict[str, Dataset] = {}
    if maps is None:
        return found
    for name, about in PLACES.items():
        file = next(maps.rglob(f"{name}.*"), None)
        if file is None:
            print(f"{name}: is not there; benchmarks/places.py makes it", file=sys.stderr)
        elif about["made"] == "as it is" and sha256_of(file.read_bytes()) != about["sha256"]:
            sys.exit(f"{file}: is another map than was measured; it comes from {about['source']}")
        elif "scans" not in about:
            recipe = preset("scene")
            found[name] = drawn(
                folder / name, recipe, poses, scenes=file, split="train", viewpoints=1
            )
    return found


class LevelScan(PointScan):
    """Points alone, as methods are shown them, in the level frame of their map."""

    lidar = None
    quaternion = np.array([1.0, 0, 0, 0])


class Seen(NamedTuple):
    """What a method is shown, and what its map is compared with."""

    sample: Any
    """A sample, or a scan."""
    occupied: Mask
    """(*grid.shape)"""
    scored: Mask
    """(*grid.shape)"""
    source: Any
    """The split of the sample, or what stands for one."""


def seen_in(dataset: Dataset) -> list[Seen]:
    """The maps of a dataset, over known voxels."""
    samples = dataset.split("val") if len(dataset.split("val")) else maps_in(dataset)
    tables = [samples.home(n).tables.world for n in range(len(samples))]
    return [
        Seen(one, one.occupancy, scored_voxels(one, dataset.grid, table), samples)
        for one, table in zip(samples, tables, strict=True)
    ]


def seen_by_others(log: Path) -> list[Seen]:
    """Some scans of a log, each with what the others know where it saw nothing. Each lies at the
    origin, so that the voxels of the others' map are those of its own: in other voxels, surfaces
    would be thicker, and it would be scored beside what it saw."""
    every, files = list(read_log(log).scans()), sorted(log.glob("velodyne/*"))
    poses = np.loadtxt(log / "poses.tum")
    around = SimpleNamespace(dataset=SimpleNamespace(grid=GRID))
    found = []
    for n in np.unique(np.linspace(0, len(every) - 1, SCANS).round().astype(int)):
        points = rotate(every[n].pose.quaternion, every[n].points)
        scan = LevelScan(points=points, position=np.zeros(3), grid=GRID)
        box = [*scan.origin, *(scan.origin + GRID.voxel_m * np.array(GRID.shape))]
        moved, others = poses.copy(), np.arange(len(every)) != n
        moved[:, 1:4] -= every[n].pose.position
        with tempfile.NamedTemporaryFile("w", suffix=".tum") as file:
            np.savetxt(file, moved[others])
            file.flush()
            clouds = [files[m] for m in np.flatnonzero(others)]
            place = map_clouds(clouds, poses=Path(file.name), box=box).voxels
        occupied, known = resample(place, GRID, scan.origin)
        found.append(Seen(scan, occupied, known & ~scan.observed & ~scan.free, around))
    return found


class Counts(NamedTuple):
    """What a method says of some maps."""

    iou: Floats
    """(maps, thresholds), over the voxels that count."""
    sure: Floats
    """Of each map, what `count` counts over these voxels."""
    denied: Floats
    """Of each map, the share of its returns that is denied; see `denial`."""

    @property
    def ece(self) -> str:
        """The expected calibration error as predicted, and calibrated where the method can."""
        found = reliability(self.sure, np.arange(len(self.sure)))["map"]
        cells = [brief(one | {"mean": one["ece"], "n": 1}) for one in found.values()]
        return " → ".join(cells[::2])


Table = Mapping[str, Mapping[str, Counts]]
"""What was counted, by map of a place, kind or log, and by method."""


def counted(seen: list[Seen], methods: list[Method]) -> dict[str, Counts]:
    """What every method says of maps."""
    found = {}
    for method in methods:
        rows = []
        for sample, there, scored, source in seen:
            guess = method.completion(sample, source)
            probability, calibrated = level_of(guess, source.dataset.grid), guess.probability
            readings = [probability] if calibrated is None else [*[probability] * 2, calibrated]
            inside = np.zeros((len(REGIONS), *scored.shape), np.bool_)
            inside[0] = scored
            weight = getattr(guess.calibration, "class_weight", 1.0)
            said, true = probability[scored] >= THRESHOLDS[:, None], there[scored]
            rows.append(
                (
                    (said & true).sum(axis=1) / np.maximum((said | true).sum(axis=1), 1),
                    count(readings, there & scored, inside),
                    denial(probability, sample.observed, weight),
                )
            )
        found[method.name] = Counts(*map(np.array, zip(*rows, strict=True)))
    return found


def level_of(guess: Prediction, grid: GridSpec) -> Any:
    """What thresholds are compared with, (*grid.shape): the probability; of distances alone one
    less their share of the truncation."""
    if guess.occupancy_probability is not None:
        return guess.occupancy_probability
    return 1 - guess.distance(None, grid) / grid.truncation_m


def best_in(home: Table) -> dict[str, int]:
    """The threshold that is best for each method in the mean of kinds, by its number."""
    by_method = zip(*(by_name.items() for by_name in home.values()), strict=True)
    return {
        kinds[0][0]: int(np.mean([one.iou.mean(axis=0) for _, one in kinds], axis=0).argmax())
        for kinds in by_method
    }


def over_places(values: Mapping[str, Floats], names: Sequence[str], title: str) -> list[Any]:
    """Rows of a table: the mean over places of values (methods,) of every map, each place counted
    once; and by how much it differs from that of the method `BASE`. None where no place is real."""
    by_place: dict[str, list[Floats]] = {}
    for name, of_map in values.items():
        if (place := PLACES.get(name, {}).get("place")) is not None:
            by_place.setdefault(place, []).append(of_map)
    if not by_place:
        return []
    means = np.array([np.mean(maps, axis=0) for maps in by_place.values()]).T
    base, n = means[[*names].index(BASE)], range(len(by_place))
    rows = {title: (means, ".3f"), f"{title}, less {BASE}": (means - base, "+.3f")}
    return [
        (row, [str(len(n)), *(told(one, n, form) for one in what)])
        for row, (what, form) in rows.items()
    ]


def ious(counts: Table, best: Mapping[str, int], title: str = "## IoU") -> list[str]:
    """A row for each map, each method at its threshold; and the means over places."""
    heads = ("maps", *(f"{name} at {THRESHOLDS[n]:g}" for name, n in best.items()))
    rows, values = [], {}
    for place, found in counts.items():
        reached = [found[name].iou[:, n] for name, n in best.items()]
        maps = range(len(reached[0]))
        rows.append((place, [str(len(maps)), *(told(one, maps, ".3f") for one in reached)]))
        values[place] = np.array([one.mean() for one in reached])
    return titled(title, heads, [*rows, *over_places(values, [*best], "places")])


def calibrations(counts: Table) -> list[str]:
    """The calibration error of every method on every map."""
    names = next(iter(counts.values()))
    errors = ((place, [one.ece for one in found.values()]) for place, found in counts.items())
    return titled("## Calibration", names, errors)


def told_apart(counts: Table, home: Table) -> list[str]:
    """How often a map of a place is denied more than one of the drawn kinds `home`: the area under
    the ROC curve."""

    def share(place: str, name: str) -> str:
        here = counts[place][name].denied
        there = np.concatenate([one[name].denied for one in home.values()])
        won = mannwhitneyu(here, there).statistic  # of all pairs, half of those that are equal
        return f"{won / (len(here) * len(there)):.2f}"

    names = next(iter(home.values()))
    rows = ((place, [share(place, name) for name in names]) for place in counts)
    return titled("## Told from the drawn kinds", names, rows)


def paths_met(planner: str, results: Results) -> list[str]:
    """Tables of what becomes of trials with a planner that is not told what is unknown: the means
    over places, then of each map the figures that lead, with intervals over its flights."""
    if not results:
        return []
    first = next(iter(results.values()))
    names, means, tables = [*first.methods], [], []
    for number, (title, of) in enumerate(MET.items()):
        rows, values = [], {}
        for place, result in results.items():
            of_methods = [of(one.without_marks) for one in result.methods.values()]
            maps = maps_of(result, place)
            cells = (told(one, maps, ".2f", "outcome") for one in of_methods)
            rows.append((place, [str(len(maps)), *cells]))
            values[place] = np.array([np.nanmean(one) for one in of_methods])
        means += over_places(values, names, title)
        if number < 2:
            tables += titled(f"## By place: {title}, {planner}", ("trials", *names), rows)
    return titled(f"## Paths, {planner}", ("places", *names), means) + tables


def scans(maps: Path | None, methods: list[Method], best: Mapping[str, int]) -> list[str]:
    """The table of real scans."""
    logs = [] if maps is None else [maps / "logs" / name for name in PLACES]
    found = {log.name: counted(seen_by_others(log), methods) for log in logs if log.is_dir()}
    return ious(found, best, "## IoU of real scans, where other scans know and they do not")


if __name__ == "__main__":
    main()
