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
from lidarsim.grid import Floats, Ints
from lidarsim.movers import Movers
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Motion
from lidarsim.noise.returns import Returns, by_origin
from lidarsim.pose import rotate
from lidarsim.scan import mounted
from lidarsim.sensors.spinning import Windowed
from scenegen.base.errors import GenerationError
from scenegen.base.executors import Counted, unheard
from scenegen.base.files import check_free, make_way, whole, whole_folder
from scenegen.draw.draw import in_motion, scan_world
from scenegen.logs import Box, Cruise, LogScan
from scenegen.logs.bags import (
    CLOUD,
    MARKERS,
    TRANSFORMS,
    Row,
    points_message,
    write_messages,
)
from scenegen.worlds.clouds.write import encode_points
from scenegen.worlds.flight import TRIES, FlightConfig, Route, connect, points_of
from scenegen.worlds.poses import write_tum
from scenegen.worlds.traffic import KINDS
from scenegen.worlds.world import AnyWorld, World

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
NEAR_M = 0.5
"""Movers that come so near to the sensor are left out of a log, metres."""
MAX_ERROR_M = 0.3
"""A return farther from the mover that its ray meets is not the mover's, whatever the noise."""
STANDING = 99
"""SemanticKITTI's label of points on no mover: other-object."""
CUBE, COLOUR = 1, {"r": 1.0, "g": 0.5, "b": 0.0, "a": 0.5}
"""Type and colour of the Markers of boxes."""
LABELS = {"person": ("Pedestrian", 254), "vehicle": ("Car", 252), "drone": ("Misc", 259)}
"""KITTI's type of each kind of mover, and SemanticKITTI's label: moving-person, moving-car and
moving-other-vehicle."""


def cruise_poses(world: AnyWorld, cruise: Cruise, period_s: float, *, seed: int) -> list[Pose]:
    """Draw a long random flight through a world.

    The flight joins paths of RRT whose corners are cut by B-spline subdivision where a
    `FlightConfig`'s clearance allows (OMPL's `PathSimplifier`). It is then averaged over two radii
    of the robot, by a triangle, which moves no point by more than two thirds of the radius, so that
    a third of the clearance is left.

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
    flight, rng = FlightConfig(), np.random.default_rng(seed)
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
    # 1e-9, since straight parts have no bend to divide by
    squares = np.minimum(cruise.speed_mps**2, limit / np.maximum(pull, 1e-9))
    # v² = v₀² + 2 a s: a bound on v² that rises by no more than `ramp`, first forwards, then back
    ramp = 2 * limit * FINE_M * np.arange(len(squares))
    squares = np.minimum.accumulate(squares - ramp) + ramp  # speeding up
    squares = (np.minimum.accumulate((squares - ramp[::-1])[::-1]) + ramp)[::-1]  # slowing down
    return np.append(0.0, np.cumsum(FINE_M / np.sqrt(squares[:-1])))


def _tour(
    world: AnyWorld, flight: FlightConfig, length_m: float, *, rng: np.random.Generator
) -> Floats:
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
        seed = int(rng.integers(1, 2**31))  # OMPL takes no seed of 0
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
            # the remainder: the shorter way round
            yaw += max(-max_rad, min(max_rad, math.remainder(course - yaw, math.tau)))
        yaws[n] = yaw
    return yaws


def period_s(sensor: Sensor) -> float:
    """Return the time between scans, seconds: by the sensor's `rate_hz`, or as a scan lasts."""
    rate, window = getattr(sensor, "rate_hz", 0.0), getattr(sensor, "window_s", 0.0)
    return 1.0 / rate if rate else window or float(np.max(sensor.times_s)) or USUAL_S


