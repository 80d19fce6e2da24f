"""`scenegen convert` and `scenegen world`: a dataset, or one of its worlds, for other programs."""

import sys
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen import SPLITS
from scenegen.cli.options import (
    command,
    dataset_argument,
    executing,
    group,
    open_dataset,
    options_of,
    out_option,
    quiet_option,
    split_option,
    splits_option,
)
from scenegen.cli.show import Progress, note, say
from scenegen.cli.types import Named
from scenegen.display.exchange import FORMATS, Choices
from scenegen.paths import type_of
from scenegen.run import Executor


@command(
    "convert data/pillar --to ply",
    "convert data/pillar --to rerun --split val",
)
@dataset_argument
@click.option(
    "--to",
    "to",
    type=Named(FORMATS),
    required=True,
    help=f"The format: {', '.join(FORMATS.builtin)}, or MODULE:CLASS.",
)
@out_option("The folder to write.  [default: the dataset's name, a dash, the format]")
@splits_option("A split")
@options_of(
    Choices,
    unseen_invalid="SemanticKITTI: mark voxels that no ray met as invalid, which leaves them out "
    "of its score.",
    label="SemanticKITTI: the label of occupied voxels without a class, or of one that it lacks.",
    frame="Frame of points.",
)
@executing
@quiet_option
@group("SemanticKITTI", "unseen-invalid label")
def convert(
    dataset: Path | str,
    to: str,
    out: Path | None,
    splits: tuple[str, ...],
    execute: Executor,
    quiet: bool,
    **options: Any,
) -> None:
    """Write a dataset in another program's format; the same command again goes on where it was
    stopped.
    """
    from scenegen.display.exchange.convert import convert as write
    from scenegen.errors import DatasetError, plural

    source = open_dataset(dataset, shown=not quiet)
    target = out or Path(f"{Path(source.name).absolute().stem}-{to.rpartition(':')[2]}")
    for one in source.datasets:
        if not one.manifest.complete:
            note(f"{one.folder}: is incomplete; what is there is converted")
    with Progress(to, shown=not quiet) as progress:
        done = write(
            source,
            target,
            to=to,
            choices=Choices(**options),
            splits=splits or SPLITS,
            execute=execute,
            on_start=progress.start,
            on_done=progress.count,
        )
    for line in (*(done.notes if not quiet else ()), *done.broken):
        note(line)
    if done.broken:
        raise DatasetError(
            f"{source.name}: {len(done.broken)} samples could not be read; the others are in "
            f"{target}"
        )
    if not quiet:
        others = f"; {done.others} are for the other ranks to write there" if done.others else ""
        before = f"; an earlier run wrote {done.there}" if done.there else ""
        say(f"{target}: {plural(done.written, 'samples')} written{before}{others}")


@command("world data/pillar 3 -o world.xml", "world scenes/forest.xml -o forest.glb")
@dataset_argument
@click.argument("number", type=click.IntRange(min=0), required=False)
@split_option("train", help="The split that the world belongs to.")
@out_option(
    "File to write: MJCF (.xml), or its surfaces (.glb).  [default: MJCF to standard output]",
    ".xml",
    ".glb",
)
def world(dataset: Path | str, number: int | None, split: str, out: Path | None) -> None:
    """Take one world's MJCF, and the files it refers to, out of a dataset.

    With a name that ends in .glb, write its surfaces instead, or those of an MJCF file (.xml).
    """
    alone = type_of(dataset) == "world"
    surfaces = out is not None and out.suffix == ".glb"
    if alone and not surfaces:
        raise click.UsageError(
            f"{dataset}: is a world already; give -o with a name that ends in .glb"
        )
    if alone == (number is not None):
        raise click.UsageError(
            "give the number of one of the dataset's worlds, and none for an .xml file"
        )
    if out is not None and surfaces:
        from scenegen.display.exchange.glb import encode_world
        from scenegen.files import write_result
        from scenegen.source import read_world
        from scenegen.worlds.world import solid

        compiled = (
            read_world(Path(dataset))
            if number is None
            else open_dataset(dataset, shown=True).compile(split, number)
        )
        write_result(out, encode_world(solid(compiled, str(dataset))))
        say(f"written: {out}")
        return
    from scenegen.dataset.archive import DOCUMENT, write_extracted

    assert number is not None
    files = open_dataset(dataset, shown=True).world(split, number)
    if out is not None:
        write_extracted(files, out)
        say(f"written: {out}" + (f", {out.with_suffix('.files')}/" if len(files) > 1 else ""))
    elif len(files) > 1:
        raise click.UsageError(
            f"this world refers to {len(files) - 1} other files; give -o: they go beside it"
        )
    else:
        sys.stdout.buffer.write(files[DOCUMENT])
