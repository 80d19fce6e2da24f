"""`scenegen render`: pictures of samples, predictions, worlds, scans and training runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.parameters import Bounds, short_repr
from scenegen.base.paths import DATA, function_for, type_of
from scenegen.cli.bench import chosen, prediction_options
from scenegen.cli.options import (
    columns_option,
    command,
    group,
    index_option,
    open_dataset,
    out_option,
    quiet_option,
    seed_option,
    split_option,
)
from scenegen.cli.show import echo, info
from scenegen.cli.types import Choice, DatasetPath, Number, Written

if TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset
    from scenegen.view.canvas import Paper


MAX_ON_SHEET = 64
"""Maximum samples on a sheet."""
SUFFIXES = (".png", ".pdf", ".svg", ".webp")
"""Suffixes of pictures."""
COLUMNS_MM = {"one": "88", "two": "180"}
"""Widths of one and two columns in most journals, millimetres."""
FIGURES = ("sample", "world", "completions", "distances", "paths", "example")
"""Values of --figure."""


def _width(text: str) -> float:
    """Parse a width; return inches."""
    try:
        return Number(Bounds(minimum=40, maximum=1000)).read(COLUMNS_MM.get(text, text)) / 25.4
    except ValueError:
        raise ValueError(
            f"{short_repr(text)}: expected one, two, or 40 to 1000 millimetres"
        ) from None


@command(
    "render data/pillar --index 3 -o sample.png",
    "render data/pillar --index 3 --weights columns --paper two -o figure.pdf",
    "render data/pillar --split test --sheet 12 --weights columns -o sheet.pdf",
    "render scenes/forest.xml --flight -o forest.png",
)
@click.argument("source", type=DatasetPath())
@split_option("train", help="Split of the samples.")
@index_option
@click.option(
    "--sheet",
    "--n",
    "count",
    type=click.IntRange(1, MAX_ON_SHEET),
    help="Draw so many samples on one sheet, evenly spread.",
)
@click.option(
    "--figure",
    type=Choice(FIGURES),
    help="What to draw of samples; docs/look.md shows each.  [default: sample, or completions "
    "with --weights]",
)
@click.option("--flight", is_flag=True, help="With a world: draw a random flight, too.")
@click.option(
    "--paper",
    type=Written(_width, "width"),
    metavar="one|two|MM",
    help="For print, as wide as one or two columns (88, 180) or so many millimetres (40 to 1000): "
    "no title, letters of one size; .pdf and .svg keep them as letters.",
)
@click.option(
    "--font-size",
    type=click.FloatRange(4, 20),
    default=7.0,
    help="With --paper: size of letters, points.",
)
@columns_option
@seed_option("Seed of the flight.")
@out_option("The picture: .png, .pdf, .svg or .webp.  [default: sample.png]", file=True)
@quiet_option
@prediction_options
@group("What is drawn", "split index sheet figure flight columns")
@group("For print", "paper font-size")
def render(
    source: Path | str,
    flight: bool,
    seed: int,
    out: Path | None,
    quiet: bool,
    paper: float | None,
    font_size: float,
    columns: int | None,
    **options: Any,
) -> None:
    """Draw samples of a dataset, with predictions.

    Or draw a world (.xml), a map, a scan, the completion of a scan (.h5), or the curves of a
    training run.

    \f
    Raises:
        UsageError: Options contradict each other.
        ScenegenError: The file or dataset cannot be read or drawn.
    """
    name = type_of(source)
    is_world = name in ("world", "mesh")
    out = out or Path("sample.png")
    if out.suffix not in SUFFIXES:
        raise click.UsageError(f"-o {out}: expected a name that ends in {', '.join(SUFFIXES)}")
    if options["count"] and options["indices"]:
        raise click.UsageError("give --index or --sheet, not both")
    from scenegen.base.files import write_result
    from scenegen.view.canvas import SCREEN, Paper
    from scenegen.view.stills import draw, to_bytes

    size = Paper(paper, font_size) if paper else SCREEN
    notes: list[str] = []
    if flight and not is_world:
        raise click.UsageError("--flight: draws a flight in a world (.xml or a mesh)")
    if name in (None, *DATA):
        figure, notes = _draw_samples(source, progress=not quiet, paper=size, **options)
    elif name == "run":
        figure = function_for(source, "draws")(Path(source), paper=size)
    else:
        reading = {"columns": columns} if name == "scan" else {}
        looks = function_for(source, "shows")(Path(source), **reading)
        notes = [line for look in looks for line in look.missing]
        if flight:
            looks = [_with_flight(look, Path(source), seed) for look in looks]
        figure = draw(looks, "paths" if flight else "", title=Path(source).name, paper=size)
    content = to_bytes(figure, out.suffix)
    write_result(out, content)
    if not quiet:
        for line in notes:
            info(line)
        echo(f"{out}: {len(content) / 1e3:.0f} KB")


def _draw_samples(
    source: Path | str,
    *,
    progress: bool,
    split: str,
    indices: tuple[int, ...],
    count: int | None,
    figure: str | None,
    paper: "Paper",
    **predicted: Any,
) -> tuple[Any, list[str]]:
    """Draw samples of a dataset; return the figure, and a line for each part that could not be
    read."""
    from scenegen.view.look import evenly, looks, title_of
    from scenegen.view.stills import draw

    dataset = open_dataset(source, show_progress=progress)
    # figures without predictions load no network
    bare = figure in ("sample", "world")
    guesses, methods = (None, ()) if bare else chosen(dataset, split, **predicted)
    # without --index and --sheet, the first sample
    numbers = indices or (evenly(len(dataset.split(split)), count) if count else (0,))
    looked, notes = looks(dataset, split, numbers, guesses)
    title = title_of(dataset)
    if len(looked) == 1:
        title += f", {looked[0].name}"
    if figure == "world":
        return _draw_archived(dataset, split, numbers[0], title, paper)
    figure = figure or ("completions" if methods else "sample")
    return draw(looked, figure, title=title, paper=paper), notes


def _draw_archived(
    dataset: "AnyDataset", split: str, index: int, title: str, paper: "Paper"
) -> tuple[Any, list[str]]:
    """Draw the world of a sample, with the map's box and all viewpoints of the world; return the
    figure, and a line if the world reaches beyond it."""
    import numpy as np

    from scenegen.view.opened import look_of_world
    from scenegen.view.stills import draw, with_path

    samples = dataset.split(split)
    sample, world = samples[index], samples.names[index][1]
    of_world = [n for n, (_, other, _) in enumerate(samples.names) if other == world]
    places = np.stack([samples[n].position for n in of_world[:MAX_ON_SHEET]])
    look = look_of_world(dataset.compile(split, int(sample.world)), title)
    box = sample.origin, sample.origin + dataset.grid.extent_m
    looks = [with_path(look, "flight", places)]
    return draw(looks, "paths", title=title, paper=paper, box=box), list(look.missing)


def _with_flight(look: Any, path: Path, seed: int) -> Any:
    """Add a random flight to the world of a file."""
    import numpy as np

    from scenegen.draw.source import read_world
    from scenegen.view.stills import with_path
    from scenegen.worlds.flight import poses_in_flight
    from scenegen.worlds.world import solid

    poses = poses_in_flight(solid(read_world(path), str(path)), seed=seed)
    return with_path(look, "flight", np.stack([pose.position for pose in poses]))
