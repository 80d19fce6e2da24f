"""`scenegen render`: pictures of what there is: samples, predictions, worlds, scans, runs."""

from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.render import draw, render_options
from scenegen.model.commands.shown import chosen, shown_options


@click.command()
@render_options
@shown_options
def render(
    predictions: Path | None, weights: tuple[str, ...], trial: int, no_paths: bool, **options: Any
) -> None:
    """Draw samples of a dataset, and what is predicted of them.

    Or a world (.xml), a scan, a completion of one (.h5), a run's curve from its folder.
    """
    split = options["split"]
    draw(
        **options,
        guesses=lambda dataset: chosen(dataset, split, predictions, weights, trial, no_paths),
        others=_others,
    )


def _others(path: Path) -> Any:
    """The figure of a scan, a completion of one, or a run; None for anything else."""
    from scenegen.display.panels import plain
    from scenegen.model.completion.points import READERS, read_points

    if path.suffix in READERS:
        from scenegen.display.pictures import draw_cloud

        return draw_cloud(read_points(path), title=plain(path.name))
    if path.suffix == ".h5":
        from scenegen.display.pictures import draw_completion
        from scenegen.model.completion.predictions import read_completion

        return draw_completion(read_completion(path), title=plain(path.name))
    if (path / "metrics.csv").is_file():
        from scenegen.model.training.curve import draw as draw_curve
        from scenegen.model.training.curve import read_rows

        return draw_curve(read_rows(path / "metrics.csv"), title=plain(path.resolve().name))
    return None
