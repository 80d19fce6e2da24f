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


MAX_ON_SHEET = 64
"""Maximum samples on a sheet, and of a flight in a film."""
SUFFIXES = (".png", ".pdf", ".svg", ".webp")
"""Suffixes of pictures."""
FILMS = (".webp", ".gif")
"""Suffixes of animated pictures."""
COLUMNS_MM = {"one": "88", "two": "180"}
"""Widths of one and two columns in most journals, millimetres."""
MIN_WIDTH = 140 / 25.4
"""Minimum width for print of anything but samples, inches."""
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
    "render data/pillar --index 3 --flight -o flight.gif",
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
@click.option("--turn", is_flag=True, help="A turntable of one sample, as a .webp or .gif.")
@click.option(
    "--flight",
    is_flag=True,
    help="With a world: draw a random flight, too. With a dataset: a .gif or .webp of the flight "
    "of the sample --index.",
)
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
@group("What is drawn", "split index sheet figure turn flight columns")
@group("For print", "paper font-size")
def render(
    source: Path | str,
    flight: bool,
    seed: int,
    out: Path | None,
    quiet: bool,
    font_size: float,
    columns: int | None,
    **options: Any,
) -> None:
    """Draw samples of a dataset, with predictions.

    Or draw a world (.xml), a scan, the completion of a scan (.h5), or the curves of a training run.

    \f
    Raises:
        UsageError: Options contradict each other.
        ScenegenError: The file or dataset cannot be read or drawn.
    """
    name = type_of(source)
    is_world = name in ("world", "mesh")
    # for a world, --flight draws a path; for samples, it makes a film
    film = "turn" if options.pop("turn") else "flight" if flight and not is_world else ""
    suffixes = FILMS if film else SUFFIXES
    out = out or Path("sample.webp" if film else "sample.png")
    if out.suffix not in suffixes:
        raise click.UsageError(f"-o {out}: expected a name that ends in {', '.join(suffixes)}")
    if options["count"] and options["indices"]:
        raise click.UsageError("give --index or --sheet, not both")
    if film and (
        options["count"] or len(options["indices"]) > 1 or options["figure"] or options["paper"]
    ):
        raise click.UsageError(
            f"--{film}: shows one sample or flight, without --sheet, --figure and --paper"
        )
    from scenegen.base.files import write_result
    from scenegen.view.panels import for_paper, to_bytes

    notes: list[str] = []
    if name in (None, *DATA):
        figure, notes = _draw_samples(
            source, progress=not quiet, film=film, suffix=out.suffix, **options
        )
    else:
        if (options["paper"] or MIN_WIDTH) < MIN_WIDTH:
            raise click.UsageError(
                "--paper: only samples fit into less than 140 mm; give two, or more"
            )
        settings: dict[str, Any] = {}
        if is_world:
            settings = {"seed": seed if flight else None}
        elif name == "scan":
            settings = {"columns": columns} | ({} if quiet else {"report": info})
        figure = function_for(source, "draws")(Path(source), **settings)
    if options["paper"]:
        for_paper(figure, options["paper"], font_size)
    # films are bytes already
    content = figure if isinstance(figure, bytes) else to_bytes(figure, out.suffix)
    write_result(out, content)
    for line in notes:
        info(line)
    if not quiet:
        echo(f"{out}: {len(content) / 1e3:.0f} KB")


def _draw_samples(
    source: Path | str,
    *,
    progress: bool,
    split: str,
    indices: tuple[int, ...],
    count: int | None,
    figure: str | None,
    film: str,
    suffix: str,
    paper: float | None,
    **predicted: Any,
) -> tuple[Any, list[str]]:
    """Draw samples of a dataset; return the figure, or a film's content, and a line for each part
    that could not be read."""
    from scenegen.view.figures import FIGURES as DRAWN
    from scenegen.view.look import evenly, looks, title_of
    from scenegen.view.panels import plain
    from scenegen.view.pictures import draw_flight, draw_sample, draw_sheet, draw_turn

    dataset = open_dataset(source, show_progress=progress)
    # figures without predictions load no network
    bare = figure in ("sample", "world") or film
    guesses, methods = (None, ()) if bare else chosen(dataset, split, **predicted)
    figure = figure or ("completions" if methods else "sample")
    # without --index and --sheet, the first sample
    numbers = indices or (evenly(len(dataset.split(split)), count) if count else (0,))
    if film == "flight":
        numbers = _same_world(dataset, split, numbers[0])
    looked, notes = looks(dataset, split, numbers, guesses)
    title = plain(title_of(dataset))
    is_single = len(looked) == 1 and not count
    # print has captions, so no title
    heading = "" if paper else f"{title}, {looked[0].name}" if is_single else title
    if film == "turn":
        return draw_turn(looked[0], title=heading, suffix=suffix), notes
    if film == "flight":
        return draw_flight(looked, title=title, suffix=suffix), notes
    if figure == "world":
        return _draw_archived(dataset, split, numbers[0], heading), notes
    # a single sample has room for levels of its distances
    if figure == "sample" and is_single:
        return draw_sample(looked[0], title=heading, width=paper), notes
    draw = draw_sheet if figure == "sample" else DRAWN[figure]
    return draw(looked, title=heading, width=paper), notes


def _same_world(dataset: "AnyDataset", split: str, index: int) -> list[int]:
    """Return the samples of a sample's world, in order, up to `MAX_ON_SHEET`."""
    names = dataset.split(split).names
    return [n for n, (_, world, _) in enumerate(names) if world == names[index][1]][:MAX_ON_SHEET]


def _draw_archived(dataset: "AnyDataset", split: str, index: int, title: str) -> Any:
    """Draw the world of a sample, with the map's box and all viewpoints of the world."""
    import numpy as np

    from scenegen.view.pictures import draw_world
    from scenegen.worlds.world import solid

    samples = dataset.split(split)
    sample = samples[index]
    places = np.stack([samples[n].position for n in _same_world(dataset, split, index)])
    box = sample.origin, sample.origin + dataset.grid.extent_m
    world = solid(dataset.compile(split, int(sample.world)), title)
    return draw_world(world, title=title, places=places, box=box)
