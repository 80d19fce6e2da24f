"""How completions of real places compare with those of drawn worlds.

    python benchmarks/real.py MAPS                          # docs/results/real.md
    python benchmarks/real.py MAPS --network runs/mine --data /tmp/real
    python benchmarks/real.py MAPS --recordings LOGS        # logs in LOGS, of `recordings.py`

MAPS is a folder with the maps of `PLACES`, which says where each comes from; one that is missing is
left out, one with other bytes is refused. The paper's sensor looks from free space along flights of
its own, one viewpoint each, and scores are over known voxels alone. Drawn kinds stand beside them,
and logs that are flown in some of the worlds, as `scenegen ingest` reads them. What IoU is lost by
is told apart by `GROUPS`, and a map of each place is drawn.
"""

import hashlib
import io
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import measuring
import numpy as np
from counting import GROUPS, MISSED, THRESHOLDS, Counts, counted, groups_of
from PIL import Image
from recordings import GRID, Observed, observed
from scipy.stats import mannwhitneyu
from scoring import RESULTS, Ahead, drawn, maps_of, split_of, titled, write_tables

from scenegen.dataset.read import Dataset
from scenegen.display.figures import draw_completions
from scenegen.display.look import Guess, look_into
from scenegen.display.panels import to_bytes
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.unlearned import Conservative, Extrude, Returns
from scenegen.model.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.run import bench
from scenegen.model.evaluation.statistics import brief, figure, head, line
from scenegen.model.evaluation.visibility import UNSCORED, scored_voxels
from scenegen.recipe import preset
from scenegen.sample import Sample

PAGE = RESULTS / "real.md"
NETWORKS = ("columns", "proposed", "occ", "tudf", "anywhere")
KINDS = ("pillar", "geometric")
POSES = 48
"""Of each place. The map of building 079 has room for these; one of 100 flights finds none."""
PLANNERS = {
    "the paper's planner with edges checked": PlanConfig(edge_check=True),
    "the careful planner": PlanConfig(planner="careful"),
}
LOGS = ("pillar", "geb079", "fr_campus")
"""Worlds that logs are flown in."""
FLOWN = "scan --flight --sequence --lidar ouster-os1-64 --noise range:0.02 --quiet --length"
PICTURES = PAGE.parents[1] / "pictures" / "real"
COLOURS = 96
"""Of a picture: it is half as large as with all."""


class Place(NamedTuple):
    """A map of a place, by the name of its file."""

    sha256: str
    source: str


FOREST = "`ethz-asl/forest_gen`, BSD"
MORE = {
    "forest3.bt": "32641485aa6dab54f27f31accd97bdfebcd6b2f35aa9365b4e52ccd26427c1aa",
    "forest4.bt": "ab081d93ea64c0554b015ca06176d161c9fe502ba85cb6190b5ef2c2566d2313",
    "forest5.bt": "25abffd946601a5ae2d28dd3308877da8440a54db0a2c028bf1b0607aa65174b",
    "forest7.bt": "8a9b87159e7c2a0c7a2b0093c6064202528da8923e43ccdcdac49bb1e02e1816",
    "forest8.bt": "0a764418c61d2846d764a7f33fb3799a69878f02dd82aec93170e129b2f42f57",
    "forest9.bt": "b69a9e4cf0737d3c0690c3953fb7a204b93e37d9b941766e51de03476c7def62",
}
"""The other small forests, but the seventh, of which nothing is free. They have no part in means,
nor in the choice of thresholds."""
PLACES = {
    "geb079.bt": Place(
        "7663c2466e2fe335a27d1d592f91766c8154511e63a9615aeecdad1defb04d3b",
        "`octomap/share/data` of OctoMap, or Debian's `liboctomap-dev`, New BSD",
    ),
    "fr_campus.bt": Place(
        "7a23e0ac87d65690dae95611c9bedd8156611e266f36a69972a619c37b80c589",
        "the OctoMap data sets of the University of Freiburg, CC BY 3.0",
    ),
    "forest_big.bt": Place(
        "ea7fdbcfe807f24c64b282b3e2b53b01fb4055c72083865ef255d75899d3d3e2", FOREST
    ),
    "forest0.bt": Place("2c7a4fc959754ec9a5f4ce210a52d888eb735f97cec67083fbbcdb3715711a9f", FOREST),
    "forest1.bt": Place("c7ab7c8fc835e5a4bb3efda3afc09ba464b1b219cb31ecad65523d40068a8ad0", FOREST),
    "forest2.bt": Place("5b1bbeb594fff90b32206c341227f6c527c7c6c00856632774539982ba39de6f", FOREST),
    **{name: Place(sha256, FOREST) for name, sha256 in MORE.items()},
}


