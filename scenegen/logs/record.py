"""Records logs in a world: `cruise_poses` draws a flight, `record` scans along it, `write_log`
writes the scans.

The flight is long, from goal to goal, at an even speed with rounded corners and a bounded yaw rate;
the sensor scans at its own rate. A log is written in the layout of KITTI's odometry benchmark, or
as MCAP with ROS 2 messages.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from ompl import geometric as og

from lidarsim import Pose, Sensor
from lidarsim.engines import EngineFactory
from lidarsim.grid import Floats
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Motion
from lidarsim.pose import rotate
from lidarsim.scan import mounted
from lidarsim.sensors.spinning import Windowed
from scenegen.base.errors import GenerationError
from scenegen.base.executors import Counted, unheard
from scenegen.base.files import check_free, make_way, whole, whole_folder
from scenegen.draw.draw import in_motion, scan_world
from scenegen.logs import Cruise, LogScan
from scenegen.logs.bags import (
    CLOUD,
    TRANSFORMS,
    Row,
    points_message,
    write_messages,
)
from scenegen.worlds.clouds.write import encode_points
from scenegen.worlds.flight import TRIES, Flight, Route, connect, points_of
from scenegen.worlds.world import AnyWorld

FRAME, SENSOR = "map", "lidar"
"""ROS frames: the world's, and the sensor's."""
CALIBRATION = "".join(f"{name}: 1 0 0 0 0 1 0 0 0 0 1 0\n" for name in ("P0", "Tr"))
"""A KITTI calibration in which camera and sensor are the same, so that poses are the sensor's."""
STEPS = 10
"""Steps between scans by which the yaw follows the course."""
FINE_M = 0.01
"""Distance between points of the curve that is flown, metres."""
ROUNDS = 3
"""Rounds of B-spline subdivision; each halves the distance between points."""
USUAL_S = 0.1
"""Time between scans of a sensor without a rate, seconds."""


def cruise_poses(world: AnyWorld, cruise: Cruise, period_s: float, *, seed: int) -> list[Pose]:
    """Draw a long random flight through a world.

    The flight joins paths of RRT whose corners are cut by B-spline subdivision where a `Flight`'s
    clearance allows (OMPL's `PathSimplifier`). It is then averaged over two radii of the robot, by
    a triangle, which moves no point by more than two thirds of the radius, so that a third of the
    clearance is left.

    Args:
        world: The world.
        cruise: Length, speed and bounds of the flight.
        period_s: Time between poses, seconds.
        seed: Seed of the flight.

    Returns:
        Level poses of the body in the world, `period_s` apart.

    Raises:
        GenerationError: No flight of this length fits between the solids.
    """
    flight, rng = Flight(), np.random.default_rng(seed)
    route = Route(_tour(world, flight, cruise.length_m, rng=rng))
    flown = np.arange(0.0, cruise.length_m, FINE_M)
    # paths have corners, at which a vehicle would have to stop: average them away
    reach = round(2 * flight.robot_radius_m / FINE_M)
    weights = 1.0 - abs(np.arange(-reach, reach + 1)) / reach
    weights /= weights.sum()
    curve = np.stack(
        [
            np.convolve(np.pad(np.interp(flown, route.ends, axis), reach, "edge"), weights, "valid")
            for axis in route.path.T
        ],
        axis=1,
    )
    # the yaw turns between scans, too: follow it in smaller steps, of which each STEPS-th is a pose
    step_s = period_s / STEPS
    times = _times(curve, cruise)
    now = np.arange(0.0, times[-1], step_s)
    positions = np.stack([np.interp(now, times, axis) for axis in curve.T], axis=1)
    yaws = _followed(positions, math.radians(cruise.yaw_rate_deg_s) * step_s)
    return [Pose.level(positions[n], float(yaws[n])) for n in range(0, len(now), STEPS)]


def _times(curve: Floats, cruise: Cruise) -> Floats:
    """Return when each point (n, 3) of a curve, `FINE_M` apart, is passed, seconds (n,)."""
    bend = np.gradient(np.gradient(curve, FINE_M, axis=0), FINE_M, axis=0)
    pull = np.sqrt((bend**2).sum(axis=1))
    limit = cruise.acceleration_mps2
    # by v² / r: in a bend, the acceleration across it bounds the speed
    squares = np.minimum(cruise.speed_mps**2, limit / np.maximum(pull, 1e-9))
    # v² = v₀² + 2 a s: a bound on v² that rises by no more than `ramp`, first forwards, then back
    ramp = 2 * limit * FINE_M * np.arange(len(squares))
    squares = np.minimum.accumulate(squares - ramp) + ramp  # speeding up
    squares = (np.minimum.accumulate((squares - ramp[::-1])[::-1]) + ramp)[::-1]  # slowing down
    return np.append(0.0, np.cumsum(FINE_M / np.sqrt(squares[:-1])))


