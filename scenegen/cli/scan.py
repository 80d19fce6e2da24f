"""`scenegen sensors` lists sensors; `scan` scans a world, once or along a flight."""

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import rich_click as click

from lidarsim.engines import EngineFactory
from lidarsim.sensors import CATALOGUE, RASTER, SENSORS
from scenegen.base.errors import DatasetError, reraise_as
from scenegen.base.paths import type_of
from scenegen.cli.options import (
    WORLD,
    columns_option,
    command,
    engine_option,
    group,
    json_option,
    lidar_option,
    noise_option,
    options_of,
    out_option,
    printing,
    seed_option,
    was_given,
)
from scenegen.cli.show import ProgressBar, Reporter, echo, flat, info, show_columns, show_table
from scenegen.cli.types import FILE, Choice, Named, Numbers, OutputFile
from scenegen.convert import Choices
from scenegen.logs import Cruise, check_log
from scenegen.worlds.traffic import PRESETS

if TYPE_CHECKING:
    from lidarsim import Pose, Sensor
    from lidarsim.noise.chain import Noise
    from scenegen.base.files import Json
    from scenegen.worlds.world import AnyWorld


class _Setup(NamedTuple):
    """A world, and all that a scan of it needs."""

    sensor: "Sensor"
    noise: "Noise"
    engine: EngineFactory
    world: "AnyWorld"


HEADS = {
    "shape": "rays",
    "elevation_deg": "up, °",
    "azimuth_deg": "around, °",
    "scan_s": "scan, s",
    "max_range_m": "m",
}
"""Columns of the list of sensors, by the facts that they show."""


SCANS = dict.fromkeys((".pcd", ".ply", ".bin", ".npz", ".npy", ".las", ".laz"), "--against")
"""The option that takes a file, by its suffix."""


