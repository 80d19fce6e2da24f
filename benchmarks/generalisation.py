"""Which kinds of worlds teach what: every kind is held out in turn.

    python benchmarks/generalisation.py --data /tmp/g           # docs/results/generalisation.*
    python benchmarks/generalisation.py --data /tmp/g --held rooms --held cave
    python benchmarks/generalisation.py --data /tmp/g --real MAPS
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
from scoring import RESULTS, by_map, drawn, measured, networks, rewrite

from scenegen.dataset.read import Dataset
from scenegen.model.completion.unlearned import Extrude
from scenegen.model.config import PlanConfig
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.statistics import brief, figure, head, line
from scenegen.recipe import preset
from scenegen.recipes import kind_names
from scenegen.run.software import commit

BUNDLED = "columns"
NETWORK = (
    *("--variant", "columns", "--input", "observed", "--input", "free"),
    *("--lambda-occupancy", 1, "--lovasz", 1, "--eikonal", 0),
)
"""As the bundled network was trained."""
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
    parser.add_argument("--page", action="store_true", help="write the page anew, no more")
    given = measuring.parse(parser, maps=2, tests=2, trials=2, held=["maze"])
    if given.page:
        return write_page(given.out)
    with tempfile.TemporaryDirectory() as spare:
        folder = given.data or Path(spare)
        kinds = ("maze", "pillar") if given.smoke else kind_names()
        tests = {kind: drawn(folder / kind, preset(kind), given.tests) for kind in kinds}
        tests |= real_places(given.real, folder, min(given.tests, POSES))
        there = rows_of(given.out, given)
        (columns,) = networks([BUNDLED])
        known: dict[str, Method] = {"truth": Truth(), "extrude": Completed(Extrude())}
        for name, method in (known | {BUNDLED: columns}).items():
            if left := missing(there, name, tests):
                put(given.out, given, name, figures(method, left, given.trials))
        for held in given.held or kinds:
            if left := missing(there, row := f"without {held}", tests):
                run = train(folder / row.replace(" ", "-"), [k for k in kinds if k != held], given)
                (network,) = networks([str(run)])
                put(given.out, given, row, figures(network, left, given.trials))


def missing(there: dict[str, Any], row: str, tests: dict[str, Dataset]) -> dict[str, Dataset]:
    """The datasets on which a row was not measured yet."""
    return {kind: dataset for kind, dataset in tests.items() if kind not in there.get(row, ())}


def train(out: Path, kinds: Sequence[str], given: Any) -> Path:
    """The folder of a run that learned from these kinds."""
    words = [word for kind in kinds for word in ("--stream", kind)]
    looks = max(given.maps // 5, 1)
    lengths = ("--maps", given.maps, "--interval", looks, "--val-maps", min(200, given.maps))
    measuring.run("-m", "scenegen", "train", *words, *NETWORK, *lengths, "--quiet", "--out", out)
    return out


def figures(method: Method, tests: dict[str, Dataset], trials: int) -> dict[str, Any]:
    """What a method reaches on every kind, with intervals over worlds; over maps in a real place,
    which is one world. Edges are checked, for the paper's planner steps through walls that are
    thinner than its lattice."""
    found = {}
    for kind, result in measured(tests, [method], trials, PlanConfig(edge_check=True)).items():
        alone, values = len(set(result.worlds.tolist())) == 1, result.methods[method.name].values
        found[kind] = {
            name: figure(
                values(name),
                by_map(result, name) if alone else result.worlds_of(name),
                (METRICS | PLAN_METRICS)[name].scale,
            )
            for name in TITLES
        }
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
    file = out / "generalisation.json"
    report = {"commit": commit(), **{name: getattr(given, name) for name in LENGTHS}}
    report["rows"] = rows_of(out, given)
    more = json.loads(json.dumps(found), parse_float=lambda digits: round(float(digits), 4))
    report["rows"][row] = report["rows"].get(row, {}) | more
    file.write_text(json.dumps(report, separators=(",", ":")) + "\n")
    write_page(out)
    print(f"{row}: " + ", ".join(f"{kind} {one['iou']['mean']:.3f}" for kind, one in found.items()))


def write_page(out: Path) -> None:
    """Write the page's tables anew from the results."""
    rows = json.loads((out / "generalisation.json").read_text())["rows"]
    rewrite(out / "generalisation.md", tables(rows))


def tables(rows: dict[str, Any]) -> list[str]:
    """For each figure, by kind: networks that saw the kind, the one that did not, and others; then
    the matrix, a line for each method and a column for each kind and place, held out kinds bold."""
    networks = [f"without {kind}" for kind in kind_names()]
    shown = [row for row in (*networks, BUNDLED, "extrude", "truth") if row in rows]
    tested = dict.fromkeys(place for row in shown for place in rows[row])
    kinds = [kind for kind in kind_names() if kind in tested]
    places = [place for place in tested if place not in kinds]
    lines = []
    for name, title in TITLES.items():
        heads = ("seen in training", "held out", f"the bundled `{BUNDLED}`", "`extrude`")
        lines += ["", f"## {title}", "", *head(heads)]
        for kind in kinds:
            saw = [
                rows[row][kind][name]["mean"]
                for row in networks
                if row != f"without {kind}" and kind in rows.get(row, ())
            ]
            mean = f"{sum(saw) / len(saw):.3f} (of {len(saw)})" if saw else "–"
            others = (f"without {kind}", BUNDLED, "extrude")
            lines.append(
                line(f"`{kind}`", (mean, *(_cell(rows, one, kind, name) for one in others)))
            )
        lines += ["", *head([f"`{one}`" for one in (*kinds, *places)])]
        for row in shown:
            cells = []
            for one in (*kinds, *places):
                mean = f"{rows[row][one][name]['mean']:.2f}" if one in rows[row] else "–"
                cells.append(f"**{mean}**" if row == f"without {one}" else mean)
            lines.append(line(row, cells))
    if places:
        lines += ["", "## Mean of the real places", "", *head(TITLES.values())]
        for row in (row for row in shown if all(place in rows[row] for place in places)):
            found = ([rows[row][place][title]["mean"] for place in places] for title in TITLES)
            lines.append(line(row, (f"{np.mean(values):.3f}" for values in found)))
    return lines


def _cell(rows: dict[str, Any], row: str, kind: str, name: str) -> str:
    if row not in rows or kind not in rows[row]:
        return "–"
    return brief(rows[row][kind][name])


if __name__ == "__main__":
    main()