def _tour(world: AnyWorld, flight: Flight, length_m: float, *, rng: np.random.Generator) -> Floats:
    """Return a collision-free path (n, 3) from goal to goal, metres, of at least this length."""
    bounds = world.room(flight.robot_radius_m, flight.min_distance_m, rng=rng)
    apart = min(flight.min_distance_m, math.dist(*bounds) / 3)
    legs, flown, position, tries = list[Floats](), 0.0, None, 0
    while flown < length_m:
        if (tries := tries + 1) > TRIES * (100 + len(legs)):
            raise GenerationError(f"no flight of {length_m:g} m fits between the solids")
        goal = rng.uniform(bounds[0], bounds[1])
        if world.clearance.at(*goal) < flight.robot_radius_m:
            continue  # inside a solid, or too close to one
        if position is None:
            position = goal
        if math.dist(position, goal) < apart:
            continue
        seed = int(rng.integers(1, 2**31))
        solution = connect(world.clearance, bounds, flight, (position, goal), seed)
        if solution is None:
            position = position if legs else None  # the start itself may be walled in
            continue
        information, leg = solution
        simplifier = og.PathSimplifier(information)
        simplifier.reduceVertices(leg)
        simplifier.smoothBSpline(leg, ROUNDS)
        legs.append(points_of(leg))
        flown += leg.length()
        position = legs[-1][-1]
    return np.concatenate(legs)


def _followed(positions: Floats, max_rad: float) -> Floats:
    """Return yaws (n,), radians, that follow the course along positions (n, 3), turning by at most
    `max_rad` a step."""
    east, north = np.diff(positions[:, :2], axis=0, append=positions[-1:, :2]).T
    moves = np.hypot(east, north) > 1e-6
    yaws = np.empty(len(positions))
    yaw = float(np.arctan2(north, east)[np.argmax(moves)])
    for n, course in enumerate(np.arctan2(north, east).tolist()):
        if moves[n]:  # straight up or down, the yaw stays
            yaw += max(-max_rad, min(max_rad, math.remainder(course - yaw, math.tau)))
        yaws[n] = yaw
    return yaws


def period_s(sensor: Sensor) -> float:
    """Return the time between scans, seconds: by the sensor's `rate_hz`, or as a scan lasts."""
    rate, window = getattr(sensor, "rate_hz", 0.0), getattr(sensor, "window_s", 0.0)
    return 1.0 / rate if rate else window or float(np.max(sensor.times_s)) or USUAL_S


def record(
    world: AnyWorld,
    engine: EngineFactory,
    sensor: Sensor,
    poses: Sequence[Pose],
    noise: Noise,
    *,
    seed: int,
    moving: bool = False,
    corrected: bool = False,
) -> Iterator[LogScan]:
    """Scan a world along a flight.

    Args:
        world: The world.
        engine: Factory of the engine that casts rays.
        sensor: The sensor.
        poses: Level poses of the body in the world, `period_s` apart.
        noise: Noise on the clean ranges.
        seed: Seed of the noise.
        moving: Whether each ray is cast from where the sensor is at the ray's time, instead of
            all from where the scan begins. The motion is even from pose to pose.
        corrected: With `moving`, whether points are deskewed: in the sensor's frame at the scan's
            begin. Otherwise they are as the sensor reports them, as if it stood still.

    Yields:
        The scans, in order.

    Raises:
        GenerationError: The noise does not fit the world or the sensor.
    """
    interval_s, begin_s = period_s(sensor), getattr(sensor, "after_s", 0.0)
    rings = np.arange(sensor.shape[0])[:, None]
    for number, pose in enumerate(poses):
        # sensors without a repeated pattern go on with it where the last scan ended
        if isinstance(sensor, Windowed):
            sensor = dataclasses.replace(sensor, after_s=begin_s + number * interval_s)
        chain = noise
        if moving:
            first = min(number, len(poses) - 2)  # the last scan moves like the one before it
            begin, end = (mounted(sensor, poses[n]) for n in (first, first + 1))
            pace = _pace(begin, end, interval_s, corrected)
            chain = in_motion(pace, noise)
        # a seed for each scan: noise does not depend on how many scans came before
        seen = scan_world(world, sensor, pose, chain, seed=[seed, number], engine=engine)
        mounted_pose = mounted(sensor, pose)
        points = np.concatenate([seen.points(echo) for echo in range(len(seen.ranges))])
        hit = np.isfinite(seen.ranges)
        times = np.broadcast_to(sensor.times_s * moving, hit.shape)
        fields = {"t": times[hit].astype(np.float32)}
        if seen.intensity is not None:
            fields["intensity"] = seen.intensity[hit].astype(np.float32)
        if len(sensor.shape) == 2:
            fields["ring"] = np.broadcast_to(rings, hit.shape)[hit].astype(np.uint16)
        yield LogScan(number * interval_s, mounted_pose, mounted_pose.to_body(points), fields)


