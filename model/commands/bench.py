"""`scenegen bench`: datasets and rows by name, measured, and reported."""

import json
import shlex
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.registry import Registry
from scenegen.cli.options import (
    datasets_argument,
    examples,
    find_datasets,
    json_option,
    on_option,
    options_of,
    out_option,
    quiet_option,
    taken,
    workers_option,
)
from scenegen.cli.show import Progress, announce_compilation, note, say, show_figures
from scenegen.cli.types import Named
from scenegen.errors import DatasetError, ScenegenError, needs
from scenegen.model.commands.weights import Weights
from scenegen.model.evaluation.config import BenchConfig, PlanConfig
from scenegen.run import Executor, executor

if TYPE_CHECKING:
    from scenegen.dataset.read import Dataset
    from scenegen.model.evaluation.methods import Method

METHODS = Registry(
    "method",
    {
        "returns": "scenegen.model.completion.unlearned:Returns",
        "conservative": "scenegen.model.completion.unlearned:Conservative",
        "extrude": "scenegen.model.completion.unlearned:Extrude",
        "truth": "scenegen.model.evaluation.methods:Truth",
        "seen": "scenegen.model.evaluation.visibility:Seen",
    },
)
"""Classes of completers and of rows, made without arguments; a user's own completer as
``module:Class``."""
USUAL = tuple(name for name in METHODS.known if name != "seen")
"""The rows without any named: `seen` compiles every world, and is measured when it is asked for."""
REPORTS = ("report.json", "report.md", "report.html")
QUICK_SAMPLES, QUICK_TRIALS = 50, 200
"""What `--quick` measures of every dataset."""


