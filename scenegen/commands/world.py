"""`scenegen world`: one world's MJCF out of a dataset."""

import sys
from pathlib import Path

import rich_click as click

from scenegen.terminal.options import dataset_argument, out_option, split_option


@click.command()
@dataset_argument
@click.argument("number", type=click.IntRange(min=0))
@split_option("train", help="The split that the world belongs to.")
@out_option("MJCF file to write.  [default: standard output]", file=True)
def world(dataset: Path | str, number: int, split: str, out: Path | None) -> None:
    """Take one world's MJCF, and the files it refers to, out of a dataset."""
    from scenegen.dataset.extract import DOCUMENT, write_extracted
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset

    files = Dataset(locate(dataset, shown=True), partial=True).world(split, number)
    if out is not None:
        write_extracted(files, out)
        return
    if len(files) > 1:
        raise click.UsageError(f"this world refers to {len(files) - 1} other files; give -o: they go beside it")
    sys.stdout.buffer.write(files[DOCUMENT])
