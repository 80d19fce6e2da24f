"""How completions of real places compare with those of drawn worlds.

    python benchmarks/real.py MAPS                          # docs/results/real.md
    python benchmarks/real.py MAPS --network runs/mine
    python benchmarks/real.py MAPS --recordings LOGS        # logs in LOGS, of `recordings.py`
    python benchmarks/real.py MAPS --paths --method empty extrude --network columns anywhere

MAPS is a folder with the maps of `places.toml`, which says where each comes from; one that is
missing is left out, one with other bytes is refused. The paper's sensor looks from free space along
flights of its own, one viewpoint each, and scores are over known voxels alone. Drawn kinds stand
beside them, and logs that are flown in some of the worlds, as `scenegen ingest` reads them. With
--paths, only the tables are made anew of what paths meet in the real places.
"""

import operator
import sys
import tempfile
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import measuring
import numpy as np
import scoring
from scipy.stats import mannwhitneyu
from scoring import (
    CAREFUL,
    Results,
    ahead,
    drawn,
    maps_in,
    maps_of,
    measured,
    publish,
    titled,
    told,
)
from tyro.conf import Positional

from lidarsim.grid import Floats, GridSpec, Mask
from scenegen import Dataset, Prediction, preset
from scenegen.base.reading import sha256_of
from scenegen.draw.scored import scored_voxels
from scenegen.fly.suite import MAPS
from scenegen.model.bench.methods import Method, Truth, rows_of
from scenegen.model.bench.reliability import REGIONS, count, reliability
from scenegen.model.bench.run import MethodResult
from scenegen.model.bench.statistics import brief
from scenegen.model.calibration import denial
from scenegen.model.config import PlanConfig
from scenegen.model.inputs import PointScan

UNLEARNED = ("extrude", "returns", "conservative", "empty")
BASE = "extrude"
"""The method that others are compared with."""
NETWORKS = ("columns", "proposed", "occ", "tudf", "anywhere")
KINDS = ("pillar", "geometric")
POSES = 48
"""Of each place. The map of building 079 has room for these; one of 100 flights finds none."""
PLANNERS = {
    "the paper's planner with edges checked": PlanConfig(edge_check=True),
    "the careful planner": CAREFUL,
}
PATH_METRICS = {
    "hits": "hits",
    "crossed_hits": "hits in crossed voxels only",
    "success_blocked": "success, blocked line",
    "success": "success",
}
LOGS = ("pillar", "geb079", "fr_campus")
"""Worlds that logs are flown in."""
FLOWN = "scan --flight --sequence --lidar ouster-os1-64 --noise range:0.02 --quiet --length"
SCANS = 50
"""Scans of a log that are completed, or up to twice as many."""
GRID = GridSpec()
"""Of the maps around a log's scans."""
THRESHOLDS = np.arange(1, 20) / 20
PLACES = tomllib.loads((Path(__file__).parent / "places.toml").read_text())
"""Maps of places; those that robots fly through have a part in means, too."""


class Options(scoring.Options):
    """Those of `scoring`, and what else is completed."""

    real: Positional[Path | None] = None
    """folder of the maps"""
    method: Sequence[str] = UNLEARNED
    """without learning"""
    network: Sequence[str] = NETWORKS
    maps: int = POSES
    trials: int = 400
    length: int = 60
    """of each log, metres"""
    recordings: Path | None = None
    """folder of logs as KITTI has them"""
    paths: bool = False
    """measure only what paths meet in the real places; the other tables stay"""


def main() -> None:
    """Score every place, and write the tables."""
    given = measuring.parse(Options, maps=2, trials=2, length=1, network=["columns"])
    if BASE not in given.method:
        sys.exit(f"--method: has to name {BASE}, which the others are compared with")
    methods = rows_of(given.method, given.network)
    with tempfile.TemporaryDirectory() as folder:
        if given.paths:
            places = real_places(given.real, Path(folder), given.maps)
        else:
            places = maps_to_complete(given, Path(folder))
        results = {
            planner: measured(places, [*methods, Truth()], given.trials, plan)
            for planner, plan in PLANNERS.items()
        }
        paths = [
            line
            for planner, by_place in results.items()
            for marked in (False, True)
            for line in paths_met(planner, by_place, marked=marked)
        ]
        if given.paths:
            publish(given, paths)
            return
        lines = scored(places, logs_to_complete(given, Path(folder)), methods)
        for planner, by_place in results.items():
            lines += planned(f"## Success, {planner}, known space marked", by_place)
        publish(given, [*lines, *paths])


def maps_to_complete(given: Any, folder: Path) -> dict[str, Dataset]:
    """Maps of drawn kinds, their names in backticks, and of real places, one a flight."""
    made = {}
    for kind in KINDS[: 1 if given.smoke else None]:
        made[f"`{kind}`"] = drawn(folder / kind, preset(kind), given.maps, viewpoints=1)
    return made | real_places(given.real, folder, given.maps)


