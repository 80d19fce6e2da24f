"""`scenegen convert`: a dataset in another program's format."""

from pathlib import Path
from typing import Any

import rich_click as click

from scenegen import SPLITS
from scenegen.cli.options import (
    dataset_argument,
    on_option,
    options_of,
    out_option,
    quiet_option,
    taken,
    workers_option,
)
from scenegen.cli.types import Named
from scenegen.display.exchange import FORMATS, Choices


@click.command()
@dataset_argument
@click.option(
    "--to",
    "to",
    type=Named(FORMATS),
    required=True,
    help=f"The format: {', '.join(FORMATS.known)}.",
)
@out_option("The folder to write.  [default: the dataset's name, a dash, the format]")
@click.option(
    "--split",
    "splits",
    type=click.Choice(SPLITS),
    multiple=True,
    help="A split; repeatable. [default: all]",
)
@options_of(
    Choices,
    unseen_invalid="SemanticKITTI: mark voxels that no ray met as invalid, which leaves them out "
    "of its score.",
    label="SemanticKITTI: the label of occupied voxels.",
    frame="Frame of points.",
)
@workers_option
@on_option
@quiet_option
def convert(
    dataset: Path | str,
    to: str,
    out: Path | None,
    splits: tuple[str, ...],
    workers: int,
    on: str,
    quiet: bool,
    **options: Any,
) -> None:
    """Write a dataset in another program's format; the same command again goes on where it was
    stopped."""
    from scenegen.cli.progress import Progress, note
    from scenegen.cli.show import say
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset
    from scenegen.display.exchange.convert import convert as write
    from scenegen.errors import DatasetError
    from scenegen.run import executor

    found = Dataset(locate(dataset, shown=not quiet), partial=True)
    choices = Choices(**taken(Choices, options))
    chosen = splits or SPLITS
    target = out or Path(f"{found.folder.name}-{to.rpartition(':')[2]}")
    if not found.manifest.complete:
        note(f"{found.folder}: is incomplete; what is there is converted")
    with Progress(to, shown=not quiet) as progress:
        done = write(
            found,
            target,
            to=to,
            choices=choices,
            splits=chosen,
            execute=executor(on, workers),
            on_start=progress.start,
            on_sample=progress.count,
        )
    for line in done.broken:
        note(line)
    if done.broken:
        raise DatasetError(
            f"{found.folder}: {len(done.broken)} samples could not be read; the others are in "
            f"{target}"
        )
    if not quiet:
        others = f"; {done.others} are for the other ranks to write there" if done.others else ""
        say(f"{target}: {done.written} samples written, {done.there} were there{others}")
