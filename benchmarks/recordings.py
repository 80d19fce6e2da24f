"""Recordings of real sensors in public repositories, as logs that `scenegen ingest` reads.

    python benchmarks/recordings.py room tsdf-fusion-python/data room    # a Kinect in a room
    python benchmarks/recordings.py laser 3DTK/dat laser                 # a laser on a robot
    scenegen ingest room -o room-map
    python benchmarks/real.py MAPS --recordings FOLDER                   # both logs in FOLDER

`room` is 1000 depth frames with poses, of the 7-Scenes data set (for research alone), as
`andyzeng/tsdf-fusion-python` keeps them. Every fourth pixel of a row and a column is taken. Its
poses do not know what is up: the direction near the cameras' in which most points lie on levels.
`laser` is three scans of a tilting SICK scanner with the robot's own odometry, from `3DTK/3DTK`.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import measuring
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from tyro.conf import Positional

from lidarsim.grid import Floats
from scenegen.logs import LogScan
from scenegen.logs.record import write_log
from scenegen.worlds.poses import pose_of_matrix

STRIDE = 4
"""Of so many pixels in a row and in a column, one is taken."""
FAR_M = 4.0
"""A Kinect's error beyond is several centimetres."""
FRAME_S = 1 / 30
LASER_FAR_M = 30.0
"""The scanner says 32.76 m where nothing returned."""
TILTS_DEG = np.arange(-30.0, 31.0, 1.0)
"""In which what is up is looked for, around the mean of the cameras' own."""
LEVEL_M = 0.02
"""Points of a level are that near each other."""
TO_LEFT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From 3DTK's axes (right, up, forward) to forward, left, up."""


class Options(measuring.Options):
    """What is made of what."""

    recording: Positional[Literal["room", "laser"]]
    source: Positional[Path]
    """the folder with its files"""
    out: Positional[Path]
    """where the log is written"""


def main() -> None:
    """Write the log."""
    given = measuring.parse(Options)
    scans = room if given.recording == "room" else laser
    print(write_log(given.out, scans(given.source)))


def room(source: Path) -> Iterator[LogScan]:
    """Frames of a depth camera: millimetres, and the camera's pose, x right and z forward."""
    focal = np.loadtxt(source / "camera-intrinsics.txt")
    rows, columns = np.mgrid[0:480:STRIDE, 0:640:STRIDE]
    ahead = np.full(rows.shape, focal[0, 0])
    rays = np.dstack([columns - focal[0, 2], rows - focal[1, 2], ahead]) / focal[0, 0]
    frames = sorted(source.glob("*.depth.png"))

    def seen(frame: Path) -> tuple[Floats, Floats]:
        pixels = np.asarray(Image.open(frame), np.float64)
        depth = pixels[::STRIDE, ::STRIDE] / 1000
        pose = np.loadtxt(frame.with_name(frame.name.replace("depth.png", "pose.txt")))
        return pose, (rays * depth[..., None])[(depth > 0) & (depth < FAR_M)]

    turn = _levelled([seen(frame) for frame in frames[:: max(len(frames) // 50, 1)]])
    for number, frame in enumerate(frames):
        pose, points = seen(frame)
        yield LogScan(
            number * FRAME_S, pose_of_matrix((turn @ pose)[:3].reshape(-1), str(frame)), points
        )


def _levelled(seen: list[tuple[Floats, Floats]]) -> Floats:
    """The turn (4, 4) after which z points up: of all directions near the cameras' own the one in
    which most pairs of points lie on a level."""
    up = np.mean([-pose[:3, 1] for pose, _ in seen], axis=0)
    points = np.concatenate([points @ pose[:3, :3].T + pose[:3, 3] for pose, points in seen])
    aside = np.cross(up, [1.0, 0.0, 0.0])
    leant = (
        up + one * aside + other * np.cross(up, aside)
        for one, other in itertools.product(np.tan(np.radians(TILTS_DEG)), repeat=2)
    )

    def pairs(tried: Floats) -> int:
        heights = points[::20] @ tried
        bins = np.arange(heights.min(), heights.max() + LEVEL_M, LEVEL_M)
        return int((np.histogram(heights, bins)[0] ** 2).sum())

    best = max((tried / np.linalg.norm(tried) for tried in leant), key=pairs)
    ahead = np.cross(best, aside) / np.linalg.norm(np.cross(best, aside))
    turn = np.eye(4)
    turn[:3, :3] = ahead, np.cross(best, ahead), best
    return turn


def laser(source: Path) -> Iterator[LogScan]:
    """Scans in centimetres, and the robot's pose: a position, and angles about x, y and z."""
    for number, file in enumerate(sorted(source.glob("*.3d"))):
        points = np.loadtxt(file, usecols=(0, 1, 2)) / 100
        position, angles = np.loadtxt(file.with_suffix(".pose"))
        pose = np.eye(4)
        turn = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
        pose[:3, :3] = TO_LEFT @ turn @ TO_LEFT.T
        pose[:3, 3] = TO_LEFT @ position / 100
        near = (points**2).sum(axis=1) < LASER_FAR_M**2
        yield LogScan(
            float(number), pose_of_matrix(pose[:3].reshape(-1), str(file)), points[near] @ TO_LEFT.T
        )


if __name__ == "__main__":
    main()
