"""What `scenegen render` does; the command itself stands where predictions, scans and runs are
known."""

import importlib.util
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.cli.options import out_option, quiet_option, seed_option, split_option
from scenegen.cli.types import DatasetPath

if TYPE_CHECKING:
    from scenegen.dataset.read import Dataset
    from scenegen.display.look import Guesses

MOST_SHOWN = 64
"""The most samples on a sheet."""
SUFFIXES = (".png", ".pdf", ".svg", ".webp")
FIGURES = ("sample", "world", "completions", "distances", "paths", "example")


def render_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options of `draw`."""
    options = (
        click.argument("source", type=DatasetPath()),
        split_option("train", help="The split to draw samples of."),
        click.option(
            *("--index", "indices"),
            multiple=True,
            type=click.IntRange(min=0),
            help="A sample's number; repeatable.",
        ),
        click.option(
            *("--sheet", "--n", "count"),
            type=click.IntRange(1, MOST_SHOWN),
            help="So many samples on one sheet, evenly spread.",
        ),
        click.option(
            "--figure",
            type=click.Choice(FIGURES),
            help="What to draw of samples; docs/look.md shows each.  [default: sample, or "
            "completions with --weights]",
        ),
        click.option(
            "--turn", is_flag=True, help="A turntable of one sample, as an animated .webp."
        ),
        click.option("--flight", is_flag=True, help="With a world: draw a random flight, too."),
        seed_option("What the flight is drawn by."),
        out_option("The picture: .png, .pdf, .svg or .webp.  [default: sample.png]", file=True),
        quiet_option,
    )
    return reduce(lambda made, option: option(made), reversed(options), function)


def draw(
    source: Path | str,
    split: str,
    indices: tuple[int, ...],
    count: int | None,
    figure: str | None,
    turn: bool,
    flight: bool,
    seed: int,
    out: Path | None,
    quiet: bool,
    guesses: "Callable[[Dataset], tuple[Guesses | None, tuple[str, ...]]]",
    others: Callable[[Path], Any],
) -> None:
    """Draw what `source` is into `out`: a dataset's samples, with what `guesses` has of them; a
    world, .xml; or what `others` makes a figure of, which gives None for what it does not know."""
    out = out or Path("sample.webp" if turn else "sample.png")
    if out.suffix not in (SUFFIXES[-1:] if turn else SUFFIXES):
        raise click.UsageError(
            f"-o {out}: expected a name that ends in {'.webp' if turn else ', '.join(SUFFIXES)}"
        )
    is_world = isinstance(source, Path) and source.suffix == ".xml"
    if flight and not is_world:
        raise click.UsageError("--flight: is for a world, an .xml file")
    if count and indices:
        raise click.UsageError("give --index or --sheet, not both")
    if turn and (count or len(indices) > 1 or figure):
        raise click.UsageError("--turn: shows one sample, without --sheet and --figure")
    if importlib.util.find_spec("matplotlib") is None:  # before the samples are read
        raise ModuleNotFoundError("matplotlib", name="matplotlib")
    from scenegen.cli.progress import note
    from scenegen.cli.show import say
    from scenegen.display.panels import to_bytes
    from scenegen.files import check_ours, write_result

    check_ours(out)
    notes: list[str] = []
    if is_world:
        made = _world(Path(source), seed if flight else None)
    elif isinstance(source, str) or (made := others(source)) is None:
        made, notes = _samples(source, split, indices, count, figure, turn, quiet, guesses)
    content = made if isinstance(made, bytes) else to_bytes(made, out.suffix)
    write_result(out, content)
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(content) / 1e3:.0f} KB")


def _world(path: Path, seed: int | None) -> Any:
    import numpy as np

    from scenegen.display.panels import plain
    from scenegen.display.pictures import draw_world
    from scenegen.source import read_world
    from scenegen.worlds.flight import poses_in_flight

    world = read_world(path)
    flight = (
        None
        if seed is None
        else np.stack([pose.position for pose in poses_in_flight(world, seed=seed)])
    )
    return draw_world(world, title=plain(path.name), flight=flight)


def _samples(
    source: Path | str,
    split: str,
    indices: tuple[int, ...],
    count: int | None,
    figure: str | None,
    turn: bool,
    quiet: bool,
    guesses: Any,
) -> tuple[Any, list[str]]:
    """The picture of a dataset's samples, and a line for each thing that could not be read."""
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset
    from scenegen.display.figures import FIGURES as DRAWN
    from scenegen.display.look import looks, spread
    from scenegen.display.panels import plain
    from scenegen.display.pictures import draw_sample, draw_sheet, draw_turn

    found = Dataset(locate(source, shown=not quiet), partial=True)
    guess, methods = (
        guesses(found) if figure not in ("sample", "world") and not turn else (None, ())
    )
    figure = figure or ("completions" if methods else "sample")
    numbers = indices or (spread(found, split, count) if count else (0,))
    shown, notes = looks(found, split, numbers, guess)
    title = plain(f"{found.folder.name}: {found.manifest.kind}")
    alone = len(shown) == 1 and not count
    told = f"{title}, {shown[0].name}" if alone else title
    if turn:
        return draw_turn(shown[0], title=told), notes
    if figure == "world":
        return _archived(found, split, numbers[0], told), notes
    if figure == "sample":
        return draw_sample(shown[0], title=told) if alone else draw_sheet(shown, title=told), notes
    return DRAWN[figure](shown, title=told), notes


def _archived(found: "Dataset", split: str, index: int, title: str) -> Any:
    """The world that a sample is of, with the map's box, and all viewpoints in it."""
    import numpy as np

    from scenegen.dataset.extract import compile_archived
    from scenegen.display.pictures import draw_world

    samples = found.split(split)
    sample = samples[index]
    number = int(sample.world)
    same = [n for n, (_, world, _) in enumerate(samples.names) if world == number][:MOST_SHOWN]
    places = np.stack([samples[n].position for n in same])
    box = sample.origin, sample.origin + found.grid.extent_m
    return draw_world(compile_archived(found, split, number), title=title, places=places, box=box)
