"""Which kinds of worlds teach what: every kind is held out in turn.

    python benchmarks/generalisation.py --data /tmp/g           # docs/results/generalisation.*
    python benchmarks/generalisation.py --data /tmp/g --held rooms --held cave
    python benchmarks/generalisation.py --data /tmp/g --real MAPS

A network is trained on maps of all kinds but one, drawn anew, and measured on test maps of every
kind. Two runs of this script may share `--data`, each with kinds of its own: runs of training go on
where they were, and what was measured stays: `--real` adds the maps of real places that
`benchmarks/real.py` takes, scored over known voxels, to the rows that are there. Without learning,
`extrude` stands beside them; so does the bundled `columns`, which has seen `pillar` and `geometric`
alone.
"""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import measuring
import numpy as np
from real import POSES, real_places

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.unlearned import Extrude
from scenegen.model.evaluation.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.metrics import METRICS
from scenegen.model.evaluation.run import bench
from scenegen.model.evaluation.statistics import figure, head, interval, line
from scenegen.recipe import preset
from scenegen.recipes import kind_names
from scenegen.run.software import commit
from scenegen.source import DrawnWorlds

RESULTS = Path(__file__).parents[1] / "docs" / "results"
BUNDLED = "columns"
NETWORK = (
    *("--variant", "columns", "--input", "observed", "--input", "free"),
    *("--lambda-occupancy", 1, "--lovasz", 1, "--eikonal", 0),
)
"""As the bundled network was trained."""
PLACES = {name: list(METRICS).index(name) for name in ("iou", "near_rmse")}
LENGTHS = ("maps", "tests", "trials")
TITLES = {
    "iou": "IoU",
    "near_rmse": "Near-RMSE, m",
    "success": "Success of planning, edges checked",
}


def main() -> None:
    """Train, measure, and write what is there."""
    parser = measuring.options(__doc__)
    parser.add_argument("--held", action="append", choices=kind_names(), help="a kind to hold out")
    parser.add_argument("--maps", type=int, default=5000, help="maps that a network learns from")
    parser.add_argument("--tests", type=int, default=100, help="test maps of every kind")
    parser.add_argument("--trials", type=int, default=400, help="planning trials of every kind")
    parser.add_argument("--data", type=Path, help="folder of datasets and runs")
    parser.add_argument("--real", type=Path, help="folder of maps of real places")
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = measuring.parse(parser, maps=2, tests=2, trials=2, held=["maze"])
    with tempfile.TemporaryDirectory() as spare:
        folder = given.data or Path(spare)
        kinds = ("maze", "pillar") if given.smoke else kind_names()
        tests = {kind: drawn(kind, folder / kind, given.tests) for kind in kinds}
        tests |= real_places(given.real, folder, min(given.tests, POSES))
        # the paper's planner steps through walls that are thinner than its lattice
        config = BenchConfig(trials=given.trials, plan=PlanConfig(edge_check=True))
        there = rows_of(given.out, given)
        for name, method in (
            ("truth", Truth()),
            ("extrude", Completed(Extrude())),
            (BUNDLED, Completer.from_pretrained(BUNDLED, threads=1)),
        ):
            if left := missing(there, name, tests):
                put(given.out, given, name, measured(method, left, config))
        for held in given.held or kinds:
            if left := missing(there, row := f"without {held}", tests):
                run = train(folder / row.replace(" ", "-"), [k for k in kinds if k != held], given)
                network = Completer.from_pretrained(run, threads=1)
                put(given.out, given, row, measured(network, left, config))


def missing(there: dict[str, Any], row: str, tests: dict[str, Dataset]) -> dict[str, Dataset]:
    """The datasets on which a row was not measured yet."""
    return {kind: dataset for kind, dataset in tests.items() if kind not in there.get(row, ())}


def drawn(kind: str, folder: Path, maps: int) -> Dataset:
    """Test maps of a kind."""
    recipe, counts = preset(kind), {"train": 0, "val": 0, "test": maps}
    build(plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=0, counts=counts))
    return Dataset(folder)