def out_of_the_way(world: AnyWorld, poses: Sequence[Pose], interval_s: float) -> AnyWorld:
    """Leave out movers that come within `NEAR_M` of the sensor, whose flight knows none.

    Args:
        world: The world.
        poses: Poses of the sensor, `interval_s` apart.
        interval_s: Time between poses, seconds.

    Returns:
        The world with the other movers.
    """
    if not isinstance(world, World) or world.movers is None:
        return world
    movers, away = world.movers, np.ones(len(world.movers), bool)
    for number, pose in enumerate(poses):
        away &= movers.gaps_m(pose.position, number * interval_s) > NEAR_M
    return dataclasses.replace(world, movers=movers.only(away))


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
    """Scan a world along a flight. Movers are where they are when each scan begins.

    Args:
        world: The world; see `out_of_the_way`.
        engine: Factory of the engine that casts rays.
        sensor: The sensor.
        poses: Level poses of the body in the world, `period_s` apart.
        noise: Noise on the clean ranges.
        seed: Seed of the noise.
        moving: Whether each ray is cast from where the sensor is at the ray's time, instead of
            all from where the scan begins. The motion is even from pose to pose. Then each ray
            also meets movers where they are at its time.
        corrected: With `moving`, whether points are deskewed: in the sensor's frame at the scan's
            begin. Otherwise they are as the sensor reports them, as if it stood still.

    Yields:
        The scans, in order.

    Raises:
        GenerationError: The noise does not fit the world or the sensor.
    """
    interval_s, begin_s = period_s(sensor), getattr(sensor, "after_s", 0.0)
    rings = np.arange(sensor.shape[0])[:, None]
    movers = world.movers if isinstance(world, World) else None
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
        start_s = number * interval_s
        times_s = start_s + sensor.times_s * moving
        seen = scan_world(
            world,
            sensor,
            pose,
            chain,
            seed=[seed, number],
            engine=engine,
            time_s=times_s if moving else start_s,
        )
        mounted_pose = mounted(sensor, pose)
        points = np.concatenate([seen.points(echo) for echo in range(len(seen.ranges))])
        hit = np.isfinite(seen.ranges)
        times = np.broadcast_to(sensor.times_s * moving, hit.shape)
        fields = {"t": times[hit].astype(np.float32)}
        if seen.intensity is not None:
            fields["intensity"] = seen.intensity[hit].astype(np.float32)
        if len(sensor.shape) == 2:
            fields["ring"] = np.broadcast_to(rings, hit.shape)[hit].astype(np.uint16)
        boxes: list[Box] = []
        if movers is not None:
            # float32 rounds ranges of 200 m to 8 µm
            error_m = min(noise.bound_m(sensor.max_range_m), MAX_ERROR_M) + 1e-4
            mover = _mover_of(movers, seen, times_s, error_m)
            fields["mover"] = (mover[hit] + 1).astype(np.uint16)
            for m in range(len(movers)):
                own = np.broadcast_to(times_s, hit.shape)[hit & (mover == m)]
                boxes.append(_box(movers, m, float(own.mean() if len(own) else start_s)))
        yield LogScan(start_s, mounted_pose, mounted_pose.to_body(points), fields, boxes)


def _mover_of(movers: Movers, seen: Returns, times_s: Floats, error_m: float) -> Ints:
    """Tell which mover each return lies on, (echoes, *shape), -1 for none: the one whose surface
    its ray meets within `error_m` of it."""
    result = np.full(seen.ranges.shape, -1)
    # index -1, the solid that `nearest` gives for none, leads to owner -1
    owner = np.append(movers.owner, -1)
    for group, origin in by_origin(seen.origins):
        rays, times = seen.directions[group].reshape(1, -1, 3), times_s[group].reshape(-1)
        for ranges, numbers in zip(seen.ranges, result, strict=True):
            measured = ranges[group].reshape(1, -1)
            # a ray without a return meets nothing: it ends behind its origin
            measured = np.where(np.isfinite(measured), measured, -1.0)
            met, solid = movers.nearest(origin[None], rays, times, measured + error_m)
            solid[measured - met > error_m] = -1
            numbers[group] = owner[solid].reshape(numbers[group].shape)
    return result


