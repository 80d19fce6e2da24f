"""`scenegen view`: samples in three dimensions, and what was predicted of them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.cli import stops
from scenegen.cli.options import (
    command,
    dataset_argument,
    flags_given,
    group,
    index_option,
    quiet_option,
    split_option,
)
from scenegen.cli.show import note, say
from scenegen.cli.types import OutputFile
from scenegen.model.commands.weights import chosen, shown_options

if TYPE_CHECKING:
    from scenegen.dataset.read import Dataset
    from scenegen.display.look import Guesses

MAX_SHOWN = 200
"""The most samples in a file."""


@command(
    "view data/pillar",
    "view data/pillar --split test --weights columns --weights proposed",
    "view data/pillar --index 3 --index 7 --html samples.html",
)
@dataset_argument
@split_option("train", help="The split to show samples of.")
@click.option(
    "-o",
    "--html",
    "--output",
    "--out",
    "out",
    type=OutputFile(),
    help="Write one file that shows samples without a network.  [default: serve all of them]",
)
@index_option
@click.option(
    "--n",
    "count",
    type=click.IntRange(1, MAX_SHOWN),
    default=24,
    help="In a file: how many samples, evenly spread, where no --index is given.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    help="Address to serve on; with 0.0.0.0 all who reach this machine can look.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8000,
    help="0 for any.",
)
@quiet_option
@shown_options
@group("What is shown", "split index n html")
@group("In a browser", "host port")
def view(
    dataset: Path | str,
    split: str,
    indices: tuple[int, ...],
    count: int,
    out: Path | None,
    host: str,
    port: int,
    quiet: bool,
    **shown: Any,
) -> None:
    """Show a dataset in a browser, from this machine; or, with --html, write one file that shows
    some of it."""
    if out is not None and (odd := flags_given(("host", "port"))):
        raise click.UsageError(f"{odd[0]}: is for what is served; leave out --html")
    if out is None and len(indices) > 1:
        raise click.UsageError(
            "--index: give one to begin with, or --html for a file of several samples"
        )
    from scenegen.dataset.locate import locate
    from scenegen.dataset.manifest import NAME
    from scenegen.dataset.read import Dataset

    path = Path(dataset)
    inside = sorted(path.glob(f"*/{NAME}")) if out is None and not (path / NAME).exists() else []
    folders = [manifest.parent for manifest in inside] or [locate(dataset, shown=not quiet)]
    if len(folders) > 1 and shown["predictions"] is not None:
        raise click.UsageError("--predictions: is of one dataset; name that one")
    opened = [Dataset(folder, partial=True) for folder in folders]
    guesses, methods = chosen(opened[0], split, **shown)
    if out is not None:
        write_page(opened[0], split, indices, count, out, quiet, guesses)
        return
    from scenegen.display.live import Live
    from scenegen.display.look import incomplete

    size, index = len(opened[0].split(split)), indices[0] if indices else 0
    if index >= max(size, 1):
        raise click.UsageError(f"--index {index}: its {split} split has {size} samples")
    for one in opened:
        for line in incomplete(one, split):
            note(f"{one.folder}: {line}")
    server = Live(
        opened, split=split, index=index, host=host, port=port, guesses=guesses, methods=methods
    )
    with server, stops.noted() as stopped:
        say(
            f"{server.address}  shows {', '.join(str(one.folder) for one in opened)}; "
            "Ctrl-C ends it"
        )
        if server.on_loopback:
            bound = server.server_address[1]
            say(
                f"from another machine: ssh -L {bound}:127.0.0.1:{bound} to this one, then the "
                "same address there"
            )
        while not stopped():
            server.handle_request()


def write_page(
    found: "Dataset",
    split: str,
    indices: tuple[int, ...],
    count: int,
    out: Path,
    quiet: bool,
    guesses: "Guesses | None",
) -> None:
    """Write a page that holds what it shows: samples of a split by `indices`, else `count` of them,
    evenly spread."""
    from scenegen.display.look import looks, spread, title_of
    from scenegen.display.page import check_grid, page
    from scenegen.files import write_result

    check_grid(found.grid)
    samples, notes = looks(found, split, indices or spread(found, split, count), guesses)
    title = f"{title_of(found)}, {split}"
    content = page(samples, title=title, notes=notes)
    write_result(out, content.encode())
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(samples)} samples, {len(content) / 1e6:.1f} MB; open it in a browser")