def real_places(maps: Path | None, folder: Path, poses: int) -> dict[str, Dataset]:
    """A dataset of each of `PLACES` whose map lies in the folder `maps`, by its name."""
    found: dict[str, Dataset] = {}
    if maps is None:
        return found
    for name, about in PLACES.items():
        file = next(maps.rglob(name), None)
        if file is None:
            print(f"{name}: is not there; it comes from {about['source']}", file=sys.stderr)
        elif sha256_of(file.read_bytes()) != about["sha256"]:
            sys.exit(f"{file}: is another map than was measured; it comes from {about['source']}")
        else:
            place, recipe = folder / file.stem, preset("scene")
            found[file.stem] = drawn(place, recipe, poses, scenes=file, split="train", viewpoints=1)
    return found


class Scan(PointScan):
    """Points alone, as methods are shown them, in the level frame of their map."""

    lidar = None
    quaternion = np.array([1.0, 0, 0, 0])


Seen = tuple[Any, Mask, Mask]
"""A sample, or a scan; what is occupied around it, and what is known, (*grid.shape) each."""


def logs_to_complete(given: Options, folder: Path) -> dict[str, list[Seen]]:
    """Scans of logs that a sensor records in `LOGS`, and of those that are given."""
    logs = {}
    for name in LOGS:
        for world in [name] if name in KINDS else (given.real or folder).rglob(f"{name}.bt"):
            log = folder / f"{name}-log"
            measuring.command(FLOWN, given.length, world, "-o", log)
            logs[f"log in {name}"] = observed(log, folder)
    for poses in sorted(given.recordings.glob("*/poses.txt") if given.recordings else ()):
        logs[f"recording `{poses.parent.name}`"] = observed(poses.parent, folder)
    return logs


