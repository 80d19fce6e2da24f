"""`scenegen bench`: datasets and rows by name, measured, and reported."""

import json
import shlex
import sys
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.options import (
    command,
    datasets_argument,
    executing,
    find_datasets,
    group,
    options_of,
    out_option,
    printing,
    taken,
)
from scenegen.cli.show import Progress, Tell, announce_compilation, note, say, show_columns
from scenegen.cli.types import FILE, Named
from scenegen.files import Json, check_ours, write_result
from scenegen.model.commands.weights import NamedWeights
from scenegen.model.config import METHODS, USUAL, BenchConfig, PlanConfig
from scenegen.run import Executor

REPORTS = ("report.json", "report.md", "report.html")
QUICK = {"samples": 50, "trials": 200}
"""What `--quick` measures of every dataset."""


@command(
    "bench data/pillar --quick",
    "bench data/pillar --weights columns --weights runs/mine -o bench/mine",
    "bench data/pillar --method my_methods:Grown --method extrude",
)
@datasets_argument
@click.option(
    "--method",
    "names",
    type=Named(METHODS),
    multiple=True,
    help=f"A row: {', '.join(METHODS.builtin)}, or MODULE:CLASS; repeatable.  [default: all of "
    f"these but seen]",
)
@click.option(
    "--weights",
    type=NamedWeights(),
    multiple=True,
    help="A network's row: a bundled name, a file, a run's folder, hf://…; NAME=WEIGHTS names the "
    "row.",
)
@click.option(
    "--predictions",
    type=FILE,
    help="Somebody's predictions, an HDF5 file or a folder of them: one more row.",
)
@out_option("Folder of the report.", default=Path("bench"))
@options_of(BenchConfig, split="The split that is measured; calibrate on val alone.")
@click.option(
    "--quick", is_flag=True, help="A tenth of the samples and trials: two minutes at most."
)
@options_of(
    BenchConfig,
    reliability="Also measure how reliable probabilities are. See docs/reliability.md.",
    seed="Decides the goals.",
)
@options_of(
    PlanConfig,
    planner="The paper's, or one that weighs ways by their risk. See docs/planning.md.",
    edge_check="Let A* ask that the way between two nodes be free, too.",
    field="What paths are refined on: predicted distances, or the transform of the occupancy.",
    clearance_weight="λ_c, of clearance against smoothness.",
)
@executing
@printing
@group("Rows", "method weights predictions")
@group("Planning", "planner edge-check field clearance-weight")
def bench(
    datasets: tuple[Path | str, ...],
    names: tuple[str, ...],
    weights: tuple[str, ...],
    predictions: Path | None,
    out: Path,
    quick: bool,
    execute: Executor,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Score completion methods on reconstruction and planning: the paper's two tables, and more in
    the report."""
    from scenegen.model.evaluation.methods import rows_of
    from scenegen.model.evaluation.report import build_report, to_html, to_markdown
    from scenegen.model.evaluation.run import bench_all
    from scenegen.model.evaluation.shown import draw_charts, draw_failures
    from scenegen.run.software import commit

    if talk:
        announce_compilation()
    measured = find_datasets(datasets, shown=talk)
    for name in REPORTS:
        check_ours(out / name)
    methods = rows_of(names or USUAL, weights, predictions)
    plan = PlanConfig(**{name: options.pop(name) for name in taken(PlanConfig, options)})
    config = BenchConfig(plan=plan, **options | (QUICK if quick else {}))
    for dataset, method in product(measured if talk else (), methods):
        for warning in getattr(method, "unlike", lambda settings: [])(dataset.settings):
            note(f"note: {dataset.name}: {warning}")
    with Progress("bench", shown=talk) as progress:
        results = bench_all(
            measured,
            methods,
            config,
            execute=execute,
            on_start=progress.start,
            on_done=progress.count,
        )
    command = shlex.join(["scenegen", *sys.argv[1:]])
    facts = {"command": command, "commit": commit(), "split": config.split}
    report = build_report(results, seed=config.seed, about=facts)
    write_result(
        out / "report.json", (json.dumps(report, indent=1, allow_nan=False) + "\n").encode()
    )
    write_result(out / "report.md", to_markdown(report).encode())
    pictures: dict[str, list[tuple[str, bytes]]] = {}
    with suppress(ImportError):  # the report does without matplotlib
        for result in results:
            pictures[result.kind] = draw_charts(report, result.kind) + draw_failures(
                result, methods
            )
    write_result(out / "report.html", to_html(report, pictures).encode())
    if tell(report):
        show_tables(report)
        say(f"\nwritten: {out / 'report.html'}, {out / 'report.md'}, {out / 'report.json'}")


def show_tables(report: Json) -> None:
    """Both tables: means, at the paper's thresholds."""
    from scenegen.model.evaluation.report import notes, tables, trial_counts
    from scenegen.model.evaluation.statistics import threshold

    for kind, about in report["datasets"].items():
        for table, names, rows, _ in tables(report, kind):
            cells = {
                method: [
                    f"{row[name]['mean']:.3f}{threshold(row[name])}" if row[name]["n"] else "–"
                    for name in names
                ]
                for method, row in rows.items()
            }
            show_columns(cells, list(names), f"{kind}, {table}")
        say(f"{kind}: {trial_counts(about)}")
        for line in notes(about):
            say(f"note: {kind}: {line}")
