"""What `scenegen view` does; the command itself stands where predictions are known."""

from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.terminal.options import dataset_argument, quiet_option, split_option, was_given
from scenegen.terminal.types import OutputFile

if TYPE_CHECKING:
    from scenegen.dataset.read import Dataset
    from scenegen.view.look import Guesses

MOST_SHOWN = 200
"""The most samples in a file."""


def view_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options of `show`."""
    options = (
        dataset_argument,
        split_option("train", help="The split to show samples of."),
        click.option(
            *("-o", "--html", "--output", "--out", "out"),
            type=OutputFile(),
            help="Write one file that shows samples without a network.  [default: serve all of them]",
        ),
        click.option(
            *("--index", "indices"),
            multiple=True,
            type=click.IntRange(0),
            help="A number of a sample; in a file, repeatable.",
        ),
        click.option(
            *("--n", "count"),
            type=click.IntRange(1, MOST_SHOWN),
            default=24,
            show_default=True,
            help="In a file: how many samples, evenly spread, where no --index is given.",
        ),
        click.option(
            *("--host", "host"),
            callback=_address,
            default="127.0.0.1",
            show_default=True,
            help="Address to serve on; with 0.0.0.0 all who reach this machine can look.",
        ),
        click.option(
            *("--port", "port"), type=click.IntRange(0, 65535), default=8000, show_default=True, help="0 for any."
        ),
        quiet_option,
    )
    return reduce(lambda made, option: option(made), reversed(options), function)


def _address(ctx: Any, parameter: Any, value: str) -> str:
    from ipaddress import ip_address

    try:
        return value if value == "localhost" else str(ip_address(value))
    except ValueError:
        raise click.BadParameter(f"{value!r} is no IP address; give one of this machine's, such as 127.0.0.1") from None


def show(
    dataset: Path | str,
    split: str,
    indices: tuple[int, ...],
    count: int,
    out: Path | None,
    host: str,
    port: int,
    quiet: bool,
    guesses: "Callable[[Dataset], tuple[Guesses | None, tuple[str, ...]]]",
) -> None:
    """Serve the dataset until the command is stopped, or write samples to the page `out`; with what `guesses` has of
    the dataset: who predicts, and their names."""
    for name in ("host", "port"):
        if out is not None and was_given(name):
            raise click.UsageError(f"--{name}: is for what is served; leave out --html")
    if out is None and len(indices) > 1:
        raise click.UsageError("--index: give one to begin with, or --html for a file of several samples")
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset

    found = Dataset(locate(dataset, shown=not quiet), partial=True)
    if out is None:
        _serve(found, split, indices[0] if indices else 0, host, port, guesses)
    else:
        _write(found, split, indices, count, out, quiet, guesses)


def _write(
    found: "Dataset", split: str, indices: tuple[int, ...], count: int, out: Path, quiet: bool, guesses: Any
) -> None:
    from scenegen.errors import printable
    from scenegen.files import make_parent, write_whole
    from scenegen.terminal.progress import note
    from scenegen.terminal.show import say
    from scenegen.view.look import looks, spread
    from scenegen.view.page import check_grid, page

    check_grid(found.grid)
    shown, notes = looks(found, split, indices or spread(found, split, count), guesses(found)[0])
    content = page(shown, title=printable(f"{found.folder.name}: {found.manifest.kind}, {split}"), notes=notes)
    make_parent(out)
    write_whole(out, content.encode())
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(shown)} samples, {len(content) / 1e6:.1f} MB; open it in a browser")


def _serve(found: "Dataset", split: str, index: int, host: str, port: int, guesses: Any) -> None:
    """Serve until a stop, which ends the process."""
    import sys

    from scenegen.terminal.progress import note
    from scenegen.terminal.show import say
    from scenegen.view.live import Live
    from scenegen.view.look import incomplete

    if not 0 <= index < max(len(found.split(split)), 1):
        raise click.UsageError(f"--index {index}: its {split} split has {len(found.split(split))} samples")
    for line in incomplete(found, split):
        note(line)
    guess, methods = guesses(found)
    server = Live(found, split=split, index=index, host=host, port=port, guesses=guess, methods=methods)
    say(f"{server.address}  shows {found.folder}; Ctrl-C ends it")
    if server.on_loopback:
        bound = server.server_address[1]
        say(f"from another machine: ssh -L {bound}:127.0.0.1:{bound} to this one, then the same address there")
    sys.stdout.flush()
    server.serve_forever()
