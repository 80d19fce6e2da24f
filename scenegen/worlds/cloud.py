"""Maps of point clouds: voxels with points are occupied, those that rays from sensor to point cross
are free."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lidarsim.engines.voxels import FREE, OCCUPIED, VoxelMap
from lidarsim.grid import Floats
from lidarsim.jit import kernel
from lidarsim.parameters import MIN_RETURN_M, Checked, number
from lidarsim.pose import Pose, rotate
from lidarsim.scan import are_returns
from lidarsim.voxelization import clear
from scenegen.base.errors import SceneError
from scenegen.base.limits import MAX_CLOUD_BYTES, MAX_PLACE_VOXELS
from scenegen.worlds.clouds import Cloud, ReadReport, check_scan, read_cloud
from scenegen.worlds.poses import has_camera, read_numbers, read_poses

FAR_M, STEP_M = 1e4, 1e3
"""Coordinates beyond the first, as those of surveys are, become smaller by a multiple of the
second."""
Placement: TypeAlias = Pose | Floats
"""The pose of a sensor in whose frame the points are; or where it was, (1, 3), in the frame of the
points."""
FARTHEST_M = 1e12
"""Points and rays beyond this lie in no map, metres."""


@dataclass(frozen=True, kw_only=True)
class Survey(Checked):
    """Parameters of how clouds are read and mapped."""

    voxel_m: float = number(0.2, minimum=1e-3, maximum=1e3)
    """Edge of the map's voxels, metres; their boundaries are multiples of it."""
    unit_m: float = number(1.0, minimum=1e-6, maximum=1e3)
    """The unit of the file's lengths, metres."""
    up: Literal["z", "y"] = "z"
    """The file's axis that points up. If it is y, its z becomes the map's -y."""
    least_m: float = number(MIN_RETURN_M, minimum=0, maximum=100)
    """Minimum range of a return, metres."""
    height_m: float = number(3.0, above=0, maximum=1e3)
    """Height of the walls of a plan, metres."""
    assume_free: bool = False
    """Whether voxels above the lowest occupied one of their column are free, unless occupied."""


@dataclass(frozen=True, eq=False)
class CloudMap:
    """A map, and its sources."""

    voxels: VoxelMap
    """The map."""
    offset: Floats
    """(3,): subtracted from the file's coordinates, metres."""
    points: int
    """Count of points in the map; of a floor plan, its known cells."""
    read: str
    """A line for people about the files."""


def map_clouds(
    files: Sequence[Path],
    survey: Survey | None = None,
    *,
    sensor: Sequence[float] | None = None,
    poses: Path | None = None,
    box: Sequence[float] | None = None,
    columns: int | None = None,
) -> CloudMap:
    """Make one map of several clouds of one place. A voxel with both points and rays is occupied.

    Every file is read twice, unless it is the only one: for the map's size, and for its points.

    Args:
        files: Files that `scenegen.worlds.clouds.read_cloud` reads.
        survey: How they are read and mapped.
        sensor: Where the sensor was, (3,), in the frame and the unit of the points.
        poses: A file with a line for each of `files`: the sensor's position; or its pose, as
            `read_poses` reads it, if the points are in the sensor's own frame.
        box: The least and the greatest corner of the map, (6,), in the points' frame and unit; None
            for the box around all points and sensors.
        columns: See `scenegen.worlds.clouds.read_cloud`.

    Returns:
        The map.

    Raises:
        SceneError: If free space cannot be determined, the map would be too large, or there is no
            point.
        DatasetError: If a file cannot be read, or holds points that no sensor returns.
    """
    survey = survey or Survey()
    placements: Sequence[Placement | None] = [
        None if sensor is None else np.array([sensor], float)
    ] * len(files)
    if poses is not None:
        placements = _read_poses(poses, files)

    @functools.lru_cache(maxsize=1)
    def read(index: int) -> _Returns:
        cloud = read_cloud(files[index], MAX_CLOUD_BYTES, columns=columns)
        name = str(files[index])
        return _returns(cloud, placements[index], survey, name, is_boxed=box is not None)

    if box is None:
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        # the first reading, for the extent of all points and sensors
        for part in (part for index in range(len(files)) for part in read(index)[:2]):
            finite = part[np.isfinite(part).all(axis=1)]
            low = np.minimum(low, finite.min(axis=0, initial=np.inf))
            high = np.maximum(high, finite.max(axis=0, initial=-np.inf))
    else:
        corners = _upright(np.array(box, float).reshape(2, 3), survey)
        low, high = corners.min(axis=0), corners.max(axis=0)
    where = f"{files[0]}" + (f" and {len(files) - 1} more" if len(files) > 1 else "")
    infinite = f"{where}: no point in it is finite; expected x, y and z in metres"
    if not np.isfinite([low, high]).all():
        raise SceneError(infinite)
    offset = np.where(np.abs(low) > FAR_M, np.floor(low / STEP_M) * STEP_M, 0.0)
    states, origin = _empty_map(low - offset, high - offset, survey.voxel_m, where)
    # apart from the states: rays of later files must not clear points of earlier ones
    occupied = np.zeros(states.shape, bool)
    points, report = 0, ReadReport()
    for index in range(len(files)):
        # the second reading; a single file is still cached
        seen = read(index)
        report.add(seen.recorded, seen.layout, seen.recorded - len(seen.points))
        points += _carve(
            seen.points - offset,
            seen.origins - offset,
            origin,
            survey.voxel_m,
            states.reshape(-1),
            occupied,
        )
    if not points:
        outside = f"{where}: no point in it lies in the box; give a --box that holds some"
        # without a box, the sensor alone has given the map its extent
        raise SceneError(infinite if box is None else outside)
    if survey.assume_free:
        # above the lowest point of each column; occupied voxels are set after
        states[np.logical_or.accumulate(occupied, axis=2)] = FREE
    states[occupied] = OCCUPIED
    return CloudMap(VoxelMap(states, survey.voxel_m, origin), offset, points, str(report))


