"""`scenegen world`: one of a dataset's worlds."""

import sys
from pathlib import Path

import rich_click as click

from scenegen.cli.options import dataset_argument, out_option, split_option
from scenegen.cli.show import say


@click.command()
@dataset_argument
@click.argument("number", type=click.IntRange(min=0), required=False)
@split_option("train", help="The split that the world belongs to.")
@out_option(
    "File to write: MJCF, or .glb for its surfaces.  [default: MJCF to standard output]", file=True
)
def world(dataset: Path | str, number: int | None, split: str, out: Path | None) -> None:
    """Take one world's MJCF, and the files it refers to, out of a dataset.

    With a name that ends in .glb, write its surfaces instead, or those of an MJCF file (.xml).
    """
    from scenegen.dataset.extract import DOCUMENT, write_extracted
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset

    alone = isinstance(dataset, Path) and dataset.suffix == ".xml"
    surfaces = out is not None and out.suffix == ".glb"
    if alone and not surfaces:
        raise click.UsageError(
            f"{dataset}: is a world already; give -o with a name that ends in .glb"
        )
    if alone == (number is not None):
        raise click.UsageError(
            "give the number of one of the dataset's worlds, and none for an .xml file"
        )
    if surfaces:
        assert out is not None
        _write_surfaces(dataset, split, number, out)
        say(f"written: {out}")
        return
    assert number is not None
    files = Dataset(locate(dataset, shown=True), partial=True).world(split, number)
    if out is not None:
        write_extracted(files, out)
        say(f"written: {out}" + (f", {out.with_suffix('.files')}/" if len(files) > 1 else ""))
        return
    if len(files) > 1:
        raise click.UsageError(
            f"this world refers to {len(files) - 1} other files; give -o: they go beside it"
        )
    sys.stdout.buffer.write(files[DOCUMENT])


def _write_surfaces(dataset: Path | str, split: str, number: int | None, out: Path) -> None:
    from scenegen.dataset.extract import compile_archived
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset
    from scenegen.display.exchange.glb import encode_world
    from scenegen.files import write_result
    from scenegen.source import read_world

    if number is None:
        found = read_world(Path(dataset))
    else:
        found = compile_archived(Dataset(locate(dataset, shown=True), partial=True), split, number)
    write_result(out, encode_world(found))
