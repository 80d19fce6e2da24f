"""Which kinds of worlds teach what: every kind is held out in turn.

    python benchmarks/generalisation.py --data /tmp/g           # docs/results/generalisation.*
    python benchmarks/generalisation.py --data /tmp/g --held rooms cave
    python benchmarks/generalisation.py --data /tmp/g --real MAPS
    python benchmarks/generalisation.py --data /tmp/b --stream benchmarks/broad/{}.toml --out /tmp/b
    python benchmarks/generalisation.py --page              # anew from the JSON: measures nothing

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
from pathlib import Path
from typing import Any

import measuring
import numpy as np
from real import POSES, real_places
from scoring import RESULTS, by_map, drawn, measured, titled, write_tables

from scenegen import Dataset, preset
from scenegen.base.executors import commit
from scenegen.model.bench.methods import Method, rows_of
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS
from scenegen.model.bench.statistics import brief, summarise
from scenegen.model.config import PlanConfig
from scenegen.model.tables import markdown
from scenegen.worlds.kinds import training_kinds

BUNDLED = "columns"
FILE = "generalisation.json"
NETWORK = (
    "--variant columns --input observed --input free --lambda-occupancy 1 --lovasz 1 --eikonal 0"
)
"""As the bundled network was trained, but for the optimiser."""
VAL = 20
"""Maps of every kind on which thresholds are tuned."""
LENGTHS = ("maps", "tests", "trials")
TITLES = {
    "iou": "IoU",
    "best_iou": "IoU at the best threshold",
    "near_rmse": "Near-RMSE, m",
    "success": "Success of planning, edges checked",
}


class Options(measuring.Options):
    """What is held out, and how much is measured."""

    held: Sequence[str] = training_kinds()
    """kinds to hold out"""
    stream: str = "{}"
    """what a kind is learned from: itself, or a recipe at this path, with {} for the kind"""
    maps: int = 2500
    """maps that a network learns from"""
    tests: int = 100
    """test maps of every kind"""
    trials: int = 100
    """planning trials of every kind"""
    data: Path | None = None
    """folder of datasets and runs"""
    real: Path | None = None
    """folder of maps of real places"""
    out: Path = RESULTS
    page: bool = False
    """write the tables anew, no more"""


def main() -> None:
    """Train, measure, and write what is there."""
    given = measuring.parse(Options, maps=2, tests=2, trials=2, held=["maze"])
    if given.page:
        return write_csv(given.out)
    with tempfile.TemporaryDirectory() as spare:
        folder = given.data or Path(spare)
        kinds = ("maze", "pillar") if given.smoke else training_kinds()
        asked = dict.fromkeys([*kinds, *given.held])
        tests = {kind: drawn(folder / kind, preset(kind), given.tests, val=VAL) for kind in asked}
        tests |= real_places(given.real, folder, min(given.tests, POSES))
        for method in rows_of(["truth", "extrude"], [BUNDLED]):
            if left := missing(given, method.name, tests):
                put(given, method.name, figures(method, left, given.trials))
        for held in given.held:
            if left := missing(given, row := f"without {held}", tests):
                run = train(folder / row.replace(" ", "-"), [k for k in kinds if k != held], given)
                (network,) = rows_of([], [str(run)])
                put(given, row, figures(network, left, given.trials))


def missing(given: Options, row: str, tests: dict[str, Dataset]) -> dict[str, Dataset]:
    """The datasets on which a row was not measured yet."""
    there = measured_rows(given).get(row, ())
    return {kind: dataset for kind, dataset in tests.items() if kind not in there}


def train(out: Path, kinds: Sequence[str], given: Any) -> Path:
    """The folder of a run that learned from these kinds."""
    streams = " ".join(f"--stream {given.stream.format(kind)}" for kind in kinds)
    lengths = f"--maps {given.maps} --interval {given.maps} --val-maps {min(50, given.maps)}"
    measuring.command(f"train {streams} {NETWORK} {lengths} --quiet --out", out)
    return out


def figures(method: Method, tests: dict[str, Dataset], trials: int) -> dict[str, Any]:
    """What a method reaches on every kind, with intervals over worlds; over maps in a real place,
    which is one world. Edges are checked, for the paper's planner steps through walls that are
    thinner than its lattice."""
    found: dict[str, Any] = {}
    for kind, result in measured(tests, [method], trials, PlanConfig(edge_check=True)).items():
        alone, values = len(set(result.worlds.tolist())) == 1, result.methods[method.name].values
        found[kind] = {}
        for name in TITLES:
            metric, region = ("iou", -1) if name == "best_iou" else (name, 0)
            groups = by_map(result, metric) if alone else result.worlds_of(metric)
            scale = (METRICS | PLAN_METRICS)[metric].scale
            found[kind][name] = summarise(values(metric, region), groups, scale)
    return found


def measured_rows(given: Options) -> dict[str, Any]:
    """The rows that were measured with the same numbers of maps and trials."""
    file = given.out / FILE
    report = json.loads(file.read_text()) if file.exists() else {}
    same = all(report.get(name) == getattr(given, name) for name in LENGTHS)
    return dict(report["rows"]) if same else {}


def put(given: Options, row: str, found: dict[str, Any]) -> None:
    """Add a row to the results, and write the tables anew."""
    given.out.mkdir(parents=True, exist_ok=True)
    rows = measured_rows(given)
    more = json.loads(json.dumps(found), parse_float=lambda digits: round(float(digits), 4))
    rows[row] = rows.get(row, {}) | more
    lengths = {name: getattr(given, name) for name in LENGTHS}
    report = {"commit": commit(), **lengths, "rows": rows}
    (given.out / FILE).write_text(json.dumps(report, separators=(",", ":")) + "\n")
    write_csv(given.out)
    print(f"{row}: " + ", ".join(f"{kind} {one['iou']['mean']:.3f}" for kind, one in found.items()))


def write_csv(out: Path) -> None:
    """Write the tables anew from the results."""
    rows = json.loads((out / FILE).read_text())["rows"]
    write_tables(out / "generalisation.csv", tables(rows))


def tables(rows: dict[str, Any]) -> list[str]:
    """For each figure, by kind: networks that saw the kind, the one that did not, and others; then
    the matrix, a line for each method and a column for each kind and place, held out kinds bold."""
    networks = [f"without {kind}" for kind in training_kinds()]
    shown = [row for row in (*networks, BUNDLED, "extrude", "truth") if row in rows]
    tested = dict.fromkeys(place for row in shown for place in rows[row])
    kinds = [kind for kind in training_kinds() if kind in tested]
    places = [place for place in tested if place not in kinds]
    lines = []
    for name, title in TITLES.items():
        found = {(row, one): rows[row][one][name] for row in shown for one in rows[row]}
        summary, matrix, shares = [], [], []
        for kind in kinds:
            others = (f"without {kind}", BUNDLED, "extrude")
            saw = [
                found[row, kind]["mean"]
                for row in networks
                if row != others[0] and (row, kind) in found
            ]
            mean = f"{sum(saw) / len(saw):.3f} (of {len(saw)})" if saw else "–"
            cells = [brief(found.get((one, kind), {"n": 0})) for one in others]
            summary.append((f"`{kind}`", [mean, *cells]))
            if saw and (others[0], kind) in found:
                shares.append(found[others[0], kind]["mean"] * len(saw) / sum(saw))
        for row in shown:
            cells = []
            for one in (*kinds, *places):
                mean = f"{found[row, one]['mean']:.2f}" if (row, one) in found else "–"
                cells.append(f"**{mean}**" if row == f"without {one}" else mean)
            matrix.append((row, cells))
        heads = ("seen in training", "held out", f"the bundled `{BUNDLED}`", "`extrude`")
        lines += titled(f"## {title}", heads, summary)
        if shares:
            spread = f"{np.mean(shares):.2f} on average, {min(shares):.2f} to {max(shares):.2f}"
            lines += ["", f"*Held out* as a share of *seen in training*: {spread}."]
        lines += ["", markdown([f"`{one}`" for one in (*kinds, *places)], matrix)]
    if places:
        means = {
            row: [np.mean([rows[row][place][name]["mean"] for place in places]) for name in TITLES]
            for row in shown
            if rows[row].keys() >= {*places}
        }
        rounded = ((row, [f"{mean:.3f}" for mean in several]) for row, several in means.items())
        lines += titled("## Mean of the real places", TITLES.values(), rounded)
    return lines


if __name__ == "__main__":
    main()