def main() -> None:
    """Score every place, and write the tables."""
    parser = measuring.options(__doc__)
    parser.add_argument("maps", type=Path, nargs="?", help="folder of the maps")
    parser.add_argument("--poses", type=int, default=POSES, help="of each place, at most")
    parser.add_argument("--trials", type=int, default=400, help="planning trials of each place")
    parser.add_argument("--length", type=int, default=60, help="of each log, metres")
    parser.add_argument("--recordings", type=Path, help="folder of logs as KITTI has them")
    parser.add_argument("--network", action="append", help="a bundled one's name, or a run")
    parser.add_argument("--data", type=Path, help="folder for the datasets")
    parser.add_argument("--page", type=Path, default=PAGE)
    given = measuring.parse(parser, poses=2, trials=2, length=1, network=["columns"])
    with tempfile.TemporaryDirectory() as spare:
        folder = given.data or Path(spare)
        places = maps_to_complete(given.maps, folder, given.poses, smoke=given.smoke)
        networks = [Completer.from_pretrained(one, threads=1) for one in given.network or NETWORKS]
        pictures = folder if given.smoke else PICTURES
        pictures.mkdir(exist_ok=True)
        logs = {
            f"log in {name}": observed(flown(world, folder / f"{name}-log", given.length), folder)
            for name in LOGS
            for world in ([name] if name in KINDS else (given.maps or folder).rglob(f"{name}.bt"))
        }
        for log in sorted(given.recordings.glob("*/poses.txt") if given.recordings else ()):
            logs[f"recording `{log.parent.name}`"] = observed(log.parent, folder)
        unlearned = [Completed(one) for one in (Extrude(), Returns(), Conservative())]
        methods: list[Method] = [*unlearned, *networks]
        tables = scored(places, logs, methods, given.trials, pictures)
    print("\n".join(tables))
    if not given.smoke:
        write_tables(given.page, tables)


def maps_to_complete(
    maps: Path | None, folder: Path, poses: int, *, smoke: bool
) -> dict[str, Dataset]:
    """Maps of drawn kinds, their names in backticks, and of real places, one a flight."""
    kinds = KINDS[: 1 if smoke else None]
    made = {f"`{kind}`": drawn(folder / kind, preset(kind), poses, viewpoints=1) for kind in kinds}
    return made | real_places(maps, folder, poses)


def real_places(maps: Path | None, folder: Path, poses: int) -> dict[str, Dataset]:
    """A dataset of each of `PLACES` whose map lies in the folder `maps`, by its name."""
    found: dict[str, Dataset] = {}
    if maps is None:
        return found
    for name, place in PLACES.items():
        file = next(maps.rglob(name), None)
        if file is None:
            print(f"{name}: is not there; it comes from {place.source}", file=sys.stderr)
        elif hashlib.sha256(file.read_bytes()).hexdigest() != place.sha256:
            sys.exit(f"{file}: is another map than was measured; it comes from {place.source}")
        else:
            about: Any = {"scenes": file, "split": "train", "viewpoints": 1}
            found[file.stem] = drawn(folder / file.stem, preset("scene"), poses, **about)
    return found


def flown(world: object, folder: Path, length: int) -> Path:
    """A log that a sensor records in a world."""
    measuring.run("-m", "scenegen", *FLOWN.split(), length, world, "-o", folder)
    return folder


Table = dict[str, dict[str, Counts]]
"""What was counted, by place or log, and by method."""


