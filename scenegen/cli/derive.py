"""`scenegen rescan`, `take` and `merge`: datasets made of what others hold. Given again after a
stop, each goes on where it was."""

from pathlib import Path
from typing import Any

import rich_click as click

from scenegen import SPLITS
from scenegen.cli.generate import make
from scenegen.cli.options import (
    command,
    dataset_argument,
    datasets_argument,
    engine_option,
    force_option,
    group,
    lidar_option,
    mapping_given,
    mapping_options,
    noise_option,
    on_option,
    open_dataset,
    out_option,
    printing,
    splits_option,
    together,
    without,
    workers_option,
)
from scenegen.cli.show import announce_compilation
from scenegen.cli.types import Written, read_ranges
from scenegen.dataset.choose import MEASURES, NUMBERS, Choice, Condition
from scenegen.worlds.mapping import Mapper

making = together(
    out_option("Folder of the new dataset, or s3://bucket/folder.", stores=True, required=True),
    *(force_option, workers_option, on_option, printing),
)
"""Options of all that make a dataset of others."""


@command(
    "rescan data/pillar --lidar livox-mid-360 -o data/livox",
    "rescan data/pillar --noise range:0.02 --scans 5 -o data/noisy",
)
@dataset_argument
@lidar_option("the dataset's")
@noise_option
@mapping_options("the dataset's")
@engine_option("What casts the rays.  [default: what cast the dataset's]")
@making
def rescan(
    dataset: Path | str,
    lidar: str | None,
    noise: str | None,
    engine: str | None,
    out: Path,
    talk: bool,
    **options: Any,
) -> None:
    """Scan the worlds of a dataset again, from the same poses: a pair, sample by sample.

    What is not said of the sensor and of maps is as in the dataset, but for noise. Given again
    after a stop, it goes on where it was.
    """
    if talk:
        announce_compilation()
    from scenegen.dataset.rescan import plan_rescan
    from scenegen.tables import named_lidar, named_noise

    source = open_dataset(dataset, shown=talk, partial=False)
    sensor = None if lidar is None else named_lidar(lidar)
    chain = named_noise(noise, sensor or source.lidar)
    mapping = mapping_given(options)
    plan = plan_rescan(source, out, lidar=sensor, chain=chain, engine=engine, mapping=mapping)
    make(plan, talk=talk, **without(Mapper, options))


@command(
    "take data/mixed --kind rooms --n 500 -o data/rooms",
    "take data/pillar --split train --where 'occupied>=0.05' -o data/dense",
)
@dataset_argument
@splits_option("Samples of this split")
@click.option(
    "-n", "--n", "most", type=click.IntRange(min=1), help="The first so many of each split."
)
@click.option(
    "--kind",
    "kinds",
    multiple=True,
    metavar="KIND",
    help="Samples of this kind of worlds alone, such as maze, or maze-hard; repeatable.",
)
@click.option(
    "--worlds",
    type=Written(read_ranges, "N,FIRST:STOP"),
    default=(),
    help="Samples of these worlds alone: numbers, or FIRST:STOP, as in 3,10:20.",
)
@click.option(
    "--where",
    multiple=True,
    type=Written(Condition.of, "NAME>=VALUE"),
    help="Samples for which this holds, in quotes: 'occupied>=0.05'; repeatable. Names are "
    f"{', '.join((*NUMBERS, *MEASURES))}.",
)
@making
@group("Which samples", "split n kind worlds where")
def take(
    dataset: Path | str,
    splits: tuple[str, ...],
    most: int | None,
    kinds: tuple[str, ...],
    worlds: Any,
    where: Any,
    out: Path,
    **options: Any,
) -> None:
    """Make a dataset of some samples of another: of a split, of some worlds, or of those that a
    filter lets through.

    Samples stay as they are, bit for bit, and the manifest says where they are from. Given again
    after a stop, it goes on where it was.
    """
    from scenegen.dataset.gather import plan_take

    chosen = tuple(split for split in SPLITS if split in splits) or SPLITS
    choice = Choice(splits=chosen, most=most, kinds=kinds, worlds=worlds, where=where)
    source = open_dataset(dataset, shown=options["talk"], partial=False)
    make(plan_take(source, out, choice, workers=options["workers"]), **options)


@command("merge data/pillar data/geometric -o data/both")
@datasets_argument
@making
def merge(datasets: tuple[Path | str, ...], out: Path, **options: Any) -> None:
    """Make one dataset of several that share grid and labels.

    Samples stay as they are, bit for bit, and in their splits; the manifest says where they are
    from. Given again after a stop, it goes on where it was.
    """
    if len(datasets) < 2:
        raise click.UsageError("give two datasets or more, and the folder of the new one with -o")
    from scenegen.dataset.gather import plan_merge

    sources = [open_dataset(one, shown=options["talk"], partial=False) for one in datasets]
    make(plan_merge(sources, out, workers=options["workers"]), **options)
