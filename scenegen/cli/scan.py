"""`scenegen scan`: one scan of a world, or those along a flight, as clouds of points."""

import json
from pathlib import Path

import rich_click as click

from lidarsim.engines import ENGINES
from lidarsim.parameters import MOST_LENGTH_M, Bounds
from lidarsim.sensors import RASTER
from scenegen.cli.options import (
    json_option,
    lidar_option,
    noise_option,
    out_option,
    quiet_option,
    seed_option,
)
from scenegen.cli.show import show_table
from scenegen.cli.types import Named, Number, Numbers
from scenegen.errors import DatasetError
from scenegen.limits import LEAST_DRAWN_M


@click.command()
@click.argument("world", type=click.Path(path_type=Path))
@click.option(
    "--pose", type=Numbers("X,Y,Z,YAW", 4), help="Where the body is, metres, and its yaw, degrees."
)
@click.option("--flight", is_flag=True, help="A viewpoint of a random flight instead.")
@click.option(
    "--every",
    type=Number(Bounds(least=LEAST_DRAWN_M, most=MOST_LENGTH_M)),
    help="With --flight: a scan whenever so many metres were flown, each in a file of its own, "
    "numbered from 000.",
)
@lidar_option("The sensor", "  [default: raster]")
@noise_option
@click.option(
    "--engine",
    type=Named(ENGINES),
    default="analytic",
    show_default=True,
    help="What casts the rays.",
)
@click.option(
    "--frame",
    type=click.Choice(["body", "world"]),
    default="body",
    show_default=True,
    help="Frame of the points: the body when the scan begins, or the world.",
)
@seed_option("What the noise, and the flight, are drawn by.")
@out_option("The file to write: .ply, .pcd, .npz or .bin.", Path("scan.ply"), file=True)
@json_option
@quiet_option
def scan(
    world: Path,
    pose: tuple[float, ...] | None,
    flight: bool,
    every: float | None,
    lidar: str | None,
    noise: str | None,
    engine: str,
    frame: str,
    seed: int,
    out: Path,
    as_json: bool,
    quiet: bool,
) -> None:
    """Scan the world of an MJCF file, once or along a flight, and write the returns as points."""
    if (pose is None) != flight:
        raise click.UsageError("give one of --pose X,Y,Z,YAW and --flight")
    if every is not None and not flight:
        raise click.UsageError("--every goes with --flight")
    import math

    import numpy as np

    from lidarsim import Pose
    from lidarsim.pose import rotate
    from scenegen.display.points import check_suffix, write_points
    from scenegen.draw import pose_in_flight, poses_in_flight, read_world, scan_world
    from scenegen.files import check_ours
    from scenegen.lidar import named_lidar, named_noise

    try:
        check_suffix(out)
    except DatasetError as error:
        raise click.UsageError(str(error)) from None
    sensor = named_lidar(lidar or RASTER)
    chain = named_noise(noise, sensor)
    found = read_world(world)
    if every is not None:
        poses = poses_in_flight(found, every_m=every, seed=seed)
    elif pose is None:
        poses = [pose_in_flight(found, seed=seed)]
    else:
        poses = [Pose.level(pose[:3], math.radians(pose[3]))]
    files = [out if every is None else _numbered(out, number) for number in range(len(poses))]
    for file in files:
        check_ours(file)
    rows = []
    for number, (file, at) in enumerate(zip(files, poses, strict=True)):
        drawn = seed if every is None else [seed, number]
        seen = scan_world(found, sensor, at, chain, seed=drawn, engine=ENGINES.find(engine).of)
        points = np.concatenate([seen.points(echo) for echo in range(len(seen.ranges))])
        if frame == "body":
            back = at.quaternion * (1.0, -1.0, -1.0, -1.0)
            points = rotate(back, points - at.position)
        intensity = None if seen.intensity is None else seen.intensity[np.isfinite(seen.ranges)]
        about = {
            "ranges": seen.ranges,
            "times_s": sensor.times_s,
            "position": at.position,
            "quaternion": at.quaternion,
        }
        write_points(
            file,
            points,
            intensity,
            about | {"lidar": str(sensor), "noise": str(chain), "frame": frame},
        )
        rows.append(
            {
                "file": str(file),
                "lidar": str(sensor),
                "noise": str(chain) or "none",
                "position": [round(float(value), 3) for value in at.position],
                "quaternion": at.quaternion.tolist(),
                "rays": int(sensor.times_s.size),
                "returns": len(points),
            }
        )
    if as_json:
        print(json.dumps(rows[0] if every is None else {"scans": rows}))
    elif not quiet:
        told = {name: value for name, value in rows[0].items() if name != "quaternion"}
        if len(rows) > 1:
            told |= {"file": f"{rows[0]['file']} … {rows[-1]['file']}", "scans": len(rows)}
        show_table(told)


def _numbered(out: Path, number: int) -> Path:
    return out.with_name(f"{out.stem}-{number:03d}{out.suffix}")