def scored(
    places: dict[str, Dataset],
    logs: dict[str, list[Observed]],
    methods: list[Method],
    trials: int,
    pictures: Path,
) -> list[str]:
    """The lines of the tables; pictures of the last method are written."""
    counts = all_counted(places, logs, methods)
    away = [name for name in places if is_mean(name)] or list(places)
    best = {
        one.name: int(
            np.mean([counts[name][one.name].iou.mean(axis=0) for name in away], 0).argmax()
        )
        for one in methods
    }
    lines = [*ious(counts, best, away), *titled("Calibration", methods)]
    for name, found in counts.items():
        lines.append(line(name, [values.ece for values in found.values()]))
    home = [name for name in places if name.startswith("`")]
    lines += told_apart(counts, methods, away, home)
    lines += losses(counts, best, away)
    for title, plan in PLANNERS.items():
        lines += ["", f"## Success of planning, {title}", ""]
        lines += planned(places, [*methods, Truth()], trials, plan)
    last = methods[-1].name
    lines += ["", "## Pictures", "", f"The map of each place in which `{last}` has the median IoU."]
    for name in away:
        order = np.argsort(counts[name][last].iou[:, best[last]])
        median = int(order[len(order) // 2])
        path = pictures / f"{name.strip('`')}.png"
        path.write_bytes(drawn_map(places[name], median, methods[-1], best[last]))
        lines += ["", f"![{name}](../pictures/real/{path.name})"]
    return lines


def all_counted(
    places: dict[str, Dataset], logs: dict[str, list[Observed]], methods: list[Method]
) -> Table:
    """The voxels of all places and logs. Of a log it is known what is there and what is not, and
    not how a scan saw it."""
    counts: Table = {}
    for name, dataset in places.items():
        samples = dataset.split(split_of(dataset))
        seen = [(sample, groups_of(samples, n)) for n, sample in enumerate(samples)]
        counts[name] = counted(seen, samples, methods)
    for name, scans in logs.items():
        shown = [
            (scan, np.where(known, np.where(there, 0, MISSED), UNSCORED).astype(np.uint8))
            for scan, there, known in scans
        ]
        counts[name] = counted(shown, SimpleNamespace(dataset=SimpleNamespace(grid=GRID)), methods)
    return counts


def thresholds(best: dict[str, int]) -> list[str]:
    """Every method with the threshold that is best for it."""
    return [f"{name} at {THRESHOLDS[number]:g}" for name, number in best.items()]


def ious(counts: Table, best: dict[str, int], away: list[str]) -> list[str]:
    """A row for each place and log; last the mean of the places `away`."""
    lines = ["", "## IoU", "", *head(("maps", *thresholds(best)))]
    for name, found in counts.items():
        cells = [str(len(next(iter(found.values())).iou))]
        for method, values in found.items():
            cells.append(brief(figure(values.iou[:, best[method]], range(len(values.iou))), ".2f"))
        lines.append(line(name, cells))
    means = [
        np.mean([counts[name][method].iou[:, number].mean() for name in away])
        for method, number in best.items()
    ]
    return [*lines, line("mean of the places", ["", *(f"{mean:.3f}" for mean in means)])]


def told_apart(counts: Table, methods: list[Method], away: list[str], home: list[str]) -> list[str]:
    """How often a map of a place is denied more than one of the drawn kinds `home`: the area under
    the ROC curve."""
    lines = titled("Told from the drawn kinds", methods)
    for name in away:
        cells = []
        for one in methods:
            here, there = (
                np.concatenate([counts[place][one.name].denied for place in chosen])
                for chosen in ([name], home)
            )
            won = mannwhitneyu(here, there).statistic  # of all pairs, half of those that are equal
            cells.append(f"{won / (len(here) * len(there)):.2f}")
        lines.append(line(name, cells))
    return lines


def losses(counts: Table, best: dict[str, int], away: list[str]) -> list[str]:
    """What costs IoU, by group: for every method, then of the last one in every place."""
    *_, last = best
    lines = ["", "## What costs IoU", "", *head(("of what is occupied", *thresholds(best)))]
    for n, group in enumerate(GROUPS):
        cells = [f"{100 * np.mean([counts[name][last].size(n) for name in away]):.0f} %"]
        for method, number in best.items():
            shares = [counts[name][method].share(n, number) for name in away]
            lost, recall = np.mean(np.array(shares), axis=0)
            cells.append(f"{lost:.1f}" + (f" · {100 * recall:.0f} %" if n < MISSED else ""))
        lines.append(line(group, cells if n < MISSED else ["", *cells[1:]]))
    lines += ["", f"By place, `{last}`:", "", *head(away)]
    for n, group in enumerate(GROUPS):
        lost = [counts[name][last].share(n, best[last])[0] for name in away]
        lines.append(line(group, [f"{one:.1f}" for one in lost]))
    return lines


def is_mean(name: str) -> bool:
    """Whether a place has a part in means: it is neither drawn nor one of `MORE`."""
    return not name.startswith("`") and f"{name}.bt" not in MORE


def planned(
    places: dict[str, Dataset], methods: list[Method], trials: int, plan: PlanConfig
) -> list[str]:
    """A table of success: a row a place, then by how much all real places together succeed oftener
    than with the first method, trial by trial."""
    lines = head(("trials", *(one.name for one in methods)))
    ahead = Ahead(methods[0].name)
    for name, dataset in places.items():
        config = BenchConfig(split=split_of(dataset), trials=trials, plan=plan)
        result = bench(dataset, methods, config)
        # one flight a map, and one world a place: maps are what is drawn anew
        maps = maps_of(result, name)
        success = (one.values("success") for one in result.methods.values())
        cells = [brief(figure(one, maps, "outcome"), ".2f") for one in success]
        lines.append(line(name, [str(len(maps)), *cells]))
        if is_mean(name):
            ahead.add(result, maps)
    if ahead.groups:
        cells = [brief(one, "+.3f") for one in ahead.figures().values()]
        lines.append(line(f"real places, less {methods[0].name}", [str(len(ahead.groups)), *cells]))
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