class _Returns(NamedTuple):
    """The returns of a file, in the map's axes, metres."""

    points: Floats
    """(N, 3)."""
    origins: Floats
    """Where they were seen from: (N, 3), (1, 3) the same for all, or (0, 3) if unknown."""
    layout: str
    """See `Cloud`."""
    recorded: int
    """Points in the file, returns and others."""


def _returns(
    cloud: Cloud, placement: Placement | None, survey: Survey, where: str, *, is_boxed: bool
) -> _Returns:
    """Select the returns of a cloud, and move them to the map's axes.

    Points without a return are dropped in the sensor's frame, before points are moved. If the
    sensor's place is unknown, all finite points are returns: 0 0 0 is a place in a registered
    cloud.

    Args:
        cloud: The points of a file.
        placement: None if the cloud itself says where the sensor was.
        survey: How it is read.
        where: The file, for errors.
        is_boxed: Whether far points are cut off anyway.

    Raises:
        SceneError: If the sensor's place is unknown, and nothing is assumed to be free.
        DatasetError: If a point is farther from its sensor than any return.
    """
    points, pose, origins = cloud.points, None, cloud.origins
    if isinstance(placement, Pose):
        pose, origins = placement, np.zeros((1, 3))
    elif placement is not None:
        origins = placement
    if origins is None:
        if not survey.assume_free:
            raise SceneError(
                f"{where}: does not say where its sensor was, so nothing in it is known to be "
                "free; give scenegen map --sensor or --poses, or --assume-free for all above the "
                "ground"
            )
        points = points[np.isfinite(points).all(axis=1)]
        return _Returns(_upright(points, survey), np.zeros((0, 3)), cloud.layout, len(cloud.points))
    rows, starts = points * survey.unit_m, origins * survey.unit_m
    if not is_boxed:
        check_scan(rows, starts, where)
    # in metres, as the minimum range is; `points` keep the file's unit
    returned = are_returns(rows, starts, survey.least_m)
    points = points[returned]
    if pose is not None:
        points = rotate(pose.quaternion, points) + pose.position
        origins = pose.position[None]
    elif len(origins) > 1:
        origins = origins[returned]
    return _Returns(
        _upright(points, survey), _upright(origins, survey), cloud.layout, len(cloud.points)
    )


def _read_poses(path: Path, files: Sequence[Path]) -> Sequence[Placement]:
    """Read the placement of each file's sensor. Raises DatasetError and SceneError."""
    names, rows = read_numbers(path)
    placements: Sequence[Placement]
    if not names and rows.shape[1] == 3:
        placements = list(rows[:, None])
    else:
        placements = read_poses(path, timed=False).poses
        # KITTI puts it beside the folder of clouds
        calibration = files[0].resolve().parent.parent / "calib.txt"
        if not names and rows.shape[1] == 12 and has_camera(calibration):
            raise SceneError(
                f"{path}: has matrices as KITTI's, and {calibration} a Tr, so they may be those of "
                "its camera; use scenegen ingest, or give the sensor's poses as TUM writes them"
            )
    if len(placements) != len(files):
        raise SceneError(
            f"{path}: {len(placements)} poses, expected {len(files)}, one for each file of points"
        )
    return placements


def _upright(points: Floats, survey: Survey) -> Floats:
    """Convert points (N, 3) of a file to metres, z up."""
    if survey.up == "y":
        # a quarter turn about x
        points = np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)
    return points * survey.unit_m


def _empty_map(
    low: Floats, high: Floats, voxel_m: float, where: str
) -> tuple[NDArray[np.uint8], Floats]:
    """Make unknown states that hold everything from `low` to `high`; and their least corner."""
    origin = np.floor(low / voxel_m) * voxel_m
    origin -= np.where(origin > low, voxel_m, 0.0)  # by rounding
    shape = np.floor((high - origin) / voxel_m) + 1.0
    # False for infinite and NaN products, too
    if not shape.prod() <= MAX_PLACE_VOXELS:
        raise SceneError(
            f"{where}: {' × '.join(f'{edge:.6g}' for edge in shape)} voxels of {voxel_m:g} m, "
            f"expected {MAX_PLACE_VOXELS} at most; give a larger --voxel, or a --box that leaves "
            "far points out"
        )
    return np.zeros(shape.astype(int), np.uint8), origin


@kernel
def _carve(points, sensors, origin, voxel_m, states, occupied):
    """Mark voxels with points as `occupied`, and those on their rays as free in the flat `states`.

    `points` are (N, 3), `sensors` none, one, or N of them. Returns the count of points in the map.
    """
    nx, ny, nz = occupied.shape
    inside = 0
    for n in range(len(points)):
        x, y, z = points[n]
        # False for NaN; farther ones would overflow the whole numbers below
        if not abs(x) + abs(y) + abs(z) < FARTHEST_M:
            continue
        i = math.floor((x - origin[0]) / voxel_m)
        j = math.floor((y - origin[1]) / voxel_m)
        k = math.floor((z - origin[2]) / voxel_m)
        if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
            occupied[i, j, k] = True
            inside += 1
        if len(sensors) > 0:
            start = sensors[n if len(sensors) > 1 else 0]
            dx, dy, dz = x - start[0], y - start[1], z - start[2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if 0.0 < length < FARTHEST_M:
                ray = (dx / length, dy / length, dz / length)
                clear(start, ray, length, origin, voxel_m, nx, ny, nz, states)
    return inside
