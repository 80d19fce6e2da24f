"""`scenegen bench`, `export` and `calibrate`, and the option --weights of all commands, which names
networks."""

import json
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click
from click.shell_completion import CompletionItem

from scenegen.base.errors import DatasetError
from scenegen.base.executors import Executor
from scenegen.base.files import Json, check_ours, write_result
from scenegen.base.limits import MAX_SAMPLES
from scenegen.cli.options import (
    command,
    datasets_argument,
    executing,
    fields_in,
    find_datasets,
    group,
    options_of,
    out_option,
    printing,
    split_option,
    together,
)
from scenegen.cli.show import ProgressBar, Reporter, announce_compilation, echo, info, show_columns
from scenegen.cli.types import FILE, Named
from scenegen.model.config import (
    DEFAULT_NETWORK,
    METHODS,
    OWN_METRICS,
    USUAL,
    BenchConfig,
    PlanConfig,
    bundled,
    split_name,
    split_own,
    unknown_network,
)

if TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset
    from scenegen.view.look import Guesses


class Weights(click.ParamType):
    """Type of a network's name: a bundled one, a file, a run's folder, or
    hf://user/name[@revision]; a user's own code stands before it, as in module:Class@FILE."""

    name = "weights"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """Check a name, so that a typo is reported before torch is imported.

        `Completer.from_pretrained` opens the network later.

        Args:
            value: The name.
            param: The option.
            ctx: Context of the command.

        Returns:
            The name unchanged. A name that leads to no network is a `click.UsageError`.
        """
        word = split_own(value)[1]
        path = Path(word)
        # a single word without a suffix can only be a bundled network
        if not (word in bundled() or path.suffix or path.exists() or "/" in word):
            self.fail(unknown_network(word), param, ctx)
        return str(value)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Complete a name for the shell.

        Args:
            ctx: Context of the command, unused.
            param: The option, unused.
            incomplete: Begin of a name.

        Returns:
            Bundled networks with this begin; files if there are none.
        """
        items = [CompletionItem(name) for name in bundled() if name.startswith(incomplete)]
        return items or [CompletionItem(incomplete, type="file")]


class NamedWeights(Weights):
    """Type of a network's name, before which NAME= may give a name for its row."""

    name = "[name=]weights"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """Check the part after NAME=.

        Args:
            value: The text.
            param: The option.
            ctx: Context of the command.

        Returns:
            The text unchanged; see `Weights.convert`.
        """
        super().convert(split_name(str(value))[1], param, ctx)
        return str(value)


MAX_TRIAL = 10_000

prediction_options = together(
    click.option(
        "--predictions",
        type=FILE,
        help="Predictions of the split, as `complete` writes, or one HDF5 file of them: shown "
        "beside the truth.",
    ),
    click.option(
        "--weights",
        type=NamedWeights(),
        multiple=True,
        help="A network that completes what is shown, as for `complete`, with a name of your own "
        "as NAME=WEIGHTS; repeatable.",
    ),
    click.option(
        "--trial",
        type=click.IntRange(0, MAX_TRIAL),
        default=0,
        help="Which of the bench's goals in the sample paths lead to.",
    ),
    click.option("--no-paths", is_flag=True, help="Plan no paths on what is predicted."),
    group("Predictions", "predictions weights trial no-paths"),
)
"""The options of `chosen`, by its parameters' names."""


def chosen(
    dataset: "AnyDataset",
    split: str,
    predictions: Path | None,
    weights: Sequence[str],
    trial: int,
    no_paths: bool,
) -> "tuple[Guesses | None, tuple[str, ...]]":
    """Read the options in `prediction_options`.

    Args:
        dataset: The dataset.
        split: Its split.
        predictions: A file or folder of predictions, or None.
        weights: Names of networks, or NAME=WEIGHTS.
        trial: Number of the bench's goals to which paths are planned.
        no_paths: Whether no paths are planned.

    Returns:
        A function that predicts samples, or None without predictions and networks; and the names
        of the methods.

    Raises:
        ScenegenError: if predictions do not fit the split, or a network is missing or damaged.
    """
    if not weights and predictions is None:
        return None, ()
    # these load torch: not without predictions
    from scenegen.model.bench.methods import check_rows, rows_of
    from scenegen.model.bench.shown import guesses
    from scenegen.model.config import BenchConfig

    methods = rows_of((), weights, predictions)
    check_rows(methods, [dataset], split)
    names = tuple(method.name for method in methods)
    return partial(guesses, methods, BenchConfig(), None if no_paths else trial), names