@click.command(
    epilog=examples(
        "bench data/pillar --quick",
        "bench data/pillar --weights columns --weights runs/mine -o bench/mine",
        "bench data/pillar --method my_methods:Grown --method extrude",
    )
)
@datasets_argument
@click.option(
    "--method",
    "names",
    type=Named(METHODS),
    multiple=True,
    metavar="METHOD",
    help=f"A row: {', '.join(METHODS.known)}, or MODULE:CLASS; repeatable.  [default: all of "
    f"these but seen]",
)
@click.option(
    "--weights",
    type=Weights(),
    multiple=True,
    help="A network's row: a bundled name, a file, a run's folder, hf://…",
)
@click.option(
    "--predictions",
    type=click.Path(path_type=Path),
    help="HDF5 file of somebody's predictions: one more row.",
)
@out_option("Folder of the report.", default=Path("bench"))
@options_of(BenchConfig, split="The split that is measured; calibrate on val alone.")
@click.option(
    "--quick", is_flag=True, help="A tenth of the samples and trials: two minutes at most."
)
@options_of(
    BenchConfig,
    study="Study probabilities, bounds and risks besides: slower. See docs/bench.md.",
    seed="Decides the goals.",
)
@options_of(
    PlanConfig,
    edge_check="Let A* ask that the way between two nodes be free, too.",
    field="What paths are refined on: predicted distances, or the transform of the occupancy.",
    clearance_weight="λ_c, of clearance against smoothness.",
)
@workers_option
@on_option
@json_option
@quiet_option
def bench(
    datasets: tuple[Path | str, ...],
    out: Path,
    workers: int,
    on: str,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Score completion methods on reconstruction and planning: the paper's two tables, and more in
    the report."""
    talk = not (quiet or as_json)
    if talk:
        announce_compilation()
    report = run_bench(
        find_datasets(datasets, shown=talk),
        out=out,
        execute=executor(on, workers),
        talk=talk,
        plan=PlanConfig(**{name: options.pop(name) for name in taken(PlanConfig, options)}),
        **options,
    )
    if as_json:
        print(json.dumps(report))
    elif talk:
        show_tables(report)
        say(f"\nwritten: {out / 'report.html'}, {out / 'report.md'}, {out / 'report.json'}")


def run_bench(
    folders: Sequence[Path],
    *,
    names: Sequence[str],
    weights: Sequence[str] = (),
    predictions: Path | None,
    out: Path,
    quick: bool,
    execute: Executor,
    talk: bool = False,
    **given: Any,
) -> dict[str, Any]:
    """Measure as the `BenchConfig` of what is `given` says, write ``report.json``, ``report.md``
    and ``report.html`` into `out`, and return the report. With `talk`, progress is shown, and
    networks that meet another sensor than in training are named.

    Raises DatasetError for datasets or predictions that do not fit, ScenegenError for an unknown
    method.
    """
    from scenegen.dataset.read import Dataset
    from scenegen.files import check_ours, write_result
    from scenegen.model.evaluation.page import to_html
    from scenegen.model.evaluation.report import build_report, to_markdown
    from scenegen.model.evaluation.run import bench as measure
    from scenegen.model.evaluation.run import kinds_of
    from scenegen.run.software import commit

    for name in REPORTS:
        check_ours(out / name)
    methods = rows_of(names or USUAL, weights, predictions)
    datasets = [Dataset(folder) for folder in folders]
    config = BenchConfig(
        **given | ({"samples": QUICK_SAMPLES, "trials": QUICK_TRIALS} if quick else {})
    )
    check_rows(methods, datasets, config.split)
    tables = [
        (dataset, kind)
        for dataset in datasets
        # one without samples is refused when it is measured
        for kind in kinds_of(dataset, config.split) or (dataset.manifest.kind,)
    ]
    kinds = [kind for _, kind in tables]
    if len(set(kinds)) < len(kinds):
        raise DatasetError(
            f"two datasets of one kind ({', '.join(kinds)}): the tables hold one a kind; give one "
            f"of each"
        )
    for dataset, method in product(datasets if talk else (), methods):
        about = dataset.manifest
        unlike = getattr(method, "unlike", lambda *met: "")
        if warning := unlike(dataset.lidar, about.mapping, about.noise_stages):
            note(f"note: {dataset.folder}: {warning}")
    results = []
    for dataset, kind in tables:
        with Progress(kind, shown=talk) as shown:
            results.append(
                measure(
                    dataset,
                    methods,
                    config,
                    kind=kind,
                    execute=execute,
                    on_start=shown.start,
                    on_done=shown.count,
                )
            )
    command = shlex.join(["scenegen", *sys.argv[1:]])
    told = {"command": command, "commit": commit(), "split": config.split}
    report = build_report(results, seed=config.seed, about=told)
    write_result(
        out / "report.json", (json.dumps(report, indent=1, allow_nan=False) + "\n").encode()
    )
    write_result(out / "report.md", to_markdown(report).encode())
    pairs = zip(results, tables, strict=True)
    pictures = {result.kind: _failures(result, dataset, methods) for result, (dataset, _) in pairs}
    write_result(out / "report.html", to_html(report, pictures).encode())
    return report


def _failures(result: Any, dataset: Any, methods: "Sequence[Method]") -> list[tuple[str, bytes]]:
    """Pictures of failures; none without matplotlib."""
    from scenegen.model.evaluation.shown import draw_failures

    try:
        return draw_failures(result, dataset, methods)
    except ImportError:
        return []


def choose_methods(names: Sequence[str]) -> "list[Method]":
    """Rows by name: a known one, or ``module:Class`` of a completer; the usual ones for none.

    Raises ScenegenError for a name that leads to none, and for a completer that does not keep the
    protocol.
    """
    return [_method(name) for name in names or USUAL]


def _method(name: str) -> "Method":
    from scenegen.model.evaluation.methods import Completed

    try:
        found = METHODS.find(name)
    except ValueError as error:
        raise ScenegenError(f"--method: {error}") from None
    try:
        made = found()
    except TypeError as error:
        raise ScenegenError(
            f"--method {name}: cannot be made by calling it without arguments: {error}"
        ) from None
    if name in METHODS.known and hasattr(made, "completion"):  # a row itself, not a completer
        return made
    return Completed(made)


def rows_of(
    names: Sequence[str], weights: Sequence[str], predictions: Path | None
) -> "list[Method]":
    """Rows by their names, those of networks, and that of a file of predictions. Raises
    ScenegenError where two have one name, and where a row cannot be."""
    from scenegen.model.evaluation.methods import Predicted

    rows: list[Method] = [*map(_method, names), *map(network_row, weights)]
    if predictions is not None:
        rows.append(Predicted(predictions))
    named = [row.name for row in rows]
    if twice := [name for name in named if named.count(name) > 1]:
        raise ScenegenError(
            f"two rows are called {twice[0]!r}; give one of them, or rename its file or folder"
        )
    return rows


def check_rows(rows: "Sequence[Method]", datasets: "Sequence[Dataset]", split: str) -> None:
    """Raise DatasetError where a file of predictions is not of `split` of all `datasets`."""
    for row, dataset in product(rows, datasets):
        if (check := getattr(row, "check", None)) is not None:
            check(dataset, split)


def network_row(weights: str) -> "Method":
    """A network's row; what it needs is imported here, so that the other rows need no torch."""
    try:
        from scenegen.model.completion.completer import Completer
    except ImportError:
        raise ScenegenError(f"--weights {weights}: {needs('torch', 'train')}") from None
    return Completer.from_pretrained(weights, threads=1)


def show_tables(report: dict[str, Any]) -> None:
    """Both tables: means, at the paper's thresholds."""
    from scenegen.model.evaluation.report import tables
    from scenegen.model.evaluation.statistics import caution, threshold

    for kind, about in report["datasets"].items():
        for table, names, rows, _ in tables(report, kind):
            cells = {
                method: [
                    f"{row[name]['mean']:.3f}{threshold(row[name])}" if row[name]["n"] else "–"
                    for name in names
                ]
                for method, row in rows.items()
            }
            show_figures(cells, list(names), f"{kind}, {table}")
        if few := caution(about["worlds"]):
            say(f"note: {kind}: {few}")
