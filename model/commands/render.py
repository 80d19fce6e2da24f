"""`scenegen render`: pictures of what there is: samples, predictions, worlds, scans, runs."""

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.cli.options import (
    examples,
    open_dataset,
    out_option,
    quiet_option,
    seed_option,
    split_option,
)
from scenegen.cli.show import note, say
from scenegen.cli.types import DatasetPath
from scenegen.model.commands.shown import chosen, shown_options

if TYPE_CHECKING:
    from scenegen.dataset.read import Dataset

MOST_SHOWN = 64
"""The most samples on a sheet."""
SUFFIXES = (".png", ".pdf", ".svg", ".webp")
FIGURES = ("sample", "world", "completions", "distances", "paths", "example")


@click.command(
    epilog=examples(
        "render data/pillar --index 3 -o sample.png",
        "render data/pillar --split test --sheet 12 --weights columns -o sheet.pdf",
        "render room.xml --flight -o room.png",
    )
)
@click.argument("source", type=DatasetPath())
@split_option("train", help="The split to draw samples of.")
@click.option(
    *("--index", "indices"),
    multiple=True,
    type=click.IntRange(min=0),
    help="A sample's number; repeatable.",
)
@click.option(
    *("--sheet", "--n", "count"),
    type=click.IntRange(1, MOST_SHOWN),
    help="So many samples on one sheet, evenly spread.",
)
@click.option(
    "--figure",
    type=click.Choice(FIGURES),
    help="What to draw of samples; docs/look.md shows each.  [default: sample, or completions "
    "with --weights]",
)
@click.option("--turn", is_flag=True, help="A turntable of one sample, as an animated .webp.")
@click.option("--flight", is_flag=True, help="With a world: draw a random flight, too.")
@seed_option("What the flight is drawn by.")
@out_option("The picture: .png, .pdf, .svg or .webp.  [default: sample.png]", file=True)
@quiet_option
@shown_options
def render(
    source: Path | str, flight: bool, seed: int, out: Path | None, quiet: bool, **options: Any
) -> None:
    """Draw samples of a dataset, and what is predicted of them.

    Or a world (.xml), a scan, a completion of one (.h5), a run's curve from its folder.
    """
    turn = options["turn"]
    suffixes = SUFFIXES[-1:] if turn else SUFFIXES
    out = out or Path("sample.webp" if turn else "sample.png")
    if out.suffix not in suffixes:
        raise click.UsageError(f"-o {out}: expected a name that ends in {', '.join(suffixes)}")
    is_world = isinstance(source, Path) and source.suffix == ".xml"
    if flight and not is_world:
        raise click.UsageError("--flight: is for a world, an .xml file")
    if options["count"] and options["indices"]:
        raise click.UsageError("give --index or --sheet, not both")
    if turn and (options["count"] or len(options["indices"]) > 1 or options["figure"]):
        raise click.UsageError("--turn: shows one sample, without --sheet and --figure")
    if importlib.util.find_spec("matplotlib") is None:  # before the samples are read
        raise ModuleNotFoundError("matplotlib", name="matplotlib")
    from scenegen.display.panels import to_bytes
    from scenegen.files import check_ours, write_result

    check_ours(out)
    notes: list[str] = []
    made = _draw_file(source, seed if flight else None) if isinstance(source, Path) else None
    if made is None:
        made, notes = _draw_samples(source, shown=not quiet, **options)
    content = made if isinstance(made, bytes) else to_bytes(made, out.suffix)
    write_result(out, content)
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(content) / 1e3:.0f} KB")


def _draw_file(path: Path, seed: int | None) -> Any:
    """The figure of a world, a scan, a completion of one, or a run; None for anything else."""
    from scenegen.display import pictures
    from scenegen.display.panels import plain
    from scenegen.logs.clouds import READERS, read_points

    title = plain(path.name)
    if path.suffix == ".xml":
        return _draw_world(path, seed, title)
    if path.suffix in READERS:
        return pictures.draw_cloud(read_points(path), title=title)
    if path.suffix == ".h5":
        from scenegen.model.completion.predictions import read_completion

        return pictures.draw_completion(read_completion(path), title=title)
    if (path / "metrics.csv").is_file():
        from scenegen.model.training.card import draw, read_rows

        return draw(read_rows(path / "metrics.csv"), title=plain(path.resolve().name))
    return None


def _draw_world(path: Path, seed: int | None, title: str) -> Any:
    """A world, and, by a seed, a random flight in it."""
    import numpy as np

    from scenegen.display.pictures import draw_world
    from scenegen.source import read_world
    from scenegen.worlds.flight import poses_in_flight
    from scenegen.worlds.world import solid

    world = solid(read_world(path), str(path))
    poses = [] if seed is None else poses_in_flight(world, seed=seed)
    flight = np.stack([pose.position for pose in poses]) if poses else None
    return draw_world(world, title=title, flight=flight)


def _draw_samples(
    source: Path | str,
    *,
    shown: bool,
    split: str,
    indices: tuple[int, ...],
    count: int | None,
    figure: str | None,
    turn: bool,
    **predicted: Any,
) -> tuple[Any, list[str]]:
    """The picture of a dataset's samples, and a line for each thing that could not be read."""
    from scenegen.display.figures import FIGURES as DRAWN
    from scenegen.display.look import looks, spread
    from scenegen.display.panels import plain
    from scenegen.display.pictures import draw_sample, draw_sheet, draw_turn

    found = open_dataset(source, shown=shown)
    bare = figure in ("sample", "world") or turn
    guesses, methods = (None, ()) if bare else chosen(found, split, **predicted)
    figure = figure or ("completions" if methods else "sample")
    numbers = indices or (spread(found, split, count) if count else (0,))
    seen, notes = looks(found, split, numbers, guesses)
    title = plain(f"{found.folder.name}: {found.manifest.kind}")
    alone = len(seen) == 1 and not count
    told = f"{title}, {seen[0].name}" if alone else title
    if turn:
        return draw_turn(seen[0], title=told), notes
    if figure == "world":
        return _draw_archived(found, split, numbers[0], told), notes
    if figure == "sample":
        return draw_sample(seen[0], title=told) if alone else draw_sheet(seen, title=told), notes
    return DRAWN[figure](seen, title=told), notes


def _draw_archived(found: "Dataset", split: str, index: int, title: str) -> Any:
    """The world that a sample is of, with the map's box, and all viewpoints in it."""
    import numpy as np

    from scenegen.display.pictures import draw_world
    from scenegen.worlds.world import solid

    samples = found.split(split)
    sample = samples[index]
    number = int(sample.world)
    same = [n for n, (_, world, _) in enumerate(samples.names) if world == number][:MOST_SHOWN]
    places = np.stack([samples[n].position for n in same])
    box = sample.origin, sample.origin + found.grid.extent_m
    world = solid(found.compile(split, number), title)
    return draw_world(world, title=title, places=places, box=box)
