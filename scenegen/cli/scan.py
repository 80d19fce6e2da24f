"""`scenegen sensors` and `scenegen scan`: the sensors that there are, and what one sees of a
world."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.engines import ENGINES
from lidarsim.parameters import MOST_LENGTH_M, Bounds
from lidarsim.sensors import CATALOGUE, RASTER, SENSORS
from scenegen.cli.options import (
    engine_option,
    examples,
    json_option,
    lidar_option,
    noise_option,
    options_of,
    out_option,
    printing,
    seed_option,
    was_given,
)
from scenegen.cli.show import say, show_figures, show_table
from scenegen.cli.types import Named, Number, Numbers
from scenegen.display.exchange import Choices
from scenegen.limits import LEAST_DRAWN_M
from scenegen.worlds import CLOUDS, MAPS

if TYPE_CHECKING:
    from lidarsim import Pose, Sensor
    from lidarsim.noise.chain import Noise
    from scenegen.worlds.place import Place
    from scenegen.worlds.world import World

HEADS = {
    "shape": "rays",
    "elevation_deg": "up, °",
    "azimuth_deg": "around, °",
    "scan_s": "scan, s",
    "max_range_m": "m",
}
"""The columns of the list."""


@click.command(epilog=examples("sensors", "sensors ouster-os1-128 my_lidar.toml -o patterns.png"))
@click.argument(
    "names", nargs=-1, metavar="[NAME|FILE.toml|MODULE:CLASS]…", type=Named(SENSORS, file=".toml")
)
@out_option(
    "A picture (.png) of the patterns, azimuth × elevation, one below the other.", file=True
)
@json_option
def sensors(names: tuple[str, ...], out: Path | None, as_json: bool) -> None:
    """List the sensors that there are, or tell of those named, and draw their patterns.

    Each goes into `scenegen generate --lidar NAME`, or into a recipe as `[lidar] sensor = "NAME"`.
    """
    from scenegen.tables import beam_table, named_lidar

    found = {name: named_lidar(name) for name in names or (RASTER, *CATALOGUE)}
    for name in names:
        try:
            beam_table(found[name])
        except ValueError as error:
            raise click.ClickException(f"{name}: {error}") from None
    rows = {name: _facts(sensor) for name, sensor in found.items()}
    if out is not None:
        from scenegen.display.panels import to_bytes
        from scenegen.display.pictures import draw_patterns
        from scenegen.files import write_result

        write_result(out, to_bytes(draw_patterns(found), ".png"))
    if as_json:
        print(json.dumps(rows))
    elif names:
        for name, row in rows.items():
            show_table({key: value for key, value in row.items() if value not in ("", [])}, name)
    else:
        cells = {name: [_cell(row[head]) for head in HEADS] for name, row in rows.items()}
        show_figures(cells, list(HEADS.values()))
        say("\nscenegen sensors NAME tells where its figures come from; --out FILE draws it")


def _facts(sensor: "Sensor") -> dict[str, Any]:
    """What is to be said of a sensor, as plain JSON values; angles are measured on its rays."""
    import numpy as np

    from lidarsim.sensors.device import angles_deg

    up, around = (
        [round(float(angles.min()), 2), round(float(angles.max()), 2)]
        for angles in angles_deg(sensor.directions_body)
    )
    return {
        "shape": list(sensor.shape),
        "elevation_deg": up,
        "azimuth_deg": around,
        "scan_s": round(float(np.max(sensor.times_s)), 6),
        "min_range_m": getattr(sensor, "min_range_m", 0.0),
        "max_range_m": sensor.max_range_m,
        "source": getattr(sensor, "source", "") or str(sensor),
        **{name: getattr(sensor, name, "") for name in ("noise", "checked", "error")},
    }


def _cell(value: Any) -> str:
    """A figure for the list: 16 × 1808, or -15 … 15."""
    if not isinstance(value, list):
        return f"{value:g}"
    return (" … " if isinstance(value[0], float) else " × ").join(f"{one:g}" for one in value)


@click.command(
    epilog=examples(
        "scan room.xml --pose 1,2,0.5,30 -o scan.ply",
        "scan room.xml --flight --every 0.5 --lidar livox-avia --noise datasheet -o walk.npz",
        "scan campus.bt --pose 10,5,1.2,90 --frame world -o campus.ply",
    )
)
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
@lidar_option("raster")
@noise_option
@engine_option("What casts the rays.", default="analytic")
@options_of(Choices, frame="Frame of the points: the body when the scan begins, or the world.")
@seed_option("What the noise, and the flight, are drawn by.")
@out_option("The file to write: .ply, .pcd, .npz or .bin.", default=Path("scan.ply"), file=True)
@printing
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
    talk: bool,
) -> None:
    """Scan the world of an MJCF file, once or along a flight, and write the returns as points.

    Or a mesh, or a map of a real place (.bt, .ot, .npz). Rays that cross unknown space are counted.
    """
    if (pose is None) != flight:
        raise click.UsageError("give one of --pose X,Y,Z,YAW and --flight")
    if every is not None and not flight:
        raise click.UsageError("--every goes with --flight")
    if world.suffix in (*MAPS, *CLOUDS) and was_given("engine"):
        raise click.UsageError(f"{world}: a map takes no --engine: it has its own")
    from lidarsim import Pose
    from scenegen.display.exchange.files import SUFFIXES
    from scenegen.files import check_ours
    from scenegen.source import read_world
    from scenegen.tables import named_lidar, named_noise
    from scenegen.worlds.flight import pose_in_flight, poses_in_flight

    if out.suffix not in SUFFIXES:
        raise click.UsageError(f"{out}: expected a name that ends in {', '.join(SUFFIXES)}")
    sensor = named_lidar(lidar or RASTER)
    chain = named_noise(noise, sensor)
    found = read_world(world)
    files = [out]
    if pose is not None:
        poses = [Pose.level(pose[:3], math.radians(pose[3]))]
    elif every is None:
        poses = [pose_in_flight(found, seed=seed)]
    else:
        poses = poses_in_flight(found, every_m=every, seed=seed)
        stems = (f"{out.stem}-{number:03d}{out.suffix}" for number in range(len(poses)))
        files = [out.with_name(stem) for stem in stems]
    for file in files:
        check_ours(file)
    rows = []
    for number, (file, at) in enumerate(zip(files, poses, strict=True)):
        drawn = seed if every is None else [seed, number]
        rows.append(_write_scan(file, found, sensor, at, chain, drawn, engine, frame))
    if as_json:
        print(json.dumps(rows[0] if every is None else {"scans": rows}))
    elif talk:
        told = {name: value for name, value in rows[0].items() if name != "quaternion"}
        if len(rows) > 1:
            told |= {"file": f"{files[0]} … {files[-1]}", "scans": len(rows)}
        show_table(told)


def _write_scan(
    file: Path,
    world: "World | Place",
    sensor: "Sensor",
    at: "Pose",
    chain: "Noise",
    seed: int | list[int],
    engine: str,
    frame: str,
) -> dict[str, Any]:
    """Scans from a pose, writes the returns, and gives what is to be said of them."""
    import numpy as np

    from lidarsim import cast
    from lidarsim.pose import rotate
    from scenegen.display.exchange.files import write_points
    from scenegen.draw import scan_world
    from scenegen.worlds.mapping import Known
    from scenegen.worlds.place import Place

    seen = scan_world(world, sensor, at, chain, seed=seed, engine=ENGINES.find(engine).of)
    points = np.concatenate([seen.points(echo) for echo in range(len(seen.ranges))])
    if frame == "body":
        points = rotate(at.quaternion * (1.0, -1.0, -1.0, -1.0), points - at.position)
    intensity = None if seen.intensity is None else seen.intensity[np.isfinite(seen.ranges)]
    about = {
        "ranges": seen.ranges,
        "times_s": sensor.times_s,
        "position": at.position,
        "quaternion": at.quaternion,
        "lidar": str(sensor),
        "noise": str(chain),
        "frame": frame,
    }
    write_points(file, points, intensity, about)
    row = {
        "file": str(file),
        "lidar": str(sensor),
        "noise": str(chain) or "none",
        "position": [round(float(value), 3) for value in at.position],
        "quaternion": at.quaternion.tolist(),
        "rays": int(sensor.times_s.size),
        "returns": len(points),
    }
    if isinstance(world, Place):
        unknown_m = world.unknown_m(cast(world.caster(None), sensor, at))
        through = unknown_m > Known().most_unknown_m
        row["rays_through_unknown"] = int(np.count_nonzero(through))
    return row
