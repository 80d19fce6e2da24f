"""`scenegen render`: pictures of samples, and of worlds."""

from pathlib import Path

import rich_click as click

from scenegen.terminal.options import dataset_argument, out_option, quiet_option, seed_option, split_option

MOST_SHOWN = 64
"""The most samples on a sheet."""
SUFFIXES = (".png", ".pdf", ".svg", ".webp")


@click.command()
@dataset_argument
@split_option("train", help="The split to draw samples of.")
@click.option("--index", "indices", multiple=True, type=click.IntRange(min=0), help="A sample's number; repeatable.")
@click.option("--n", "count", type=click.IntRange(1, MOST_SHOWN), help="A sheet of so many samples, evenly spread.")
@click.option("--flight", is_flag=True, help="With a world: draw a random flight, too.")
@seed_option("What the flight is drawn by.")
@out_option("The picture: .png, .pdf, .svg or .webp.", Path("sample.png"), file=True)
@quiet_option
def render(
    dataset: Path | str,
    split: str,
    indices: tuple[int, ...],
    count: int | None,
    flight: bool,
    seed: int,
    out: Path,
    quiet: bool,
) -> None:
    """Draw a sample of a dataset, a sheet of several, or the world of an MJCF file (.xml)."""
    if out.suffix not in SUFFIXES:
        raise click.UsageError(f"-o {out}: expected a name that ends in {', '.join(SUFFIXES)}")
    is_world = isinstance(dataset, Path) and dataset.suffix == ".xml"
    if flight and not is_world:
        raise click.UsageError("--flight: is for a world, an .xml file")
    if count and indices:
        raise click.UsageError("give --index or --n, not both")
    import importlib.util

    if importlib.util.find_spec("matplotlib") is None:  # before the samples are read
        raise ModuleNotFoundError("matplotlib", name="matplotlib")
    from scenegen.files import make_parent, write_whole
    from scenegen.terminal.progress import note
    from scenegen.terminal.show import say
    from scenegen.view.still import draw_sample, draw_sheet, to_bytes

    notes: list[str] = []
    if is_world:
        import numpy as np

        from scenegen.errors import printable
        from scenegen.single import poses_in_flight, read_world
        from scenegen.view.landscape import draw_world

        world = read_world(Path(dataset))
        places = np.stack([pose.position for pose in poses_in_flight(world, seed=seed)]) if flight else None
        figure = draw_world(world, title=_plain(printable(Path(dataset).name)), flight=places)
    else:
        from scenegen.dataset.locate import locate
        from scenegen.dataset.read import Dataset
        from scenegen.view.look import looks, spread

        found = Dataset(locate(dataset, shown=not quiet), partial=True)
        shown, notes = looks(found, split, indices or (spread(found, split, count) if count else (0,)))
        title = _plain(f"{found.folder.name}: {found.manifest.kind}")
        alone = len(shown) == 1 and not count
        figure = draw_sample(shown[0], title=f"{title}, {shown[0].name}") if alone else draw_sheet(shown, title=title)
    content = to_bytes(figure, out.suffix)
    make_parent(out)
    write_whole(out, content)
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(content) / 1e3:.0f} KB")


def _plain(text: str) -> str:
    """`text` as matplotlib shows it: a dollar sign would begin mathematics."""
    return text.replace("$", r"\$")
