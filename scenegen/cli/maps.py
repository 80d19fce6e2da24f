"""`scenegen map` and `scenegen ingest`: point clouds, and logs of a real sensor, become maps to
make datasets in."""

from pathlib import Path
from shlex import quote
from typing import Any

import rich_click as click

from scenegen.cli.options import (
    columns_option,
    command,
    group,
    log_options,
    options_of,
    out_option,
    printing,
    was_given,
)
from scenegen.cli.show import Progress, Tell, note, plain, show_table
from scenegen.cli.types import FILE, Number
from scenegen.errors import raised_as
from scenegen.logs import Fusing
from scenegen.worlds.cloud import Survey


@command(
    "map hall.pcd -o hall.npz",
    "map drive/*.ply --poses poses.txt --voxel 0.1 -o drive.npz",
    "map tile.laz --assume-free --voxel 0.5 -o tile.npz",
    "map lab.yaml --height 2.5 -o lab.npz",
)
@click.argument("clouds", nargs=-1, required=True, type=FILE)
@click.option("--sensor", type=(Number(),) * 3, help="Where the clouds' sensor was: X Y Z.")
@click.option(
    "--poses",
    type=FILE,
    help="A text file with a line for each cloud: x y z of its sensor; or, for clouds in their "
    "sensor's frame, its pose as TUM or KITTI write it.",
)
@click.option(
    "--box",
    type=(Number(),) * 6,
    help="Leave out what lies beyond these two corners: X Y Z X Y Z.",
)
@columns_option
@options_of(
    Survey,
    voxel_m="Edge of the map's voxels, metres.",
    unit_m="The clouds' unit, metres: 0.001 for millimetres.",
    up="The clouds' axis that points up.",
    least_m="Points nearer than this to the sensor that saw them are no returns, metres.",
    height_m="How high the walls of a plan are, metres.",
    assume_free="Call free what is above the lowest point of a column and holds none, unless a ray "
    "says so already: for clouds of which nobody knows where they were seen from.",
)
@out_option("The map to write, .npz.", ".npz", default="map.npz")
@printing
@group("Clouds", "sensor poses least box columns unit up")
def map(
    clouds: tuple[Path, ...],
    sensor: tuple[float, ...] | None,
    poses: Path | None,
    box: tuple[float, ...] | None,
    columns: int | None,
    out: Path,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Make a map of a real place from point clouds: .ply, .pcd, .las, .laz, .bin, .xyz, .npz, .npy;
    or from one of ROS's plans of a floor, .yaml.

    Voxels with points are occupied, those that rays from the sensor crossed are free, and all
    others unknown. `scenegen generate --scene` takes the map.
    """
    if sensor is not None and poses is not None:
        raise click.UsageError("--sensor and --poses both say where sensors were; give one")
    plan = clouds[0].suffix == ".yaml"
    options_given = set(filter(was_given, ("sensor", "poses", "box", "columns", *options)))
    misplaced = options_given - {"height_m"} if plan else options_given & {"height_m"}
    if misplaced or (plan and len(clouds) > 1):
        raise click.UsageError(
            "a plan, .yaml, is given alone, with --height and no other of these options, which are "
            "for clouds"
        )
    from scenegen.display.inspect import map_facts
    from scenegen.files import write_result
    from scenegen.worlds.cloud import map_clouds
    from scenegen.worlds.place import encode_map
    from scenegen.worlds.plan import read_plan

    survey = Survey(**options)
    if plan:
        made = read_plan(clouds[0], survey.height_m)
    else:
        made = map_clouds(clouds, survey, sensor=sensor, poses=poses, box=box, columns=columns)
    write_result(out, encode_map(made.voxels, str(clouds[0]), offset=made.offset))
    about = {"file": str(out), "points": made.points, "taken_off_m": made.offset.tolist()}
    row = about | map_facts(made.voxels)
    if talk:
        note(made.read)
    if tell(row | {"read": made.read}):
        show_table(plain(row) | {"next": f"scenegen generate --scene {quote(str(out))}"})


@command(
    "ingest dataset/sequences/07 -o data/kitti-07",
    "ingest drive.mcap --deskew -o data/drive",
    "ingest clouds --poses poses.tum -o data/walk",
)
@click.argument("log", type=FILE)
@log_options
@columns_option
@options_of(
    Fusing,
    voxel_m="Edge of the maps' voxels, metres.",
    reach_m="How far rays are followed, metres.",
    rise_m="How far maps go above and below the sensor, metres.",
    least_m="Nearer returns are left out, metres.",
    moved_share="A voxel is free where fewer of the scans that say something of it have a return "
    "in it.",
    every="Every n-th scan is kept beside the truth.",
    deskew="Move points to where their rays met something, by the time of each: for raw scans.",
)
@click.option(
    "--explain",
    is_flag=True,
    help="Print how points, poses and times are read, and write nothing.",
)
@out_option("The folder to write, a new one.  [default: <log>-maps]")
@printing
@group("Log", "poses poses-of topic fixed-frame columns deskew explain")
@group("Maps", "voxel reach rise least moved-share")
def ingest(
    log: Path,
    log_reading: dict[str, Any],
    columns: int | None,
    explain: bool,
    out: Path | None,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Make maps of a log of LiDAR scans with poses, and keep some of its scans beside them.

    A log is a sequence in KITTI's odometry layout (SemanticKITTI's, too), a recording of ROS
    (.mcap, .bag, .db3, or a bag's folder) with PointCloud2 or Livox's CustomMsg and /tf, odometry
    or --poses, or a folder of clouds with --poses. Stopped or killed, the same command goes on.
    """
    from scenegen.files import check_free
    from scenegen.logs.fuse import ingest as write
    from scenegen.logs.read import read_log

    target = out or Path(f"{log.stem}-maps")
    with raised_as(click.UsageError):
        how = Fusing(**options)
    if not explain:
        check_free(target)
    recording = read_log(log, columns=columns, **log_reading)
    if explain:
        row = recording.explained()
        if tell(row):
            show_table(row)
    elif talk:
        note(recording.line())
    if how.deskew:
        recording.check_point_times()
    if explain:
        return
    with Progress("ingest", shown=talk) as progress:
        progress.start(len(recording.poses))
        counts = write(recording, target, how, on_done=progress.count)
    if tell({"folder": str(target), "read": dict(recording.about), **counts}):
        source, folder = quote(str(target)), quote(f"{target}-samples")
        show_table(plain(counts) | {"next": f"scenegen generate --scene {source} -o {folder}"})