def observed(log: Path, folder: Path) -> list[Seen]:
    """Some fifty scans of a log, or all of a short one, with what the whole log knows."""
    every = max(len(list(log.glob("velodyne/*"))) // SCANS, 1)
    maps = folder / f"{log.name}.maps"
    measuring.command(f"ingest --every {every} --quiet -o", maps, log)
    found = []
    for path in sorted(maps.glob("observations/*.npz")):
        with np.load(path) as it:
            here, points = it["position"], it["position"] + it["points"]
            scan = Scan(points=points, position=here, grid=GRID)
            found.append((scan, it["occupancy"], it["known"]))
    return found


def scored(
    places: dict[str, Dataset], logs: dict[str, list[Seen]], methods: list[Method]
) -> list[str]:
    """The lines of the tables of maps."""
    counts: Table = {}
    for name, dataset in places.items():
        samples = maps_in(dataset)
        seen = [
            (one, one.occupancy, scored_voxels(one, dataset.grid, samples.home(n).tables.world))
            for n, one in enumerate(samples)
        ]
        counts[name] = counted(seen, samples, methods)
    around = SimpleNamespace(dataset=SimpleNamespace(grid=GRID))
    counts |= {name: counted(scans, around, methods) for name, scans in logs.items()}
    names = [one.name for one in methods]
    home = [name for name in places if name.startswith("`")]
    away = [name for name in places if is_mean(name)] or home
    errors = ((name, [one.ece for one in found.values()]) for name, found in counts.items())
    lines = ious(counts, away) + titled("## Calibration", names, errors)
    return lines + told_apart(counts, names, away, home)


class Counts(NamedTuple):
    """What a method says of some maps."""

    iou: Floats
    """(maps, thresholds), over known voxels."""
    sure: Floats
    """Of each map, what `count` counts over known voxels."""
    denied: Floats
    """Of each map, the share of its returns that is denied; see `denial`."""

    @property
    def ece(self) -> str:
        """The expected calibration error as predicted, and calibrated where the method can."""
        found = reliability(self.sure, np.arange(len(self.sure)))["map"]
        cells = [brief(one | {"mean": one["ece"], "n": 1}) for one in found.values()]
        return " → ".join(cells[::2])


Table = dict[str, dict[str, Any]]
"""What was counted, by place or log, and by method."""


def counted(seen: list[Seen], samples: Any, methods: list[Method]) -> dict[str, Counts]:
    """What every method says of maps."""
    found = {}
    for method in methods:
        rows = []
        for sample, there, known in seen:
            guess = method.completion(sample, samples)
            probability, calibrated = level_of(guess, samples.dataset.grid), guess.probability
            readings = [probability] if calibrated is None else [*[probability] * 2, calibrated]
            inside = np.zeros((len(REGIONS), *known.shape), np.bool_)
            inside[0] = known
            weight = getattr(guess.calibration, "class_weight", 1.0)
            said, true = probability[known] >= THRESHOLDS[:, None], there[known]
            rows.append(
                (
                    (said & true).sum(axis=1) / np.maximum((said | true).sum(axis=1), 1),
                    count(readings, there & known, inside),
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


def best_in(counts: Table, places: list[str]) -> dict[str, int]:
    """The threshold that is best for each method in the mean of places, by its number."""
    means = {
        name: np.mean([counts[place][name].iou.mean(axis=0) for place in places], axis=0)
        for name in counts[places[0]]
    }
    return {name: int(mean.argmax()) for name, mean in means.items()}


def ious(counts: Table, away: list[str]) -> list[str]:
    """A row for each place and log, each method at the threshold that is best for it in the mean of
    the places `away`; and this mean."""
    best = best_in(counts, away)
    heads = ("maps", *(f"{name} at {THRESHOLDS[n]:g}" for name, n in best.items()))
    rows, means = [], []
    for place, found in counts.items():
        reached = [found[name].iou[:, n] for name, n in best.items()]
        maps = len(reached[0])
        rows.append((place, [str(maps), *(told(one, range(maps), ".2f") for one in reached)]))
        means += [[one.mean() for one in reached]] if place in away else []
    mean = [f"{iou:.3f}" for iou in np.mean(means, axis=0)]
    return titled("## IoU", heads, [*rows, ("mean of the places", ["", *mean])])


def told_apart(counts: Table, names: list[str], away: list[str], home: list[str]) -> list[str]:
    """How often a map of a place is denied more than one of the drawn kinds `home`: the area under
    the ROC curve."""

    def share(place: str, name: str) -> str:
        here = counts[place][name].denied
        there = np.concatenate([counts[one][name].denied for one in home])
        won = mannwhitneyu(here, there).statistic  # of all pairs, half of those that are equal
        return f"{won / (len(here) * len(there)):.2f}"

    rows = ((place, [share(place, name) for name in names]) for place in away)
    return titled("## Told from the drawn kinds", names, rows)


def is_mean(name: str) -> bool:
    """Whether a place has a part in means: it is neither drawn nor a further small forest."""
    return f"{name}.bt" in MAPS


def planned(title: str, results: Results) -> list[str]:
    """A table of success: a row a place, then by how much all real places together succeed oftener
    than with the method `BASE`, trial by trial. Each map is of a flight of its own, and each place
    has one world: intervals are over maps."""
    names = list(next(iter(results.values())).methods)
    rows, pairs = [], []
    for place, result in results.items():
        maps = maps_of(result, place)
        success = (one.values("success") for one in result.methods.values())
        cells = (told(one, maps, ".2f", "outcome") for one in success)
        rows.append((place, [str(len(maps)), *cells]))
        if is_mean(place):
            pairs.append((result, maps))
    if pairs:
        trials = sum(len(maps) for _, maps in pairs)
        rows.append((f"real places, less {BASE}", [str(trials), *ahead(pairs, BASE).values()]))
    return titled(title, ("trials", *names), rows)


def leaves_known(method: MethodResult) -> Any:
    """Whether each trial's path (trials,) meets no obstacle and yet fails: it leads through voxels
    that the map of the place does not know."""
    ends = method.values("success") + method.values("hits") + np.isnan(method.values("length"))
    return ends == 0


def paths_met(planner: str, results: Results, *, marked: bool) -> list[str]:
    """A table of what paths meet in real places.

    Args:
        planner: Its name.
        results: Of the bench with this planner.
        marked: Whether the planner gets unknown voxels of the place as occupied.

    Returns:
        Lines. The first rows are means over the places of `is_mean`, each place counted once, with
        Student's t over places; then hits in each place, with intervals over its maps. None where
        no place is real.
    """
    methods: dict[str, dict[str, MethodResult]] = {
        place: {
            name: method if marked else method.without_marks
            for name, method in result.methods.items()
        }
        for place, result in results.items()
        if result.marks_unknown
    }
    places = [place for place in methods if is_mean(place)]
    if not places:
        return []
    names = list(methods[places[0]])

    def shares(values: Callable[[MethodResult], Any]) -> Any:
        """(methods, places): the mean over the trials of each place."""
        means = [[np.nanmean(values(methods[place][name])) for place in places] for name in names]
        return np.array(means)

    def over_places(title: str, values: Any, form: str = ".2f") -> tuple[str, list[str]]:
        """A row of means of values (methods, places)."""
        return title, ["", *(told(one, range(len(places)), form) for one in values)]

    rows = []
    for metric, title in PATH_METRICS.items():
        means = shares(operator.methodcaller("values", metric))
        rows += [
            over_places(title, means),
            over_places(f"{title}, less {BASE}", means - means[names.index(BASE)], "+.2f"),
        ]
    rows += [
        over_places("leaves known space, no hit", shares(leaves_known)),
        over_places("no path", shares(lambda method: np.isnan(method.values("length")))),
    ]
    for place, by_name in methods.items():
        maps = maps_of(results[place])
        values = (method.values("hits") for method in by_name.values())
        cells = (told(one, maps, ".2f", "outcome") for one in values)
        rows.append((f"hits in {place}", [str(len(maps)), *cells]))
    marks = "marked" if marked else "not marked"
    return titled(f"## Paths, {planner}, known space {marks}", ("trials", *names), rows)


if __name__ == "__main__":
    main()