@command(
    "sensors",
    "sensors ouster-os1-128 my_lidar.toml -o patterns.png",
    "sensors hesai-xt-32 --against scan.pcd --fit mine.toml -o against.png",
)
@click.argument(
    "names",
    nargs=-1,
    metavar="[NAME|FILE.toml|MODULE:CLASS]…",
    type=Named(SENSORS, file=".toml", file_options=SCANS),
)
@click.option(
    "--against",
    "scans",
    multiple=True,
    type=FILE,
    help="A scan of a real unit, in its own frame, to compare with the spinning sensor that is "
    "named; repeatable.",
)
@columns_option
@click.option(
    "--fit",
    type=OutputFile(".toml"),
    help="With --against: write a sensor file for --lidar, with the unit's angles, ranges and "
    "noise.",
)
@out_option(
    "Picture (.png) of the patterns of rays, azimuth × elevation; with --against, of elevations, "
    "ranges and noise.",
    ".png",
)
@json_option
def sensors(
    names: tuple[str, ...],
    scans: tuple[Path, ...],
    columns: int | None,
    fit: Path | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """List all sensors, or print facts of some; with -o, draw their patterns of rays.

    Use a name as `scenegen generate --lidar NAME`, or in a recipe as `[lidar] sensor = "NAME"`.
    With --against, compare scans of a real unit with its sensor.

    \f
    Args:
        names: Names of sensors; empty for all.
        scans: Scans of a unit.
        columns: Numbers of a point of these.
        fit: Sensor file to write, or None.
        out: File of the picture, or None.
        as_json: Print JSON.

    Raises:
        UsageError: Options contradict each other.
        DatasetError: Scans cannot be read, or are not of the sensor.
    """
    if scans and len(names) != 1:
        raise click.UsageError("--against compares scans with one sensor; name it")
    if not scans and (fit or columns):
        raise click.UsageError("--fit and --columns go with --against")
    from scenegen.base.files import write_result
    from scenegen.worlds.tables import named_lidar

    # without names, those of the catalogue, and the raster that recipes use by default
    chosen = {name: named_lidar(name) for name in names or (RASTER, *CATALOGUE)}
    rows = {name: _facts(sensor) for name, sensor in chosen.items()}
    unit = None
    if scans:
        from scenegen.logs.against import measure
        from scenegen.worlds.clouds import read_cloud

        clouds = [read_cloud(scan, columns=columns) for scan in scans]
        with reraise_as(DatasetError, f"{', '.join(map(str, scans))}: "):
            unit = measure(clouds, chosen[names[0]])
        rows["unit"] = unit.facts()
        if fit is not None:
            write_result(fit, unit.encode())
    if out is not None:
        from scenegen.view.stills import draw_patterns, draw_sensor_unit, to_bytes

        figure = draw_sensor_unit(unit) if unit else draw_patterns(chosen)
        write_result(out, to_bytes(figure, ".png"))
    if as_json:
        print(json.dumps(rows))
    elif names:
        for name, row in rows.items():
            facts = {key: value for key, value in flat(row).items() if value not in ("", [])}
            show_table(facts, name)
    else:
        cells = {name: [_cell(row[head]) for head in HEADS] for name, row in rows.items()}
        show_columns(cells, list(HEADS.values()))
        echo("\nscenegen sensors NAME prints the source of its figures; --out FILE draws it")
    for path in (fit, out):
        if path is not None and not as_json:
            echo(f"written: {path}")


def _facts(sensor: "Sensor") -> "Json":
    """Return facts of a sensor as plain JSON values; angles are measured on its rays."""
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
    """Format a fact for the list: 16 × 1808, or -15 … 15."""
    if not isinstance(value, list):
        return f"{value:g}"
    return (" … " if isinstance(value[0], float) else " × ").join(f"{number:g}" for number in value)


@command(
    "scan scenes/room_with_gap.xml --pose 1,2,0.5,30 -o scan.ply",
    "scan scenes/forest.xml --flight --lidar livox-avia --noise datasheet -o forest.npz",
    "scan campus.bt --pose 10,5,1.2,90 --frame world -o campus.ply",
    "scan pillar --seed 3 --flight --sequence --lidar ouster-os1-64 -o log.mcap",
    "scan street --movers dense --flight --sequence --moving --lidar ouster-os1-64 -o log",
)
@click.argument("world", type=WORLD)
@click.option(
    "--pose",
    type=Numbers(name="X,Y,Z,YAW"),
    help="Position of the body, metres, and its yaw, degrees.",
)
@click.option("--flight", is_flag=True, help="Scan from a pose of a random flight instead.")
@click.option(
    "--sequence",
    is_flag=True,
    help="With --flight: write a log, which has scans at the sensor's rate along a long flight: a "
    "folder in the layout of KITTI's odometry, or an .mcap file for ROS 2.",
)
@options_of(
    Cruise,
    length_m="With --sequence: length of the flight, metres.",
    speed_mps="Speed, metres a second.",
    acceleration_mps2="Maximum acceleration, metres a second squared.",
    yaw_rate_deg_s="Maximum yaw rate, degrees a second.",
)
@click.option(
    "--moving",
    is_flag=True,
    help="With --sequence: cast each ray from where the sensor is at its time. Points of a folder "
    "are corrected for that, as KITTI's; those of an .mcap file are raw.",
)
@click.option(
    "--movers",
    type=Choice(list(PRESETS)),
    help="Add people, vehicles and drones that move; a log says which points are theirs. An MJCF "
    "file's own are kept.",
)
@lidar_option("raster")
@noise_option
@engine_option("Engine that casts rays.", default="analytic")
@options_of(Choices, frame="Frame of the points: the body when the scan begins, or the world.")
@seed_option("Seed of the noise and the flight.")
@out_option(
    "The file: .ply, .pcd, .npz, .bin; a log: a folder or .mcap.  [default: scan.ply, log]",
    file=True,
)
@printing
@group("Poses", "pose flight")
@group("A log", "sequence length speed acceleration yaw-rate moving")
def scan(
    world: str,
    pose: tuple[float, ...] | None,
    flight: bool,
    sequence: bool,
    moving: bool,
    movers: str | None,
    lidar: str | None,
    noise: str | None,
    engine: str,
    frame: str,
    seed: int,
    out: Path | None,
    report_result: Reporter,
    verbose: bool,
    **options: Any,
) -> None:
    """Scan the world of an MJCF file, once or along a flight, and write the returns as points.

    Or scan a mesh; a map of a real place (.bt, .ot, .npz), where rays through unknown space are
    counted; or a world of a kind, drawn by the seed.

    \f
    Raises:
        UsageError: Options contradict each other.
        ScenegenError: There is no such world or sensor, no flight fits, or the file cannot be
            written.
    """
    # all that options can contradict is checked before anything is imported or drawn
    if (pose is None) != flight:
        raise click.UsageError("give one of --pose X,Y,Z,YAW and --flight")
    if sequence and (not flight or was_given("frame")):
        raise click.UsageError("--sequence goes with --flight, and without --frame")
    if not sequence and (moving or any(map(was_given, options))):
        raise click.UsageError("--moving and the options of the long flight go with --sequence")
    if type_of(world) in ("map", "scan", "plan") and was_given("engine"):
        raise click.UsageError(f"{world}: a map takes no --engine: it has its own")
    from scenegen.base.files import check_ours
    from scenegen.dataset.shard import find_engine
    from scenegen.draw.source import named_world
    from scenegen.worlds.clouds.write import SUFFIXES
    from scenegen.worlds.tables import named_lidar, named_noise

    out = out or Path("log" if sequence else "scan.ply")
    if sequence:
        check_log(out)
    elif out.suffix not in SUFFIXES:
        raise click.UsageError(f"{out}: expected a name that ends in {', '.join(SUFFIXES)}")
    sensor = named_lidar(lidar or RASTER)
    chain, maker = named_noise(noise, sensor), find_engine(engine)
    report = info if verbose else None
    setup = _Setup(sensor, chain, maker, named_world(world, seed, report=report, movers=movers))
    if sequence:
        facts = _write_log(out, setup, Cruise(**options), seed, moving, verbose)
    else:
        check_ours(out)  # scans may take minutes: refuse a user's own file before
        facts = _write_scan(out, setup, _pose(setup.world, pose, seed), seed, frame)
    row = {"file": str(out), "lidar": str(sensor), "noise": str(setup.noise) or "none", **facts}
    if report_result(row):
        left_out = ("file", "quaternion")  # the file has a line of its own
        show_table({name: value for name, value in row.items() if name not in left_out})
        echo(f"written: {out}")


def _write_log(
    out: Path, setup: _Setup, cruise: Cruise, seed: int, moving: bool, verbose: bool
) -> "Json":
    """Record a log; return facts of it."""
    from scenegen.logs.record import cruise_poses, out_of_the_way, period_s, record, write_log

    # KITTI's points are deskewed, while drivers of ROS publish them raw
    corrected = out.suffix != ".mcap"
    if not corrected:
        import mcap_ros2  # noqa: F401 (if it is missing, fail before a minute of scans)
    period = period_s(setup.sensor)
    poses = cruise_poses(setup.world, cruise, period, seed=seed)
    world = out_of_the_way(setup.world, poses, period)
    scans = record(
        world,
        setup.engine,
        setup.sensor,
        poses,
        setup.noise,
        seed=seed,
        moving=moving,
        corrected=corrected,
    )
    with ProgressBar("scan", visible=verbose) as progress:
        progress.start(len(poses))
        counts = write_log(out, scans, progress.count)
    flown = sum(math.dist(a.position, b.position) for a, b in pairwise(poses))
    drawn, kept = (getattr(each, "movers", None) or () for each in (setup.world, world))
    if drawn:
        counts |= {"movers": len(kept), "movers_too_near": len(drawn) - len(kept)}
    return {"seconds": round(period * len(poses), 3), "metres": round(flown, 3), **counts}


def _pose(world: "AnyWorld", pose: tuple[float, ...] | None, seed: int) -> "Pose":
    """Return the pose that the user gave, or one of a random flight."""
    from lidarsim import Pose
    from scenegen.worlds.flight import pose_in_flight

    if pose is not None:
        return Pose.level(pose[:3], math.radians(pose[3]))
    return pose_in_flight(world, seed=seed)


def _write_scan(file: Path, setup: _Setup, at: "Pose", seed: int, frame: str) -> "Json":
    """Scan from a pose and write the returns; return facts of them."""
    import numpy as np

    from lidarsim import cast
    from lidarsim.scan import is_return, mounted
    from scenegen.draw.draw import scan_world
    from scenegen.worlds.clouds.write import write_points
    from scenegen.worlds.mapping import Known
    from scenegen.worlds.place import Place

    sensor, noise, engine, world = setup
    seen = scan_world(world, sensor, at, noise, seed=seed, engine=engine, time_s=0.0)
    # a real sensor has no returns below its minimum range, whatever noise the user chose
    near = np.isfinite(seen.ranges) & ~is_return(seen.ranges, getattr(sensor, "min_range_m", 0.0))
    seen = seen.but(ranges=np.where(near, np.inf, seen.ranges))
    points = np.concatenate([seen.points(echo) for echo in range(len(seen.ranges))])
    if frame == "body":
        points = at.to_body(points)
    intensity = None if seen.intensity is None else seen.intensity[np.isfinite(seen.ranges)]
    header = {
        "ranges": seen.ranges,
        "times_s": sensor.times_s,
        "sensor_position": mounted(sensor, at).position,
        "position": at.position,
        "quaternion": at.quaternion,
        "lidar": str(sensor),
        "noise": str(noise),
        "frame": frame,
    }
    write_points(file, points, intensity, header)
    row = {
        "position": [round(float(value), 3) for value in at.position],
        "quaternion": at.quaternion.tolist(),
        "rays": sensor.times_s.size,
        "returns": len(points),
        "returns_too_near": int(np.count_nonzero(near)),
    }
    # rays through unknown space return as if it were free: their returns may be wrong
    if isinstance(world, Place):
        unknown_m = world.unknown_m(cast(world.caster(None), sensor, at))
        through = unknown_m > Known().most_unknown_m
        row["rays_through_unknown"] = int(np.count_nonzero(through))
    return row
