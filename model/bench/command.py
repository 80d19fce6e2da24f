"""What `scenegen bench` does: datasets and rows by name, measured, and reported."""

import importlib
import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, ScenegenError, needs
from scenegen.files import write_whole
from scenegen.model.bench.methods import Completed, Method, Truth
from scenegen.model.bench.predicted import Predicted
from scenegen.model.bench.reconstruction import METRICS
from scenegen.model.bench.report import PLAN_METRICS, build_report, to_markdown
from scenegen.model.bench.run import BenchConfig, bench
from scenegen.model.complete import UNLEARNED, PredictionError
from scenegen.model.provenance import commit

QUICK_SAMPLES, QUICK_TRIALS = 50, 200
"""What `--quick` measures of every dataset."""


class Progress(AbstractContextManager["Progress"], Protocol):
    """Shows how far a dataset has come."""

    def start(self, total: int) -> None:
        """There are `total` samples."""

    def count(self, samples: int) -> None:
        """So many more are done."""


def run_bench(
    folders: Sequence[Path],
    *,
    names: Sequence[str],
    weights: Sequence[str] = (),
    predictions: Path | None,
    out: Path,
    split: str,
    quick: bool,
    seed: int,
    workers: int,
    command: str,
    progress: Callable[[str], Progress],
) -> dict[str, Any]:
    """Measure, write ``report.json`` and ``report.md`` into `out`, and return the report.

    Raises DatasetError for datasets or predictions that do not fit, ScenegenError for an unknown method.
    """
    methods = [*choose_methods(names), *map(_network, weights)]
    called = [method.name for method in methods] + (["predicted"] if predictions is not None else [])
    twice = [name for name, count in Counter(called).items() if count > 1]
    if twice:
        raise ScenegenError(f"two rows are called {twice[0]!r}; give one of them, or rename its file or folder")
    datasets = [Dataset(folder) for folder in folders]
    kinds = [dataset.manifest.kind for dataset in datasets]
    if len(set(kinds)) < len(kinds):
        raise DatasetError(
            f"two datasets of one kind ({', '.join(kinds)}): the tables hold one a kind; give one of each"
        )
    config = BenchConfig(split=split, seed=seed)
    if quick:
        config = BenchConfig(split=split, seed=seed, samples=QUICK_SAMPLES, trials=QUICK_TRIALS)
    predicted = Predicted(predictions) if predictions is not None else None
    if predicted is not None:
        for dataset in datasets:
            predicted.check(dataset, split)
    results = []
    for dataset in datasets:
        rows = [*methods, predicted] if predicted is not None else methods
        with progress(dataset.manifest.kind) as shown:
            results.append(bench(dataset, rows, config, workers=workers, on_start=shown.start, on_done=shown.count))
    report = build_report(results, seed=seed, about={"command": command, "commit": commit(), "split": split})
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DatasetError(f"{out}: cannot be made: {error.strerror}; choose another folder with --out") from None
    write_whole(out / "report.json", (json.dumps(report, indent=1) + "\n").encode())
    write_whole(out / "report.md", to_markdown(report).encode())
    return report


def choose_methods(names: Sequence[str]) -> list[Method]:
    """Rows by name: those that need no learning, `truth`, or ``module:Class`` of a completer; the known ones for none.

    Raises ScenegenError for a name that is none of these.
    """
    known: dict[str, Method] = {completer.name: Completed(completer) for completer in UNLEARNED}
    known["truth"] = Truth()
    chosen: list[Method] = []
    for name in names or known:
        if name in known:
            chosen.append(known[name])
            continue
        module, colon, attribute = name.partition(":")
        try:
            if not colon:
                raise ImportError("expected MODULE:CLASS")
            chosen.append(Completed(getattr(importlib.import_module(module), attribute)()))
        except (ImportError, AttributeError, TypeError, PredictionError) as error:
            raise ScenegenError(f"--method {name}: {error}; known are {', '.join(known)}, or MODULE:CLASS") from None
    return chosen


def _network(weights: str) -> Method:
    """A network's row; what it needs is imported here, so that the other rows need no torch."""
    try:
        from scenegen.model.pretrained import Pretrained
    except ImportError:
        raise ScenegenError(f"--weights {weights}: {needs('torch', 'train')}") from None
    return Completed(Pretrained(weights))


def tables(report: dict[str, Any]) -> str:
    """Both tables for a terminal: means, at the paper's thresholds."""
    lines = []
    for kind in report["datasets"]:
        for table, names in (("reconstruction", METRICS), ("planning", PLAN_METRICS)):
            lines.append(f"\n{kind}, {table}")
            width = max(len(name) for name in report[table][kind])
            lines.append(" " * width + "".join(f"{name:>15}" for name in names))
            for method, row in report[table][kind].items():
                cells = "".join(f"{row[name]['mean']:>15.3f}" if row[name]["n"] else f"{'–':>15}" for name in names)
                lines.append(f"{method:<{width}}{cells}")
    return "\n".join(lines)
