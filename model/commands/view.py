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
    open_dataset,
    quiet_option,
    split_option,
)
from scenegen.cli.show import note, say
from scenegen.cli.types import OutputFile
from scenegen.files import write_result
from scenegen.model.commands.weights import chosen, shown_options
from scenegen.paths import function_for, type_of

if TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset
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
    some of it, or the completion of a scan (.h5)."""
    if out is not None and (odd := flags_given(("host", "port"))):
        raise click.UsageError(f"{odd[0]}: is for what is served; leave out --html")
    if out is None and len(indices) > 1:
        raise click.UsageError(
            "--index: give one to begin with, or --html for a file of several samples"
        )
    name = type_of(dataset)
    if out is not None and name == "predictions":
        from scenegen.display.page import page

        looks = function_for(dataset, "shows")(Path(dataset))
        write_result(out, page(looks, title=str(dataset)).encode())
        if not quiet:
            say(f"{out}: open it in a browser")
        return
    source = open_dataset(dataset, shown=not quiet)
    opened = list(source.datasets) if len(source.datasets) > 1 else [source]
    if out is None and len(opened) > 1 and shown["predictions"] is not None:
        raise click.UsageError("--predictions: is of one dataset; name that one")
    guesses, methods = chosen(source if out is not None else opened[0], split, **shown)
    if out is not None:
        write_page(source, split, indices, count, out, quiet, guesses)
        return
    from scenegen.display.live import Live
    from scenegen.display.look import incomplete

    samples, index = len(opened[0].split(split)), indices[0] if indices else 0
    if index >= max(samples, 1):
        raise click.UsageError(f"--index {index}: its {split} split has {samples} samples")
    for each in opened:
        for line in incomplete(each, split):
            note(f"{each.name}: {line}")
    server = Live(
        opened, split=split, index=index, host=host, port=port, guesses=guesses, methods=methods
    )
    with server, stops.noted() as stopped:
        folders = ", ".join(each.name for each in opened)
        say(f"{server.address}  shows {folders}; Ctrl-C ends it")
        if server.on_loopback:
            bound = server.server_address[1]
            say(
                f"from another machine: ssh -L {bound}:127.0.0.1:{bound} to this one, then the "
                "same address there"
            )
        while not stopped():
            server.handle_request()


def write_page(
    found: "AnyDataset",
    split: str,
    indices: tuple[int, ...],
    count: int,
    out: Path,
    quiet: bool,
    guesses: "Guesses | None",
) -> None:
    """Write a page that holds what it shows: samples of a split by `indices`, else `count` of them,
    evenly spread."""
    from scenegen.display.look import evenly, looks, title_of
    from scenegen.display.page import check_grid, page

    check_grid(found.grid)
    shown, notes = looks(found, split, indices or evenly(len(found.split(split)), count), guesses)
    title = f"{title_of(found)}, {split}"
    content = page(shown, title=title, notes=notes)
    write_result(out, content.encode())
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(shown)} samples, {len(content) / 1e6:.1f} MB; open it in a browser")
