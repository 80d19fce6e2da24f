"""Maps of the places of `places.toml`, made of public repositories.

    python benchmarks/places.py SOURCES MAPS

SOURCES holds a clone of each repository, with git's own name for its folder: `git clone
https://github.com/OWNER/NAME`. A file with other bytes than were measured is refused, and a source
that is missing is left out. MAPS gets a map of each place, and in `logs` the scans of those that
were made of scans. Then it is printed how much of the stand's surface each platform lacks.
"""

import importlib
import itertools
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import measuring
import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation
from tyro.conf import Positional

from lidarsim.engines.voxels import OCCUPIED
from lidarsim.grid import Floats, Mask
from scenegen.logs import LogScan
from scenegen.logs.record import write_log
from scenegen.worlds.cloud import Survey, map_clouds
from scenegen.worlds.clouds import read_cloud
from scenegen.worlds.poses import pose_of_matrix

PLACES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
PLATFORMS = "MLS", "UAS", "ALS"
"""They saw one stand."""
SCAN_S = 0.1
STRIDE = 4
"""Of so many pixels in a row and in a column, one is taken."""
FRAMES = 10
"""Of so many frames of the room, one is taken."""
FAR_M = 4.0
"""A Kinect's error beyond is several centimetres."""
LASER_FAR_M = 30.0
"""The scanner says 32.76 m where nothing returned."""
CELL_M, NEAR_M = 0.2, 2.0
"""Of the alignment: the size of its cells, and how far a pair of points may be apart."""
TILTS_DEG = np.arange(-30.0, 31.0, 1.0)
"""In which what is up is looked for, around the first guess."""
LEVEL_M = 0.02
"""Points of a level are that near each other."""
TO_LEFT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From 3DTK's axes (right, up, forward) to forward, left, up."""
Seen = list[tuple[Floats, Floats]]
"""Poses (4, 4) of a sensor, and what it saw from each: points (N, 3) in its frame, metres."""


class Options(measuring.Options):
    """What is made of what."""

    sources: Positional[Path]
    """folder of the clones"""
    maps: Positional[Path]
    """where maps are written"""


def main() -> None:
    """Make what is not there yet."""
    given = measuring.parse(Options)
    given.maps.mkdir(parents=True, exist_ok=True)
    for name, about in PLACES.items():
        files = files_of(given.sources / Path(about["source"]).name, about["files"])
        if not files:
            print(f"{name}: is not in {given.sources}; clone https://github.com/{about['source']}")
            continue
        digest = digest_of(files)
        if digest != about["sha256"]:
            sys.exit(f"{name}: its files have the SHA-256 {digest}, expected {about['sha256']}")
        make(name, about["made"].split(), files, given.maps)
    folder = given.sources / "spanner"
    if folder.is_dir():
        print("\n".join(lacking(folder / "inst/extdata")))


def files_of(folder: Path, patterns: list[str]) -> list[Path]:
    """The files of a clone that a place is made of."""
    return [file for pattern in patterns for file in sorted(folder.glob(pattern))]


def digest_of(files: list[Path]) -> str:
    """The SHA-256 of the bytes of all files."""
    total = sha256()
    for file in files:
        total.update(file.read_bytes())
    return total.hexdigest()


def make(name: str, made: list[str], files: list[Path], maps: Path) -> None:
    """Make the map of a place, as its entry says: see `places.toml`."""
    how, *words = made
    out = maps / f"{name}{files[0].suffix if how == 'as' else '.npz'}"
    if out.exists():
        return
    if how == "as":
        shutil.copyfile(files[0], out)
    elif how == "map":
        measuring.command(f"map {' '.join(words)} --quiet -o", out, *files)
    else:
        reader, *options = words
        log = maps / "logs" / name
        if not log.exists():
            log.parent.mkdir(exist_ok=True)
            seen = READERS[reader](files)
            poses = [pose_of_matrix(pose[:3].reshape(-1), name) for pose, _ in seen]
            steps = enumerate(zip(poses, seen, strict=True))
            write_log(log, (LogScan(n * SCAN_S, pose, one[1]) for n, (pose, one) in steps))
        with tempfile.TemporaryDirectory() as folder:
            measuring.command(f"ingest {' '.join(options)} --quiet -o", Path(folder, "out"), log)
            shutil.move(Path(folder, "out", "place-000.npz"), out)


def aligned(files: list[Path]) -> Seen:
    """Scans without poses, each aligned to the one before by GICP."""
    small_gicp = importlib.import_module("small_gicp")  # MIT, from PyPI; nothing else needs it
    scans, poses, step = [*map(points_in, files)], [np.eye(4)], np.eye(4)
    for before, scan in itertools.pairwise(scans):
        found = small_gicp.align(
            before,
            scan,
            step,
            downsampling_resolution=CELL_M,
            max_correspondence_distance=NEAR_M,
        )
        step = found.T_target_source
        poses.append(poses[-1] @ step)
    return [*zip(poses, scans, strict=True)]