REPORTS = ("report.json", "report.md", "report.html", "samples.html")
QUICK = {"samples": 50, "trials": 200}
"""Numbers of samples and trials of each dataset with `--quick`."""


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
    help=f"A row: {', '.join(METHODS.builtin)}, or MODULE:CLASS; repeatable.  [default: "
    f"{', '.join(USUAL)}]",
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
@click.option(
    "--metric",
    "metrics",
    type=Named(OWN_METRICS),
    multiple=True,
    help="A metric of your own, MODULE:OBJECT, beside those that are always measured; repeatable. "
    "See docs/metrics.md.",
)
@out_option("Folder of the report.", default=Path("bench"))
@options_of(BenchConfig, split="The split that is measured; calibrate on val alone.")
@click.option(
    "--quick", is_flag=True, help="A tenth of the samples and trials: two minutes at most."
)
@options_of(
    BenchConfig,
    draws="Answers for each map of a method that draws.",
    reliability="Also measure how reliable probabilities are. See docs/metrics.md.",
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
    report_result: Reporter,
    verbose: bool,
    **options: Any,
) -> None:
    """Score completion methods on reconstruction and planning: the paper's two tables, and more in
    the report.

    \f
    Args:
        datasets: Datasets; empty for all in data/.
        names: Names of methods; empty for `USUAL`.
        weights: Names of networks, or NAME=WEIGHTS.
        predictions: A file or folder of predictions, or None.
        out: Folder of the report.
        quick: Whether to measure less; see `QUICK`.
        execute: Where samples are measured.
        report_result: Prints the report as JSON, if asked for.
        verbose: Whether progress is shown.
        options: Fields of `BenchConfig` and `PlanConfig`.

    Raises:
        ScenegenError: if a dataset or a method is missing or invalid.
    """
    from scenegen.base.executors import commit
    from scenegen.model.bench.methods import rows_of
    from scenegen.model.bench.report import build_report, to_html, to_markdown
    from scenegen.model.bench.run import bench_all
    from scenegen.model.bench.shown import draw_failures, extremes

    if verbose:
        announce_compilation()
    measured = find_datasets(datasets, show_progress=verbose)
    for name in REPORTS:
        # now, and not after hours of work
        check_ours(out / name)
    methods = rows_of(names or USUAL, weights, predictions)
    plan = PlanConfig(**{name: options.pop(name) for name in fields_in(PlanConfig, options)})
    config = BenchConfig(plan=plan, **options | (QUICK if quick else {}))
    for dataset, method in product(measured if verbose else (), methods):
        # only networks know what they were trained on
        for warning in getattr(method, "unlike", lambda settings: [])(dataset.settings):
            info(f"note: {dataset.name}: {warning}")
    with ProgressBar("bench", visible=verbose) as progress:
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
    # NaN is not JSON: other programs could not read the report
    write_result(
        out / "report.json", (json.dumps(report, indent=1, allow_nan=False) + "\n").encode()
    )
    write_result(out / "report.md", to_markdown(report).encode())
    pictures: dict[str, list[tuple[str, bytes]]] = {}
    with suppress(ImportError):  # the report does without matplotlib
        for result in results:
            pictures[result.kind] = draw_failures(result, methods)
    samples = ""
    with suppress(DatasetError):  # a grid too large for a page
        samples = extremes(report, results, methods)
    if samples:
        write_result(out / REPORTS[-1], samples.encode())
    beside = REPORTS[-1] if samples else ""
    write_result(out / "report.html", to_html(report, pictures, beside).encode())
    if report_result(report):
        show_tables(report)
        echo(f"\nwritten: {out / 'report.html'}, {out / 'report.md'}, {out / 'report.json'}")


