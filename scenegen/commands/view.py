"""What `scenegen view` does, a page to look at samples with; the command itself stands where predictions are known."""

from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.terminal.options import dataset_argument, quiet_option, split_option
from scenegen.terminal.types import OutputFile

if TYPE_CHECKING:
    from scenegen.dataset.read import Dataset
    from scenegen.view.look import Layers

MOST_SHOWN = 200
"""The most samples on a page."""


def page_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options of `show_page`."""
    options = (
        dataset_argument,
        split_option("train", help="The split to show samples of."),
        click.option(
            "--index", "indices", multiple=True, type=click.IntRange(0), help="Number of a sample; repeatable."
        ),
        click.option(
            "--n",
            "count",
            type=click.IntRange(1, MOST_SHOWN),
            default=24,
            show_default=True,
            help="How many samples, evenly spread, where no --index is given.",
        ),
        click.option(
            *("-o", "--html", "--output", "--out", "out"),
            type=OutputFile(),
            default=Path("samples.html"),
            show_default=True,
            help="The page to write.",
        ),
        quiet_option,
    )
    return reduce(lambda made, option: option(made), reversed(options), function)


def show_page(
    dataset: Path | str,
    split: str,
    indices: tuple[int, ...],
    count: int,
    out: Path,
    quiet: bool,
    more: "Callable[[Dataset], Layers] | None" = None,
) -> None:
    """Write the page, with the layers that `more` has of the dataset."""
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset
    from scenegen.errors import printable
    from scenegen.files import make_parent, write_whole
    from scenegen.terminal.progress import note
    from scenegen.terminal.show import say
    from scenegen.view.look import looks, spread
    from scenegen.view.page import check_grid, page

    found = Dataset(locate(dataset, shown=not quiet), partial=True)
    check_grid(found.grid)
    shown, notes = looks(found, split, indices or spread(found, split, count), more(found) if more else None)
    content = page(shown, title=printable(f"{found.folder.name}: {found.manifest.kind}, {split}"), notes=notes)
    make_parent(out)
    write_whole(out, content.encode())
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(shown)} samples, {len(content) / 1e6:.1f} MB; open it in a browser")