def _pace(begin: Pose, end: Pose, every_s: float, corrected: bool) -> Any:
    """Return the motion along the arc from one level pose to the next."""
    yaws = [2.0 * math.atan2(pose.quaternion[3], pose.quaternion[0]) for pose in (begin, end)]
    turn = math.remainder(yaws[1] - yaws[0], math.tau)
    # the chord of an arc points halfway between its ends, `Motion` where it begins
    halfway = Pose.level((0.0, 0.0, 0.0), -(yaws[0] + turn / 2)).quaternion
    moved = rotate(halfway, [end.position - begin.position])[0] / every_s
    forward, left, up = moved.tolist()
    return Motion(
        forward_mps=forward,
        left_mps=left,
        up_mps=up,
        yaw_rate_deg_s=math.degrees(turn) / every_s,
        corrected=corrected,
    )


def write_log(out: Path, scans: Iterable[LogScan], on_done: Counted = unheard) -> dict[str, int]:
    """Write a log, completely or not at all: a file if `out` ends in .mcap, else a folder.

    A folder holds ``velodyne/000000.bin`` (x, y, z, intensity as float32; intensity is 0 where none
    is known), ``times.txt``, ``poses.txt`` and ``calib.txt`` as KITTI has them (Geiger et al.
    2012), in the world's frame, and the same poses as ``poses.tum`` (time, position, quaternion x,
    y, z, w). A file has PointCloud2 on ``/points``, with `ring`, `t` and `intensity` where known,
    and the sensor's transforms in the world on ``/tf``.

    Args:
        out: The file or folder, which must not exist.
        scans: The scans, in order.
        on_done: Called with 1 after each scan.

    Returns:
        How many `scans` and `returns` were written.

    Raises:
        DatasetError: `out` exists, or the disk fails.
    """
    counts = {"scans": 0, "returns": 0}

    def counted() -> Iterator[LogScan]:
        for scan in scans:
            yield scan
            counts["scans"] += 1
            counts["returns"] += len(scan.points)
            on_done(1)

    if out.suffix != ".mcap":
        with whole_folder(out) as folder:
            _write_kitti(folder, counted())
    else:
        check_free(out)
        make_way(out)
        with whole(out) as draft, open(draft, "r+b") as file:
            write_messages(file, (TRANSFORMS, CLOUD), _rows(counted()))
    return counts


def _write_kitti(folder: Path, scans: Iterable[LogScan]) -> None:
    tables: dict[str, list[Any]] = {"times.txt": [], "poses.txt": [], "poses.tum": []}
    (folder / "velodyne").mkdir()
    (folder / "calib.txt").write_text(CALIBRATION)
    for number, scan in enumerate(scans):
        # names count scans, as in KITTI; times are in a file
        content = encode_points(".bin", scan.points, scan.more.get("intensity"))
        (folder / "velodyne" / f"{number:06d}.bin").write_bytes(content)
        w, *vector = scan.pose.quaternion  # TUM has w last
        tables["times.txt"].append(scan.time_s)
        tables["poses.txt"].append(matrix_of(scan.pose)[:3].reshape(-1))
        tables["poses.tum"].append([scan.time_s, *scan.pose.position, *vector, w])
    for name, rows in tables.items():
        np.savetxt(folder / name, rows, "%.12g")


def matrix_of(pose: Pose) -> Floats:
    """Return the pose as a matrix (4, 4), from the sensor's frame to the world's."""
    matrix, turn = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(turn, pose.quaternion)
    matrix[:3, :3], matrix[:3, 3] = turn.reshape(3, 3), pose.position
    return matrix


def _rows(scans: Iterable[LogScan]) -> Iterator[Row]:
    """Yield the messages of each scan: its cloud, and the sensor's transform."""
    for number, scan in enumerate(scans):
        when = round(scan.time_s * 1e9)
        stamp = dict(zip(("sec", "nanosec"), divmod(when, 10**9), strict=True))
        transform = {
            "translation": dict(zip("xyz", scan.pose.position, strict=True)),
            "rotation": dict(zip("wxyz", scan.pose.quaternion, strict=True)),
        }
        header = {"stamp": stamp, "frame_id": FRAME}
        link = {"header": header, "child_frame_id": SENSOR, "transform": transform}
        sensor_header = {"stamp": stamp, "frame_id": SENSOR}
        cloud = points_message(scan.points, sensor_header, **scan.more)
        yield number, when, {"tf": (TRANSFORMS, {"transforms": [link]}), "points": (CLOUD, cloud)}
