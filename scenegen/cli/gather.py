"""`scenegen take` and `scenegen merge`: datasets made of samples that are there."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen import SPLITS
from scenegen.cli.generate import show_summary
from scenegen.cli.options import (
    dataset_argument,
    datasets_argument,
    json_option,
    out_option,
    quiet_option,
    workers_option,
)
from scenegen.cli.progress import Progress
from scenegen.cli.types import Ranges, Written
from scenegen.dataset.choose import FIGURES, NUMBERS, Choice, Condition

if TYPE_CHECKING:
    from scenegen.dataset.state import Plan


@click.command()
@dataset_argument
@click.option(
    "--split",
    "splits",
    type=click.Choice(SPLITS),
    multiple=True,
    help="Samples of this split; several times for several.  [default: all]",
)
@click.option(
    "-n", "--n", "most", type=click.IntRange(min=1), help="The first so many of each split."
)
@click.option(
    "--worlds",
    type=Ranges(),
    help="Samples of these worlds alone: numbers, or FIRST:STOP, as in 3,10:20.",
)
@click.option(
    "--where",
    multiple=True,
    type=Written(Condition.of, "NAME>=VALUE"),
    help="Samples for which this holds, such as occupied>=0.05; several times for several. Names "
    "are "
    f"{', '.join((*NUMBERS, *FIGURES))}.",
)
@out_option("Folder of the new dataset.")
@workers_option
@click.option("--force", is_flag=True, help="Replace another dataset in the folder.")
@json_option
@quiet_option
def take(
    dataset: Path | str,
    splits: tuple[str, ...],
    most: int | None,
    worlds: Any,
    where: Any,
    **options: Any,
) -> None:
    """Make a dataset of some samples of another: of a split, of some worlds, or of those that a
    filter lets through.

    Samples stay as they are, bit for bit, and the manifest says where they are from. Given again
    after a stop, it goes on where it was.
    """
    from scenegen.dataset.gather import plan_take
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset

    chosen = tuple(split for split in SPLITS if split in splits) or SPLITS
    choice = Choice(splits=chosen, most=most, worlds=worlds or (), where=where)
    _make(
        lambda out, workers: plan_take(
            Dataset(locate(dataset, shown=not options["quiet"])), out, choice, workers=workers
        ),
        **options,
    )


@click.command()
@datasets_argument
@out_option("Folder of the new dataset.")
@workers_option
@click.option("--force", is_flag=True, help="Replace another dataset in the folder.")
@json_option
@quiet_option
def merge(datasets: tuple[Path | str, ...], **options: Any) -> None:
    """Make one dataset of several that share grid, sensor and fields.

    Samples stay as they are, bit for bit, and in their splits; the manifest says where they are
    from. Given again after a stop, it goes on where it was.
    """
    from scenegen.dataset.gather import plan_merge
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset

    if len(datasets) < 2:
        raise click.UsageError("give two datasets or more, and the folder of the new one with -o")
    shown = not options["quiet"]
    _make(
        lambda out, workers: plan_merge(
            [Dataset(locate(one, shown=shown)) for one in datasets], out, workers=workers
        ),
        **options,
    )


def _make(
    plan_of: Callable[[Path, int], "Plan"],
    *,
    out: Path | None,
    workers: int,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make a planned dataset in `out`, and tell of it."""
    if out is None:
        raise click.UsageError("give the new dataset's folder with -o")
    begin = time.perf_counter()
    talk = not (quiet or as_json)
    from scenegen.dataset.build import build

    plan = plan_of(out, workers)
    with Progress(out.name, shown=talk) as progress:
        summary = build(
            plan,
            workers=workers,
            force=force,
            on_start=lambda: progress.start(plan.samples),
            on_shard=lambda report, fresh: progress.count(report.samples),
        )
    if as_json:
        print(
            json.dumps(
                {
                    **vars(summary),
                    "folder": str(summary.folder),
                    "seconds": time.perf_counter() - begin,
                }
            )
        )
    elif talk:
        show_summary(summary, time.perf_counter() - begin)