def _box(movers: Movers, number: int, time_s: float) -> Box:
    """Return where a mover is at a time."""
    position, heading, _, _ = movers.poses(time_s)
    (lower, upper), (x, y) = (corners[number] for corners in movers.boxes), heading[number]
    middle = (lower + upper) / 2
    bottom = position[number] + (
        x * middle[0] - y * middle[1],
        y * middle[0] + x * middle[1],
        lower[2],
    )
    kind = KINDS[movers.kind[number] - 1]
    return Box(number + 1, kind, time_s, bottom, math.atan2(y, x), upper - lower)


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

    With movers, a folder also holds ``labels/000000.label`` (SemanticKITTI, Behley et al. 2019) and
    ``label_02.txt`` (KITTI's tracking), and a file the field `mover` and boxes on ``/movers``.

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
            write_messages(file, _rows(counted()))
    return counts


def _write_kitti(folder: Path, scans: Iterable[LogScan]) -> None:
    times_s, poses = list[float](), list[Pose]()
    (folder / "velodyne").mkdir()
    (folder / "calib.txt").write_text(CALIBRATION)
    for number, scan in enumerate(scans):
        # names count scans, as in KITTI; times are in a file
        content = encode_points(".bin", scan.points, scan.more.get("intensity"))
        (folder / "velodyne" / f"{number:06d}.bin").write_bytes(content)
        if "mover" in scan.more:
            (folder / "labels").mkdir(exist_ok=True)
            kinds = np.array([STANDING, *(LABELS[box.kind][1] for box in scan.boxes)], "<u4")
            track = scan.more["mover"].astype("<u4")
            (folder / "labels" / f"{number:06d}.label").write_bytes(kinds[track] | track << 16)
            with open(folder / "label_02.txt", "a") as file:
                file.writelines(_kitti_box(number, box, scan.pose) for box in scan.boxes)
        times_s.append(scan.time_s)
        poses.append(scan.pose)
    np.savetxt(folder / "times.txt", times_s, "%.12g")
    np.savetxt(folder / "poses.txt", [matrix_of(pose)[:3].reshape(-1) for pose in poses], "%.12g")
    write_tum(folder / "poses.tum", zip(times_s, poses, strict=True))


def _kitti_box(number: int, box: Box, pose: Pose) -> str:
    """Return a line of KITTI's tracking in the sensor's frame; unknown are truncation, occlusion,
    the angle of view and the box in the image."""
    along = np.array([[0.0, 0.0, 0.0], [math.cos(box.yaw), math.sin(box.yaw), 0.0]])
    bottom, tip = pose.to_body(box.bottom + along)
    # KITTI's order is height, width, length
    values = [*box.size[[2, 1, 0]], *bottom, math.atan2(tip[1] - bottom[1], tip[0] - bottom[0])]
    words = " ".join(f"{value:.6f}" for value in values)
    return f"{number} {box.track} {LABELS[box.kind][0]} -1 -1 -10 -1 -1 -1 -1 {words}\n"


def matrix_of(pose: Pose) -> Floats:
    """Return the pose as a matrix (4, 4), from the sensor's frame to the world's."""
    matrix, turn = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(turn, pose.quaternion)
    matrix[:3, :3], matrix[:3, 3] = turn.reshape(3, 3), pose.position
    return matrix


def _rows(scans: Iterable[LogScan]) -> Iterator[Row]:
    """Yield the messages of each scan: its cloud, and the sensor's transform."""
    for number, scan in enumerate(scans):
        transform = {
            "translation": dict(zip("xyz", scan.pose.position, strict=True)),
            "rotation": dict(zip("wxyz", scan.pose.quaternion, strict=True)),
        }
        header = _header(scan.time_s, FRAME)
        link = {"header": header, "child_frame_id": SENSOR, "transform": transform}
        cloud = points_message(scan.points, _header(scan.time_s, SENSOR), **scan.more)
        messages = {"tf": (TRANSFORMS, {"transforms": [link]}), "points": (CLOUD, cloud)}
        if "mover" in scan.more:
            messages["movers"] = (MARKERS, {"markers": [*map(_marker, scan.boxes)]})
        yield number, round(scan.time_s * 1e9), messages


def _header(time_s: float, frame: str) -> dict[str, Any]:
    # rounded once, so that both parts are of the same moment
    stamp = dict(zip(("sec", "nanosec"), divmod(round(time_s * 1e9), 10**9), strict=True))
    return {"stamp": stamp, "frame_id": frame}


def _marker(box: Box) -> dict[str, Any]:
    """Return a box as a Marker: a cube, at the time and place where the mover was."""
    place = Pose.level(box.bottom + box.size * (0.0, 0.0, 0.5), box.yaw)
    position, orientation = (
        dict(zip(axes, values, strict=True))
        for axes, values in (("xyz", place.position), ("wxyz", place.quaternion))
    )
    return {
        "header": _header(box.time_s, FRAME),
        "ns": box.kind,
        "id": box.track,
        "type": CUBE,
        "pose": {"position": position, "orientation": orientation},
        "scale": dict(zip("xyz", box.size, strict=True)),
        "color": COLOUR,
    }
