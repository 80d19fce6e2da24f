"""`scenegen inspect`, `view` and `render`: what something is and how it looks, with what methods
say of it."""

from collections.abc import Callable, Sequence
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.cli import inspect as inspecting
from scenegen.cli import view as viewing
from scenegen.cli.inspect import inspect_options
from scenegen.cli.render import draw, render_options
from scenegen.cli.view import view_options
from scenegen.model.commands.weights import Weights

if TYPE_CHECKING:
    from scenegen.dataset.read import Dataset
    from scenegen.display.look import Guesses

MOST_TRIAL = 10_000


def shown_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options of `chosen`, by its parameters' names."""
    options = (
        click.option(
            "--predictions",
            type=click.Path(path_type=Path),
            help="An HDF5 file of predictions of the split, as `complete` writes: shown beside "
            "the truth.",
        ),
        click.option(
            "--weights",
            type=Weights(),
            multiple=True,
            help="A network that completes what is shown, as for `complete`; repeatable.",
        ),
        click.option(
            "--trial",
            type=click.IntRange(0, MOST_TRIAL),
            default=0,
            show_default=True,
            help="Which of the bench's goals in the sample paths lead to.",
        ),
        click.option("--no-paths", is_flag=True, help="Plan no paths on what is predicted."),
    )
    return reduce(lambda made, option: option(made), reversed(options), function)


def chosen(
    dataset: "Dataset",
    split: str,
    predictions: Path | None,
    weights: Sequence[str],
    trial: int,
    no_paths: bool,
) -> "tuple[Guesses | None, tuple[str, ...]]":
    """Who predicts samples of `dataset`, and what they are called. Raises ScenegenError for
    predictions that do not fit `split`, and for networks that are not there."""
    if not weights and predictions is None:
        return None, ()
    from scenegen.model.commands.bench import network_row, one_name_each
    from scenegen.model.evaluation.config import BenchConfig
    from scenegen.model.evaluation.methods import Method
    from scenegen.model.evaluation.shown import guesses_of

    methods: list[Method] = [network_row(name) for name in weights]
    if predictions is not None:
        from scenegen.model.evaluation.methods import Predicted

        methods.append(predicted := Predicted(predictions))
        predicted.check(dataset, split)
    names = one_name_each(methods)
    return guesses_of(methods, BenchConfig(), None if no_paths else trial), names


@click.command()
@inspect_options
def inspect(dataset: Path | str, as_json: bool, **options: Any) -> None:
    """Print what is in a dataset: counts, sizes, and statistics of scans and truth.

    A folder of datasets is listed; of a world (.xml), a scan, a file of predictions (.h5), or a
    run's folder, it says what it is.
    """
    inspecting.show(dataset, as_json=as_json, others=_described, misfit=_misfit, **options)


def _described(path: Path) -> dict[str, Any] | None:
    from scenegen.model.completion.points import READERS

    if path.suffix in READERS:
        from scenegen.model.facts import scan_facts

        return scan_facts(path)
    if path.suffix == ".h5":
        from scenegen.model.facts import prediction_facts

        return prediction_facts(path)
    if (path / "metrics.csv").is_file():
        from scenegen.model.facts import run_facts

        return run_facts(path)
    return None


def _misfit(grid: Any) -> list[str]:
    from scenegen.model.config import NetworkConfig

    try:
        NetworkConfig(height=grid.shape[2]).check_map(grid.shape)
    except ValueError as error:
        return [str(error)]
    return []


@click.command()
@view_options
@shown_options
def view(
    predictions: Path | None, weights: tuple[str, ...], trial: int, no_paths: bool, **options: Any
) -> None:
    """Show a dataset in a browser, from this machine; or, with --html, write one file that shows
    some of it."""
    split = options["split"]
    viewing.show(
        **options,
        guesses=lambda dataset: chosen(dataset, split, predictions, weights, trial, no_paths),
        predicted=predictions is not None,
    )


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
        others=_drawn,
    )


def _drawn(path: Path) -> Any:
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
        from scenegen.model.training.card import draw as draw_curve
        from scenegen.model.training.card import read_rows

        return draw_curve(read_rows(path / "metrics.csv"), title=plain(path.resolve().name))
    return None
