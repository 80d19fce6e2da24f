"""How completions of real places compare with those of drawn worlds.

    python benchmarks/real.py MAPS                          # docs/results/real.md
    python benchmarks/real.py MAPS --network runs/mine --data /tmp/real

MAPS is a folder with the maps of `PLACES`, which says where each comes from; one that is missing is
left out, one with other bytes is refused. The paper's sensor looks from free space along flights of
its own, one viewpoint each, and scores are over known voxels alone. Drawn kinds stand beside them.
"""

import dataclasses
import hashlib
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import measuring
import numpy as np
from numpy.typing import NDArray

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.unlearned import Extrude
from scenegen.model.evaluation.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.run import bench
from scenegen.model.evaluation.statistics import figure, head, interval, line
from scenegen.model.evaluation.visibility import scored_voxels
from scenegen.recipe import preset
from scenegen.source import DrawnWorlds, Source, read_scenes

PAGE = Path(__file__).parents[1] / "docs" / "results" / "real.md"
NETWORKS = ("columns", "proposed", "occ", "anywhere")
KINDS = ("pillar", "geometric")
THRESHOLDS = np.arange(1, 20) / 20


class Place(NamedTuple):
    """A map of a place, by the name of its file."""

    sha256: str
    source: str


FOREST = "`ethz-asl/forest_gen`, BSD"
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
}


def main() -> None:
    """Score every place, and write the tables."""
    parser = measuring.options(__doc__)
    parser.add_argument("maps", type=Path, nargs="?", help="folder of the maps")
    parser.add_argument("--poses", type=int, default=48, help="of each place, at most")
    parser.add_argument("--trials", type=int, default=400, help="planning trials of each place")
    parser.add_argument("--network", action="append", help="a bundled one's name, or a run")
    parser.add_argument("--data", type=Path, help="folder for the datasets")
    parser.add_argument("--page", type=Path, default=PAGE)
    given = measuring.parse(parser, poses=2, trials=4, network=["columns"])
    with tempfile.TemporaryDirectory() as spare:
        folder = given.data or Path(spare)
        places = {f"`{kind}`": drawn(kind, folder / kind, given.poses) for kind in KINDS}
        places |= real_places(given.maps, folder, given.poses)
        networks = [Completer.from_pretrained(one, threads=1) for one in given.network or NETWORKS]
        tables = scored(places, [Completed(Extrude()), *networks], given.trials)
    print("\n".join(tables))
    if not given.smoke:
        said = given.page.read_text().partition("<!-- tables -->")[0]
        given.page.write_text(f"{said}<!-- tables -->\n" + "\n".join(tables) + "\n")


def drawn(kind: str, folder: Path, poses: int) -> Dataset:
    """Test maps of a kind of worlds, one a flight."""
    return made(folder, preset(kind), DrawnWorlds(preset(kind)), "test", poses)


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
            found[file.stem] = real(file, folder / file.stem, poses)
    return found


def real(file: Path, folder: Path, poses: int) -> Dataset:
    """Maps of a place, one a flight."""
    counts = {"train": poses, "val": 0, "test": 0}
    return made(folder, preset("scene"), read_scenes(file, counts, seed=0), "train", poses)


def made(folder: Path, recipe: Any, source: Source, split: str, poses: int) -> Dataset:
    """A dataset in `folder` with so many samples in a split, each of a flight of its own."""
    recipe = dataclasses.replace(recipe, flight=dataclasses.replace(recipe.flight, viewpoints=1))
    recipe = source.suited(recipe) if hasattr(source, "suited") else recipe
    counts = {"train": 0, "val": 0, "test": 0} | {split: poses}
    build(plan_dataset(folder, recipe, source, seed=0, counts=counts))
    return Dataset(folder)


def scored(places: dict[str, Dataset], methods: list[Method], trials: int) -> list[str]:
    """The lines of the tables."""
    splits = {name: "test" if len(one.split("test")) else "train" for name, one in places.items()}
    curves = {
        name: {one.name: curve(one, dataset, splits[name]) for one in methods}
        for name, dataset in places.items()
    }
    away = [name for name in places if not name.startswith("`")] or list(places)
    best = {
        one.name: int(np.mean([curves[name][one.name].mean(axis=0) for name in away], 0).argmax())
        for one in methods
    }
    titles = [f"{one.name} at {THRESHOLDS[best[one.name]]:g}" for one in methods]
    lines = ["", "## IoU", "", *head(("maps", *titles))]
    for name, found in curves.items():
        cells = [str(len(next(iter(found.values()))))]
        for method, values in found.items():
            own = figure(values[:, best[method]], range(len(values)))
            cells.append(f"{own['mean']:.2f} {interval(own, '.2f')}")
        lines.append(line(name, cells))
    means = [
        np.mean([curves[name][one.name][:, best[one.name]].mean() for name in away])
        for one in methods
    ]
    lines.append(line("mean of the places", ["", *(f"{mean:.3f}" for mean in means)]))
    lines += ["", "## Success of planning, edges checked", "", *head(("trials", *titles, "truth"))]
    for name, dataset in places.items():
        split: Any = splits[name]
        config = BenchConfig(split=split, trials=trials, plan=PlanConfig(edge_check=True))
        result = bench(dataset, [*methods, Truth()], config)
        cells = [str(len(result.trial_worlds))]
        for measured in result.methods.values():
            success = [one.success for one in measured.trials]
            # one flight a map, and one world a place: maps are what is drawn anew
            own = figure(success, [map_ for map_, _ in result.trial_places], "outcome")
            cells.append(f"{own['mean']:.2f} {interval(own, '.2f')}")
        lines.append(line(name, cells))
    return lines


def curve(method: Method, dataset: Dataset, split: str) -> NDArray[np.float64]:
    """IoU over the voxels that are scored, (maps, thresholds)."""
    found, samples = [], dataset.split(split)
    for n, sample in enumerate(samples):
        scored_here = scored_voxels(sample, dataset.grid, samples.home(n).tables)
        truth = sample.occupancy[scored_here]
        said = method.completion(sample, samples).occupancy_probability
        if said is None:  # distances alone
            found.append(np.full(len(THRESHOLDS), np.nan))
            continue
        occupied = said[scored_here] >= THRESHOLDS[:, None]
        both, either = (occupied & truth).sum(axis=1), (occupied | truth).sum(axis=1)
        found.append(both / np.maximum(either, 1))
    return np.array(found)


if __name__ == "__main__":
    main()
