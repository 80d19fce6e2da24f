"""Recordings of real sensors in public repositories, as logs that `scenegen ingest` reads.

    python benchmarks/recordings.py room tsdf-fusion-python/data room    # a Kinect in a room
    python benchmarks/recordings.py laser 3DTK/dat laser                 # a laser on a robot
    python benchmarks/recordings.py flow val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede sweeps
    scenegen ingest room -o room-map
    python benchmarks/real.py MAPS --recordings FOLDER                   # both logs in FOLDER

`room` is 1000 depth frames with poses, of the 7-Scenes data set (for research alone), as
`andyzeng/tsdf-fusion-python` keeps them. Every fourth pixel of a row and a column is taken. Its
poses do not know what is up: the direction near the cameras' in which most points lie on levels.
`laser` is three scans of a tilting SICK scanner with the robot's own odometry, from `3DTK/3DTK`.
`flow` is two sweeps of Argoverse 2 (Wilson et al. 2021) from the tests of `argoverse/av2-api`, with
labels that say which points of the first one move. It also prints which points and voxels `ingest
--moved-share` drops. Rays are taken to begin at the upper of two lidars.
"""

import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import measuring
import numpy as np
import pandas as pd
from PIL import Image
from scipy.spatial.transform import Rotation
from tyro.conf import Positional

from lidarsim import Pose
from lidarsim.engines.voxels import FREE
from lidarsim.grid import Floats, Mask
from lidarsim.pose import chained, rotate
from scenegen.logs import Fusing, LogScan
from scenegen.logs.fuse import ingest
from scenegen.logs.read import read_log
from scenegen.logs.record import write_log
from scenegen.worlds.place import read_place
from scenegen.worlds.poses import pose_of_matrix, poses_of

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

PLACE = ["tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"]
"""Argoverse's names of a pose's numbers."""
SHARES = (0.0, 0.2, 0.49, 0.51)
"""Values of --moved-share; of two scans, one is a half."""


class Options(measuring.Options):
    """What is made of what."""

    recording: Positional[Literal["room", "laser", "flow"]]
    source: Positional[Path]
    """the folder with its files"""
    out: Positional[Path]
    """where the log is written"""


def main() -> None:
    """Write the log."""
    given = measuring.parse(Options)
    scans = {"room": room, "laser": laser, "flow": flow}[given.recording]
    print(write_log(given.out, scans(given.source)))
    if given.recording == "flow":
        labels = pd.read_feather(given.source / "flow_labels.feather")["dynamic"].to_numpy()
        for share in SHARES:
            print(f"moved-share {share:g}: {dropped(given.out, labels, share)}")


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


def flow(source: Path) -> Iterator[LogScan]:
    """Sweeps in the vehicle's frame, corrected for its motion; the first one is at 0 0 0."""
    track = pd.read_feather(source / "city_SE3_egovehicle.feather").set_index("timestamp_ns")
    mounts = pd.read_feather(source / "calibration" / "egovehicle_SE3_sensor.feather")
    mount = mounts.set_index("sensor_name").loc["up_lidar", PLACE[:3]].to_numpy(float)
    sweeps = sorted((source / "sensors" / "lidar").glob("*.feather"))
    times = [int(sweep.stem) for sweep in sweeps]
    poses = poses_of(track.loc[times, PLACE].to_numpy(), str(source))
    for time, sweep, pose in zip(times, sweeps, poses, strict=True):
        vehicle = Pose(pose.position - poses[0].position, pose.quaternion)
        points = pd.read_feather(sweep)[["x", "y", "z"]].to_numpy(float)
        yield LogScan((time - times[0]) / 1e9, chained(vehicle, Pose.level(mount)), points - mount)


def dropped(path: Path, moves: Mask, share: float) -> str:
    """Precision and recall of what `ingest` drops of a log's first scan, for which `moves` (N,)
    says which points move: of points, and of voxels that hold nothing but such points."""
    scan, how = next(read_log(path).scans()), Fusing(moved_share=share)
    with tempfile.TemporaryDirectory() as folder:
        ingest(read_log(path), Path(folder, "maps"), how)
        voxels = read_place(Path(folder, "maps", "place-000.npz")).voxels
    within = np.linalg.norm(scan.points, axis=1) < how.reach_m
    points = rotate(scan.pose.quaternion, scan.points[within]) + scan.pose.position
    index = np.floor((points - voxels.origin) / voxels.voxel_m).astype(int)
    mapped = ((index >= 0) & (index < voxels.states.shape)).all(axis=1)
    index, moves = index[mapped], moves[within][mapped]
    cells, of_point = np.unique(index, axis=0, return_inverse=True)
    standing = np.zeros(len(cells), bool)
    standing[of_point[~moves]] = True
    cell_gone = voxels.states[tuple(cells.T)] == FREE
    rows = {"points": (cell_gone[of_point], moves), "voxels": (cell_gone, ~standing)}
    return "; ".join(
        f"{len(gone)} {name}, {np.count_nonzero(real)} move, {np.count_nonzero(gone)} dropped, "
        f"{np.count_nonzero(gone & real)} both"
        for name, (gone, real) in rows.items()
    )


if __name__ == "__main__":
    main()
