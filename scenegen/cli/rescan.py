"""`scenegen rescan`: the worlds and poses of a dataset, seen by another sensor, or with its
faults."""

import json
import time
from pathlib import Path
from typing import Any

import rich_click as click

from lidarsim.engines import ENGINES
from scenegen.cli.generate import show_summary
from scenegen.cli.options import (
    dataset_argument,
    json_option,
    lidar_option,
    mapping_given,
    mapping_options,
    noise_option,
    out_option,
    quiet_option,
    workers_option,
)
from scenegen.cli.progress import Progress, announce_compilation
from scenegen.cli.types import Named


@click.command()
@dataset_argument
@lidar_option("The sensor", "  [default: the dataset's]")
@noise_option
@mapping_options("the dataset's")
@click.option(
    "--engine", type=Named(ENGINES), help="What casts the rays.  [default: what cast the dataset's]"
)
@out_option("Folder of the new dataset, or s3://bucket/folder.", places=True)
@workers_option
@click.option("--force", is_flag=True, help="Replace another dataset in the folder.")
@json_option
@quiet_option
def rescan(
    dataset: Path | str,
    lidar: str | None,
    noise: str | None,
    engine: str | None,
    out: Path | None,
    workers: int,
    force: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Scan the worlds of a dataset again, from the same poses: a pair, sample by sample.

    What is not said of the sensor and of maps is as in the dataset, but for noise. Given again
    after a stop, it goes on where it was.
    """
    if out is None:
        raise click.UsageError("give the new dataset's folder with -o")
    begin = time.perf_counter()
    talk = not (quiet or as_json)
    if talk:
        announce_compilation()
    from scenegen.dataset.build import build
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset
    from scenegen.dataset.rescan import plan_rescan
    from scenegen.lidar import named_lidar, named_noise

    source = Dataset(locate(dataset, shown=talk))
    sensor = None if lidar is None else named_lidar(lidar)
    chain = named_noise(noise, sensor or source.lidar)
    plan = plan_rescan(
        source, out, lidar=sensor, chain=chain, engine=engine, mapping=mapping_given(options)
    )

    def count(report: Any, fresh: bool) -> None:
        progress.count(report.samples)

    with Progress(plan.parameters["kind"], shown=talk) as progress:
        summary = build(
            plan,
            workers=workers,
            force=force,
            on_start=lambda: progress.start(plan.samples),
            on_shard=count,
        )
    if as_json:
        print(
            json.dumps(
                {
                    **vars(summary),
                    "folder": str(summary.folder),
                    "seconds": time.perf_counter() - begin,
                }
            )
        )
    elif talk:
        show_summary(summary, time.perf_counter() - begin)
