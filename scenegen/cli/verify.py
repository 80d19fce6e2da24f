"""`scenegen verify`: a dataset held against the format."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.base.errors import ScenegenError, UndecidedError
from scenegen.cli.options import (
    command,
    dataset_argument,
    executing,
    kind_option,
    printing,
    seed_option,
)
from scenegen.cli.show import (
    ProgressBar,
    Reporter,
    announce_compilation,
    echo,
    show_table,
)

if TYPE_CHECKING:
    from scenegen.verification import Report


@command("verify data/pillar", "verify hf://user/name --quick", "verify data/d --json")
@dataset_argument
@click.option(
    "--quick", is_flag=True, help="Only fast checks: files, digests, numbers, laws, splits."
)
@seed_option("Seed of the samples that are checked more closely.")
@kind_option
@click.option(
    "--check",
    "own",
    multiple=True,
    metavar="MODULE:OBJECT",
    help="Also run a check of your own; repeatable.",
)
@executing
@printing
def verify(dataset: Path | str, report_result: Reporter, verbose: bool, **options: Any) -> None:
    """Check a dataset against the format: files, digests, truth, rays, splits.

    Exit code 1: a check failed. Exit code 3: no check failed, but flights differ, since other
    versions of software made them.

    \f
    Raises:
        ScenegenError: A check failed.
        UndecidedError: Other versions of software made the flights.
    """
    if verbose:
        announce_compilation()
    # after the announcement, since this import may take seconds
    from scenegen.verification import verify as prove

    begin = time.perf_counter()
    with ProgressBar("verify", visible=verbose) as progress:
        report = prove(dataset, on_start=progress.start, on_done=progress.count, **options)
    seconds = time.perf_counter() - begin
    if report_result({**report.to_json(), "seconds": seconds}):
        _show_checks(report, seconds)
    if not report.ok:
        raise ScenegenError(
            f"verify: {len(report.failed)} of {len(report.checks)} checks failed: "
            f"{', '.join(report.failed)}"
        )
    if report.differing:
        first = next(check for check in report.checks if check.differing)
        raise UndecidedError(
            f"verify: no check failed, and {', '.join(report.differing)} cannot tell: "
            f"{first.detail}; verify with the versions that dataset.json names under software"
        )


def _show_checks(report: "Report", seconds: float) -> None:
    """Print a line for each check, and a summary."""
    rows, marks = {}, {}
    for check in report.checks:
        if not check.ok:
            marks[check.name] = "FAILED ", "red"
        elif check.differing:
            marks[check.name] = "differs", "yellow"
        else:
            marks[check.name] = ("skipped", "yellow") if check.skipped else ("ok     ", "green")
        rows[check.name] = f"{check.seconds:7.2f} s  {check.detail}"
    show_table(rows, marks=marks)
    echo(f"\n{report.samples} samples in {seconds:.1f} s, {report.samples / seconds:.0f} a second")
    if report.ok:
        skipped = sum(check.skipped for check in report.checks)
        differing = len(report.differing)
        passed = len(report.checks) - skipped - differing
        counts = {"differ": differing, "skipped": skipped}
        parts = [f"{count} {name}" for name, count in counts.items() if count]
        echo(", ".join([f"{passed} passed", *parts]) if parts else f"all {passed} checks passed")
