"""`scenegen render`: pictures of what there is: samples, predictions, worlds, scans, runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.parameters import Bounds
from scenegen.base.errors import short
from scenegen.base.paths import DATA, function_for, type_of
from scenegen.cli.bench import chosen, shown_options
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
from scenegen.cli.show import note, say
from scenegen.cli.types import Choice, DatasetPath, Number, Written

if TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset


MAX_SHOWN = 64
"""The most samples on a sheet."""
SUFFIXES = (".png", ".pdf", ".svg", ".webp")
FILMS = (".webp", ".gif")
COLUMNS_MM = {"one": "88", "two": "180"}
"""Widths of columns of a paper, as most journals have them."""
MIN_WIDTH = 140 / 25.4
"""The narrowest picture for print of anything but samples, inches."""
FIGURES = ("sample", "world", "completions", "distances", "paths", "example")


def _width(text: str) -> float:
    """A width in inches."""
    try:
        return Number(Bounds(least=40, most=1000)).read(COLUMNS_MM.get(text, text)) / 25.4
    except ValueError:
        raise ValueError(f"{short(text)}: expected one, two, or 40 to 1000 millimetres") from None


@command(
    "render data/pillar --index 3 -o sample.png",
    "render data/pillar --index 3 --weights columns --paper two -o figure.pdf",
    "render data/pillar --index 3 --flight -o flight.gif",
    "render data/pillar --split test --sheet 12 --weights columns -o sheet.pdf",
    "render scenes/forest.xml --flight -o forest.png",
)
@click.argument("source", type=DatasetPath())
@split_option("train", help="The split to draw samples of.")
@index_option
@click.option(
    "--sheet",
    "--n",
    "count",
    type=click.IntRange(1, MAX_SHOWN),
    help="So many samples on one sheet, evenly spread.",
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
    "that --index is of.",
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
    help="With --paper: the size of its letters, points.",
)
@columns_option
@seed_option("Seed of the flight.")
@out_option("The picture: .png, .pdf, .svg or .webp.  [default: sample.png]", file=True)
@quiet_option
@shown_options
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
    """Draw samples of a dataset, and what is predicted of them.

    Or a world (.xml), a scan, a completion of one (.h5), a run's curve from its folder.
    """
    name = type_of(source)
    is_world = name in ("world", "mesh")
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
            source, shown=not quiet, film=film, suffix=out.suffix, **options
        )
    else:
        if (options["paper"] or MIN_WIDTH) < MIN_WIDTH:
            raise click.UsageError(
                "--paper: only samples fit into less than 140 mm; give two, or more"
            )
        given: dict[str, Any] = {}
        if is_world:
            given = {"seed": seed if flight else None}
        elif name == "scan":
            given = {"columns": columns} | ({} if quiet else {"report": note})
        figure = function_for(source, "draws")(Path(source), **given)
    if options["paper"]:
        for_paper(figure, options["paper"], font_size)
    content = figure if isinstance(figure, bytes) else to_bytes(figure, out.suffix)
    write_result(out, content)
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(content) / 1e3:.0f} KB")


def _draw_samples(
    source: Path | str,
    *,
    shown: bool,
    split: str,
    indices: tuple[int, ...],
    count: int | None,
    figure: str | None,
    film: str,
    suffix: str,
    paper: float | None,
    **predicted: Any,
) -> tuple[Any, list[str]]:
    """The picture of a dataset's samples, and a line for each thing that could not be read."""
    from scenegen.view.figures import FIGURES as DRAWN
    from scenegen.view.look import evenly, looks, title_of
    from scenegen.view.panels import plain
    from scenegen.view.pictures import draw_flight, draw_sample, draw_sheet, draw_turn

    dataset = open_dataset(source, shown=shown)
    bare = figure in ("sample", "world") or film
    guesses, methods = (None, ()) if bare else chosen(dataset, split, **predicted)
    figure = figure or ("completions" if methods else "sample")
    numbers = indices or (evenly(len(dataset.split(split)), count) if count else (0,))
    if film == "flight":
        numbers = _same_world(dataset, split, numbers[0])
    looked, notes = looks(dataset, split, numbers, guesses)
    title = plain(title_of(dataset))
    alone = len(looked) == 1 and not count
    heading = "" if paper else f"{title}, {looked[0].name}" if alone else title
    if film == "turn":
        return draw_turn(looked[0], title=heading, suffix=suffix), notes
    if film == "flight":
        return draw_flight(looked, title=title, suffix=suffix), notes
    if figure == "world":
        return _draw_archived(dataset, split, numbers[0], heading), notes
    if figure == "sample" and alone:
        return draw_sample(looked[0], title=heading, width=paper), notes
    draw = draw_sheet if figure == "sample" else DRAWN[figure]
    return draw(looked, title=heading, width=paper), notes


def _same_world(found: "AnyDataset", split: str, index: int) -> list[int]:
    """The samples of a sample's world, in order, as many as are shown."""
    names = found.split(split).names
    return [n for n, (_, world, _) in enumerate(names) if world == names[index][1]][:MAX_SHOWN]


def _draw_archived(found: "AnyDataset", split: str, index: int, title: str) -> Any:
    """The world that a sample is of, with the map's box, and all viewpoints in it."""
    import numpy as np

    from scenegen.view.pictures import draw_world
    from scenegen.worlds.world import solid

    samples = found.split(split)
    sample = samples[index]
    places = np.stack([samples[n].position for n in _same_world(found, split, index)])
    box = sample.origin, sample.origin + found.grid.extent_m
    world = solid(found.compile(split, int(sample.world)), title)
    return draw_world(world, title=title, places=places, box=box)