def train(out: Path, kinds: Sequence[str], given: Any) -> Path:
    """The folder of a run that learned from these kinds."""
    words = [word for kind in kinds for word in ("--stream", kind)]
    looks = max(given.maps // 5, 1)
    lengths = ("--maps", given.maps, "--interval", looks, "--val-maps", min(200, given.maps))
    measuring.run("-m", "scenegen", "train", *words, *NETWORK, *lengths, "--quiet", "--out", out)
    return out


def measured(method: Method, tests: dict[str, Dataset], config: BenchConfig) -> dict[str, Any]:
    """What a method reaches on every kind, with intervals over worlds."""
    found = {}
    for kind, dataset in tests.items():
        split: Any = "test" if len(dataset.split("test")) else "train"  # a map's own is all train
        result = bench(dataset, [method], replace(config, split=split))
        own = result.methods[method.name]
        worlds, trial_worlds = result.worlds, result.trial_worlds
        if len(set(worlds.tolist())) == 1:  # one world a place: maps are what is drawn anew
            worlds = np.arange(len(worlds))
            trial_worlds = np.array([map_ for map_, _ in result.trial_places])
        found[kind] = {
            name: figure(own.reconstruction[:, 0, place], worlds, METRICS[name].scale)
            for name, place in PLACES.items()
        }
        success = [trial.success for trial in own.trials]
        found[kind]["success"] = figure(success, trial_worlds, "outcome")
    return found


def rows_of(out: Path, given: Any) -> dict[str, Any]:
    """The rows that were measured with the same numbers of maps and trials."""
    file = out / "generalisation.json"
    report = json.loads(file.read_text()) if file.exists() else {}
    same = all(report.get(name) == getattr(given, name) for name in LENGTHS)
    return dict(report["rows"]) if same else {}


def put(out: Path, given: Any, row: str, found: dict[str, Any]) -> None:
    """Add a row to the results, and write the page anew."""
    out.mkdir(parents=True, exist_ok=True)
    file, page = out / "generalisation.json", out / "generalisation.md"
    report = {"commit": commit(), **{name: getattr(given, name) for name in LENGTHS}}
    report["rows"] = rows_of(out, given)
    more = json.loads(json.dumps(found), parse_float=lambda digits: round(float(digits), 4))
    report["rows"][row] = report["rows"].get(row, {}) | more
    file.write_text(json.dumps(report, separators=(",", ":")) + "\n")
    said = page.read_text().partition("<!-- tables -->")[0] if page.exists() else "# \n\n"
    page.write_text(f"{said}<!-- tables -->\n" + "\n".join(tables(report["rows"])) + "\n")
    print(f"{row}: " + ", ".join(f"{kind} {one['iou']['mean']:.3f}" for kind, one in found.items()))


def tables(rows: dict[str, Any]) -> list[str]:
    """For each figure, by kind: networks that saw the kind, the one that did not, and `extrude`."""
    lines = []
    for name, title in TITLES.items():
        lines += ["", f"## {title}", "", *head(("seen in training", "held out", "extrude; truth"))]
        for kind in (kind for kind in kind_names() if any(kind in row for row in rows.values())):
            saw = [
                rows[row][kind][name]["mean"]
                for row in rows
                if row.startswith("without ") and row != f"without {kind}" and kind in rows[row]
            ]
            mean = f"{sum(saw) / len(saw):.3f} (of {len(saw)})" if saw else "–"
            held, extrude, truth = (
                _cell(rows, row, kind, name) for row in (f"without {kind}", "extrude", "truth")
            )
            lines.append(line(f"`{kind}`", (mean, held, f"{extrude}; {truth.partition(' ')[0]}")))
    places = [place for place in rows.get(BUNDLED, ()) if place not in kind_names()]
    if places:
        lines += ["", "## Real places", "", *head(TITLES.values())]
        for name, row in rows.items():
            if all(place in row for place in places):
                found = ([row[place][title]["mean"] for place in places] for title in TITLES)
                lines.append(line(name, (f"{np.mean(values):.3f}" for values in found)))
    lines += ["", f"## The bundled `{BUNDLED}`", "", *head(TITLES.values())]
    for kind in rows.get(BUNDLED, ()):
        lines.append(line(f"`{kind}`", (_cell(rows, BUNDLED, kind, name) for name in TITLES)))
    return lines


def _cell(rows: dict[str, Any], row: str, kind: str, name: str) -> str:
    if row not in rows or kind not in rows[row]:
        return "–"
    one = rows[row][kind][name]
    return f"{one['mean']:.3f} {interval(one, '.3f')}"


if __name__ == "__main__":
    main()
