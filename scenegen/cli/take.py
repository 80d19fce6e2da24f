"""`scenegen take`: a selection of samples."""

from pathlib import Path
from typing import Any

import rich_click as click

from scenegen import SPLITS
from scenegen.cli.options import (
    command,
    dataset_argument,
    group,
    open_dataset,
    out_option,
    printing,
    splits_option,
    workers_option,
)
from scenegen.cli.show import Reporter, per_split, show_table
from scenegen.cli.types import Written, read_ranges
from scenegen.dataset.selection import MEASURES, NUMBERS, Condition, SelectionCriteria


@command(
    "take data/mixed --kind rooms --n 500 -o rooms.json",
    "take data/pillar --split train --where 'occupied>=0.05' -o dense.json",
)
@dataset_argument
@splits_option("Samples of this split")
@click.option(
    "-n", "--n", "count", type=click.IntRange(min=1), help="The first so many of each split."
)
@click.option(
    "--kind",
    "kinds",
    multiple=True,
    metavar="KIND",
    help="Only samples of this kind of worlds, such as maze (of every difficulty), or maze-hard; "
    "repeatable.",
)
@click.option(
    "--worlds",
    type=Written(read_ranges, "N,FIRST:STOP"),
    default=(),
    help="Only samples of these worlds: numbers, or FIRST:STOP, as in 3,10:20.",
)
@click.option(
    "--where",
    multiple=True,
    type=Written(Condition.of, "NAME>=VALUE"),
    help="Only samples for which this holds, in quotes: 'occupied>=0.05'; repeatable. Names: "
    f"{', '.join((*NUMBERS, *MEASURES))}.",
)
@out_option("File of the selection.", ".json", required=True)
@workers_option
@printing
@group("Which samples", "split n kind worlds where")
def take(
    dataset: Path | str,
    splits: tuple[str, ...],
    count: int | None,
    kinds: tuple[str, ...],
    worlds: Any,
    where: Any,
    out: Path,
    workers: int,
    report_result: Reporter,
    verbose: bool,
) -> None:
    """Select samples of a dataset: of a split, of some worlds, or by conditions.

    Writes a list of samples, which every command reads as a dataset; samples are not copied.

    \f
    Raises:
        DatasetError: No sample fulfils the conditions, or the dataset cannot be read.
    """
    from scenegen.base.errors import DatasetError
    from scenegen.base.files import write_result
    from scenegen.dataset.selection import choose, encode_selection

    # in the usual order, however they were given
    chosen = tuple(split for split in SPLITS if split in splits) or SPLITS
    criteria = SelectionCriteria(splits=chosen, most=count, kinds=kinds, worlds=worlds, where=where)
    # of an incomplete dataset, later samples would be missing without a word
    source = open_dataset(dataset, show_progress=verbose, partial=False)
    numbers = choose(source, criteria, workers=workers)
    counts = {split: len(of_split) for split, of_split in numbers.items()}
    if not sum(counts.values()):
        hint = f"; its kinds are {', '.join(source.kind.split('+'))}" if kinds else ""
        raise DatasetError(
            f"{source.name}: no sample fulfils the conditions ({str(criteria) or 'any'}); change "
            f"them{hint}"
        )
    # paths in the file are relative to its own folder
    write_result(out, encode_selection(source, numbers, criteria, out.parent))
    if report_result({"selection": str(out), "samples": counts}):
        show_table({"selection": out, "samples": per_split(counts)})
