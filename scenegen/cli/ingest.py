"""`scenegen ingest`: the log of a real sensor becomes maps to make datasets in."""

import json
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.options import (
    command,
    group,
    options_of,
    out_option,
    printing,
)
from scenegen.cli.show import Progress, show_table
from scenegen.cli.types import FILE
from scenegen.errors import raised_as
from scenegen.logs import Fusing


@command(
    "ingest dataset/sequences/07 -o data/kitti-07",
    "ingest drive.mcap --deskew -o data/drive",
    "ingest clouds --poses poses.tum -o data/walk",
)
@click.argument("log", type=FILE)
@click.option(
    "--poses",
    type=FILE,
    help="The poses of a folder of clouds: KITTI's matrices, TUM's lines, or CSV.",
)
@click.option("--topic", help="The clouds of an .mcap file that has several.")
@options_of(
    Fusing,
    voxel_m="Edge of the maps' voxels, metres.",
    reach_m="How far rays are followed, metres.",
    rise_m="How far maps go above and below the sensor, metres.",
    least_m="Nearer returns are left out, metres.",
    moved_share="A voxel is free where fewer of the scans that say something of it have a return "
    "in it.",
    every="Every so many scans, one is kept beside the truth.",
    deskew="Move points to where their rays met something, by the time of each: for raw scans.",
)
@out_option("The folder to write, a new one.")
@printing
@group("Log", "poses topic deskew")
@group("Maps", "voxel reach rise least moved-share")
def ingest(
    log: Path,
    poses: Path | None,
    topic: str | None,
    out: Path | None,
    as_json: bool,
    talk: bool,
    **options: Any,
) -> None:
    """Make maps of a log of LiDAR scans with poses, and keep some of its scans beside them.

    A log is a sequence in KITTI's odometry layout (SemanticKITTI's, too), an .mcap file of ROS 2
    with PointCloud2 or Livox's CustomMsg and /tf or odometry, or a folder of clouds with --poses.
    Stopped or killed, the same command goes on.
    """
    from scenegen.files import check_free
    from scenegen.logs.fuse import ingest as write
    from scenegen.logs.read import read_log

    target = out or Path(f"{log.stem}-maps")
    with raised_as(click.UsageError):
        how = Fusing(**options)
    check_free(target)
    found = read_log(log, poses=poses, topic=topic)
    with Progress("ingest", shown=talk) as progress:
        progress.start(len(found.poses))
        counts = write(found, target, how, on_scan=progress.count)
    if as_json:
        print(json.dumps({"folder": str(target), **counts}))
    elif talk:
        show_table({**counts, "next": f"scenegen generate --scene {target}"})
