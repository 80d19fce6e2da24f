"""`scenegen view`: samples in three dimensions, and what was predicted of them."""

from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.view import show, view_options
from scenegen.model.commands.shown import chosen, shown_options


@click.command()
@view_options
@shown_options
def view(
    predictions: Path | None, weights: tuple[str, ...], trial: int, no_paths: bool, **options: Any
) -> None:
    """Show a dataset in a browser, from this machine; or, with --html, write one file that shows
    some of it."""
    split = options["split"]
    show(
        **options,
        guesses=lambda dataset: chosen(dataset, split, predictions, weights, trial, no_paths),
        predicted=predictions is not None,
    )
