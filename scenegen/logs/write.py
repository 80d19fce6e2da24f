"""Logs on disk: in the layout of KITTI's odometry benchmark, or as MCAP with ROS 2 messages."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from scenegen.clouds.write import encode_points
from scenegen.files import check_free, make_way, whole, whole_folder
from scenegen.logs import LogScan
from scenegen.logs.messages import (
    CLOUD,
    TRANSFORMS,
    Row,
    points_message,
    write_messages,
)
from scenegen.run import Counted, unheard

FRAME, SENSOR = "map", "lidar"
"""ROS frames: the world's, and the sensor's."""
CALIBRATION = "".join(f"{name}: 1 0 0 0 0 1 0 0 0 0 1 0\n" for name in ("P0", "Tr"))
"""A KITTI calibration whose camera is the sensor: poses are the sensor's own."""


def write_log(out: Path, scans: Iterable[LogScan], on_done: Counted = unheard) -> dict[str, int]:
    """Write a log, whole or not at all: a file where `out` ends in .mcap, a folder otherwise.

    A folder holds ``velodyne/000000.bin`` (x, y, z, intensity as float32; intensity is 0 where none
    is known), ``times.txt``, ``poses.txt`` and ``calib.txt`` as KITTI has them (Geiger et al.
    2012), in the world's frame, and the same poses as ``poses.tum`` (time, position, quaternion x,
    y, z, w). A file has PointCloud2 on ``/points``, with `ring`, `t` and `intensity` where known,
    and the sensor's transforms in the world on ``/tf``. `on_done` is called with 1 for each.

    Returns:
        How many `scans` and `returns` were written.

    Raises:
        DatasetError: There is something at `out` already, or the disk refuses.
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
        content = encode_points(".bin", scan.points, scan.more.get("intensity"))
        (folder / "velodyne" / f"{number:06d}.bin").write_bytes(content)
        w, *vector = scan.pose.quaternion
        tables["times.txt"].append(scan.time_s)
        tables["poses.txt"].append(matrix_of(scan.pose)[:3].reshape(-1))
        tables["poses.tum"].append([scan.time_s, *scan.pose.position, *vector, w])
    for name, rows in tables.items():
        np.savetxt(folder / name, rows, "%.12g")


def matrix_of(pose: Pose) -> Floats:
    """The pose as a matrix (4, 4): from the sensor's frame to the world's."""
    matrix, turn = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(turn, pose.quaternion)
    matrix[:3, :3], matrix[:3, 3] = turn.reshape(3, 3), pose.position
    return matrix


def _rows(scans: Iterable[LogScan]) -> Iterator[Row]:
    """The messages of each scan."""
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