def points_in(file: Path) -> Floats:
    """The points (N, 3) of a cloud, or of a VTK file with text."""
    if file.suffix == ".vtk":
        _, after = file.read_text().split("POINTS", 1)
        count, _, *numbers = after.split()
        return np.array(numbers[: 3 * int(count)], float).reshape(-1, 3)
    points = read_cloud(file).points
    return points[np.isfinite(points).all(axis=1)]


def level(files: list[Path]) -> Seen:
    """As `aligned`, of a sensor that was tilted."""
    return levelled(aligned(files), np.array([0.0, 0.0, 1.0]))


def graph(files: list[Path]) -> Seen:
    """Scans of gtsam_points: x y z as float32, and lines of name, position and quaternion."""
    *clouds, poses = files
    seen = []
    for file, line in zip(clouds, poses.read_text().splitlines(), strict=True):
        numbers = np.array(line.split()[1:], float)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(numbers[3:]).as_matrix()
        pose[:3, 3] = numbers[:3]
        seen.append((pose, np.fromfile(file, np.float32).reshape(-1, 3).astype(float)))
    return seen


def laser(files: list[Path]) -> Seen:
    """Scans in centimetres, and the robot's pose: a position, and angles about x, y and z."""
    seen = []
    for file in files[: len(files) // 2]:
        points = np.loadtxt(file, usecols=(0, 1, 2)) / 100
        position, angles = np.loadtxt(file.with_suffix(".pose"))
        pose = np.eye(4)
        turn = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
        pose[:3, :3] = TO_LEFT @ turn @ TO_LEFT.T
        pose[:3, 3] = TO_LEFT @ position / 100
        near = (points**2).sum(axis=1) < LASER_FAR_M**2
        seen.append((pose, points[near] @ TO_LEFT.T))
    return seen


def room(files: list[Path]) -> Seen:
    """Frames of a depth camera: millimetres, and the camera's pose, x right and z forward."""
    focal = np.loadtxt(files[-1])
    rows, columns = np.mgrid[0:480:STRIDE, 0:640:STRIDE]
    ahead = np.full(rows.shape, focal[0, 0])
    rays = np.dstack([columns - focal[0, 2], rows - focal[1, 2], ahead]) / focal[0, 0]
    seen = []
    for frame in files[: len(files) // 2 : FRAMES]:
        pixels = np.asarray(Image.open(frame), np.float64)
        depth = pixels[::STRIDE, ::STRIDE] / 1000
        pose = np.loadtxt(frame.with_name(frame.name.replace("depth.png", "pose.txt")))
        seen.append((pose, (rays * depth[..., None])[(depth > 0) & (depth < FAR_M)]))
    return levelled(seen, np.mean([-pose[:3, 1] for pose, _ in seen], axis=0))


def levelled(seen: Seen, up: Floats) -> Seen:
    """Turn poses so that z points up: of all directions near `up` (3,) the one in which most pairs
    of points lie on a level."""
    points = np.concatenate([points @ pose[:3, :3].T + pose[:3, 3] for pose, points in seen])
    aside = np.cross(up, [1.0, 0.0, 0.0])
    leant = (
        up + one * aside + other * np.cross(up, aside)
        for one, other in itertools.product(np.tan(np.radians(TILTS_DEG)), repeat=2)
    )

    def pairs(tried: Floats) -> int:
        heights = points[::40] @ tried
        bins = np.arange(heights.min(), heights.max() + LEVEL_M, LEVEL_M)
        return int((np.histogram(heights, bins)[0] ** 2).sum())

    best = max((tried / np.linalg.norm(tried) for tried in leant), key=pairs)
    ahead = np.cross(best, aside) / np.linalg.norm(np.cross(best, aside))
    turn = np.eye(4)
    turn[:3, :3] = ahead, np.cross(best, ahead), best
    return [(turn @ pose, points) for pose, points in seen]


READERS = {"aligned": aligned, "graph": graph, "laser": laser, "level": level, "room": room}


def lacking(folder: Path) -> Iterator[str]:
    """How much of the surface that one platform saw of the stand each other one lacks: lines."""
    files = {name: folder / f"{name}_Clip.laz" for name in PLATFORMS}
    clouds = [read_cloud(file).points for file in files.values()]
    low = np.max([one.min(axis=0) for one in clouds], axis=0)
    high = np.min([one.max(axis=0) for one in clouds], axis=0)

    def surface(file: Path) -> Mask:
        survey = Survey(assume_free=True)
        return map_clouds([file], survey, box=[*low, *high]).voxels.states == OCCUPIED

    seen = {name: surface(file) for name, file in files.items()}
    for one, other in itertools.permutations(PLATFORMS, 2):
        near = ndimage.binary_dilation(seen[other], np.ones((3, 3, 3)))
        share = (seen[one] & ~near).sum() / seen[one].sum()
        yield f"{one}: {seen[one].sum()} occupied voxels; {other} has none near {share:.0%} of them"


if __name__ == "__main__":
    main()