def show_tables(report: Json) -> None:
    """Print both tables: means, at the paper's thresholds."""
    from scenegen.model.bench.report import notes, tables, trial_counts
    from scenegen.model.bench.statistics import threshold

    for kind, facts in report["datasets"].items():
        for table, names, rows, _ in tables(report, kind):
            cells = {
                method: [
                    f"{row[name]['mean']:.3f}{threshold(row[name])}" if row[name]["n"] else "–"
                    for name in names
                ]
                for method, row in rows.items()
            }
            show_columns(cells, list(names), f"{kind}, {table}")
        echo(f"{kind}: {trial_counts(facts)}")
        for line in notes(facts):
            echo(f"note: {kind}: {line}")


@command("export", "export runs/mine -o mine.onnx")
@click.argument("weights", type=Weights(), default=DEFAULT_NETWORK)
@out_option("File to write.  [default: <name>.onnx]", ".onnx")
def export(weights: str, out: Path | None) -> None:
    """Write a network as ONNX, for the runtimes that are fastest on CPUs.

    \f
    Args:
        weights: Name of the network.
        out: The file; by default, NAME.onnx in the current folder.

    Raises:
        CheckpointError: if the network is missing or damaged, or cannot be exported.
    """
    from scenegen.model.completion.completer import open_network
    from scenegen.model.onnx import export_onnx

    network, grid, metadata = open_network(weights)
    out = out or Path(f"{Path(split_own(weights)[1]).stem}.onnx")
    export_onnx(network, grid, out, metadata=metadata)
    echo(f"written: {out}")


@command("calibrate columns data/pillar -o mine.safetensors", "calibrate runs/mine")
@click.argument("weights", type=Weights())
@datasets_argument
@split_option("val", help="The split whose worlds are looked at; one that no training saw.")
@click.option(
    "--samples", type=click.IntRange(1, MAX_SAMPLES), help="At most so many maps of each dataset."
)
@out_option(
    "File to write.  [default: the network's own; <name>.safetensors of a bundled one, or hf://…]",
    file=True,
)
@executing
@printing
def calibrate(
    weights: str,
    datasets: tuple[Path | str, ...],
    out: Path | None,
    report_result: Reporter,
    verbose: bool,
    **options: Any,
) -> None:
    """Calibrate a network's probabilities; the calibration is kept in its file.

    \f
    Args:
        weights: Name of the network.
        datasets: Datasets; empty for all in data/.
        out: The file; by default that of the network. For one that is bundled or from the Hub, a
            new one in the current folder.
        report_result: Prints the calibration as JSON, if asked for.
        verbose: Whether progress is shown.
        options: `split`, `samples` and `execute`, as for `scenegen.model.bench.calibrate`.

    Raises:
        CheckpointError: if the network is missing, damaged or an ONNX file.
        DatasetError: if a dataset is missing, or there are too few worlds.
    """
    from scenegen.base.files import check_ours, make_parent
    from scenegen.model.bench.calibrate import calibrate as fit
    from scenegen.model.checkpoint import CheckpointError
    from scenegen.model.completion.completer import HUB, called, locate
    from scenegen.model.config import bundled

    path = locate(weights)
    if path.suffix == ".onnx":
        raise CheckpointError(
            f"{path}: an exported network; calibrate its .safetensors file, then export that again"
        )
    plain = split_own(weights)[1]
    elsewhere = plain in bundled() or plain.startswith(HUB)
    if out is None and elsewhere:
        # `out_option` checks only a name that the user gave
        out = Path(f"{called(weights, path)}.safetensors")
        check_ours(out)
    out = out or path
    make_parent(out)
    if verbose:
        announce_compilation()
    folders = find_datasets(datasets, show_progress=verbose)
    with ProgressBar("calibrate", visible=verbose) as progress:
        calibration = fit(
            weights, folders, out, **options, on_start=progress.start, on_done=progress.count
        )
    if report_result(asdict(calibration)):
        echo(f"{calibration.worlds} worlds: temperature {calibration.temperature:.3f}")
        echo(f"written: {out}")
