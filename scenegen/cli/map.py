"""`scenegen map`: clouds of points become a map of a real place."""

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
    was_given,
)
from scenegen.cli.show import show_table
from scenegen.cli.types import FILE, Number
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
@options_of(
    Survey,
    voxel_m="Edge of the map's voxels, metres.",
    unit_m="The clouds' unit, metres: 0.001 for millimetres.",
    up="The clouds' axis that points up.",
    height_m="How high the walls of a plan are, metres.",
    assume_free="Call free what is above the lowest point of a column and holds none, unless a ray "
    "says so already: for clouds of which nobody knows where they were seen from.",
)
@out_option("The map to write, .npz.", file=True, default=Path("map.npz"))
@printing
@group("Clouds", "sensor poses box unit up")
def map(
    clouds: tuple[Path, ...],
    sensor: tuple[float, ...] | None,
    poses: Path | None,
    box: tuple[float, ...] | None,
    out: Path,
    as_json: bool,
    talk: bool,
    **options: Any,
) -> None:
    """Make a map of a real place from clouds of points: .ply, .pcd, .las, .laz, .xyz, .npz, .npy;
    or from one of ROS's plans of a floor, .yaml.

    Voxels with points are occupied, those that rays from the sensor crossed are free, and all
    others unknown. `scenegen generate --scene` takes the map.
    """
    if sensor is not None and poses is not None:
        raise click.UsageError("--sensor and --poses both say where sensors were; give one")
    plan = clouds[0].suffix == ".yaml"
    given = set(filter(was_given, ("sensor", "poses", "box", *options)))
    misplaced = given - {"height_m"} if plan else given & {"height_m"}
    if misplaced or (plan and len(clouds) > 1):
        raise click.UsageError(
            "a plan, .yaml, is given alone, with --height and no other of these options, which are "
            "for clouds"
        )
    if out.suffix != ".npz":
        raise click.UsageError(f"{out}: expected a name that ends in .npz")
    from scenegen.display.inspect import map_facts
    from scenegen.files import write_result
    from scenegen.worlds.cloud import map_clouds
    from scenegen.worlds.place import encode_map
    from scenegen.worlds.plan import read_plan

    survey = Survey(**options)
    if plan:
        made = read_plan(clouds[0], survey.height_m)
    else:
        made = map_clouds(clouds, survey, sensor=sensor, poses=poses, box=box)
    write_result(out, encode_map(made.voxels, str(clouds[0]), offset=made.offset))
    about = {"file": str(out), "points": made.points, "taken_off_m": made.offset.tolist()}
    row = about | map_facts(made.voxels)
    if as_json:
        print(json.dumps(row))
    elif talk:
        show_table(row | {"next": f"scenegen generate --scene {out}"})
