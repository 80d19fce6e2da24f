"""Scans, logs, maps and worlds as samples for display, so that one page shows them all.

Each function takes a path and returns `Look`s in a box that holds what there is to see. Voxels are
as small as a page allows. What is thinned or left out is said in the look's `missing`.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.grid import MAX_EDGE, Floats, GridSpec, Mask
from lidarsim.pose import rotate
from lidarsim.voxelization import sort_points
from scenegen.base.errors import DatasetError
from scenegen.base.limits import MAX_ASSET_BYTES
from scenegen.base.paths import is_map
from scenegen.base.reading import read_bounded
from scenegen.view.look import Look, Timeline, evenly

MAX_POINTS = 150_000
"""Maximum points of a scan on a page, which draws each as a dot; more are thinned."""
MAX_FRAMES = 60
"""Maximum scans of a log or a folder on a page, evenly spread."""
MAX_CELLS = 1 << 20
"""Maximum voxels of a box that is chosen here: a page draws each as a cube."""
EDGES_M = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 25.0, 100.0, 1000.0)
"""Edges of voxels that are tried, metres."""
SHARE = 0.95
"""Share of the returns that lie within the box of a log's scan; single far ones would make its
voxels coarse."""
MIN_REACH_M = (5.0, 5.0, 2.0)
"""Least distance along x, y and z from a log's sensor to the faces of its box, metres: a first scan
may be of a wall near by."""
SLACK_M = 0.01
"""Solids that reach so little beyond a box do not count, metres."""
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
"""Attitude of a sensor whose attitude is not known."""


def looks_of_scan(path: Path, columns: int | None = None) -> list[Look]:
    """Read the scan of a file, in the frame of its sensor.

    Args:
        path: A point cloud, see `scenegen.worlds.clouds.READERS`.
        columns: See `scenegen.worlds.clouds.read_cloud`.

    Raises:
        DatasetError: The file cannot be read, or has no returns.
    """
    from scenegen.worlds.clouds import read_cloud

    cloud = read_cloud(path, columns=columns)
    returns = cloud.points[cloud.returned]
    if not len(returns):
        raise DatasetError(f"{path}: none of its points is a return")
    kept, notes = _thinned(returns, path.name)
    low, high = returns.min(axis=0), returns.max(axis=0)
    position: Floats = np.zeros(3)
    rays = len(cloud.points)
    to_box_m, diagonal_m = np.linalg.norm([np.clip(position, low, high), high - low], axis=1)
    # at least a metre, since a single point has no diagonal
    if to_box_m > max(float(diagonal_m), 1.0):
        # map coordinates, such as UTM: nobody knows where the sensor was
        position, rays = (low + high) / 2, 0
        notes.append(f"{path.name}: its points are far from 0 0 0, so the sensor is not drawn")
    # a metre around the sensor at least, so that a flat scan has a box
    low, high = np.minimum(low, position - 1.0), np.maximum(high, position + 1.0)
    grid, origin = box_around(low, high)
    return [
        Look(
            name=path.name,
            grid=grid,
            origin=origin,
            position=position,
            quaternion=LEVEL,
            masks={"observed": _cells(returns, grid, origin)},
            scans=[kept],
            rays=rays,
            missing=tuple(notes),
        )
    ]


def looks_of_scans(folder: Path, columns: int | None = None, **reading: Any) -> list[Look]:
    """Read scans of a folder, each in the frame of its sensor, in the order of their names; with
    `poses`, see `looks_of_log`.

    Args:
        folder: A folder with point clouds; of more than `MAX_FRAMES`, some evenly spread.
        columns: See `scenegen.worlds.clouds.read_cloud`.
        reading: Arguments of `read_log`.

    Raises:
        DatasetError: A file cannot be read, has no returns, or is a map.
    """
    from scenegen.worlds.clouds import scans_in

    if reading.get("poses"):
        return looks_of_log(folder, columns=columns, **reading)

    paths = scans_in(folder)
    chosen = [paths[n] for n in evenly(len(paths), MAX_FRAMES)]
    if place := next(filter(is_map, chosen), None):
        raise DatasetError(f"{folder}: holds the map {place}; give that, or a folder of scans only")
    frames = [look for path in chosen for look in looks_of_scan(path, columns)]
    return _noted(frames, len(paths))


def looks_of_log(path: Path, **reading: Any) -> list[Look]:
    """Read scans of a log, each at its pose in the world, in the order of time.

    Args:
        path: A log with poses; of more than `MAX_FRAMES` scans, some evenly spread.
        reading: Arguments of `read_log`.

    Raises:
        DatasetError: The log cannot be read.
    """
    from scenegen.logs.read import read_log

    log = read_log(path, **reading)
    chosen = set(evenly(len(log.times_s), MAX_FRAMES))
    frames, grid = list[Look](), None
    for number, scan in enumerate(log.scans()):
        if number not in chosen:
            continue
        local = scan.points[np.isfinite(scan.points).all(axis=1)]
        if not len(local):
            continue
        if grid is None:  # one size for all, so that a film does not jump
            reach = np.maximum(np.quantile(np.abs(local), SHARE, axis=0), MIN_REACH_M)
            # a square box: the grid keeps the world's axes while the sensor turns
            reach[:2] = reach[:2].max()
            grid, _ = box_around(-reach, reach)
        position = scan.pose.position
        returns = position + rotate(scan.pose.quaternion, local)
        origin = grid.origin_at(position)
        inside, notes = _thinned(returns, f"scan {number}")
        voxels = sort_points(position, returns, grid, origin)
        frames.append(
            Look(
                name=f"{scan.time_s - log.times_s[0]:.2f} s",
                grid=grid,
                origin=origin,
                position=position,
                quaternion=scan.pose.quaternion,
                masks={"observed": voxels.observed, "free": voxels.free},
                scans=[inside],
                rays=len(scan.points),
                missing=tuple(notes),
            )
        )
    if not frames:
        raise DatasetError(f"{path}: none of its scans has a return")
    return _noted(frames, len(log.times_s))


def looks_of_world(path: Path) -> list[Look]:
    """Read a world: the solids of an MJCF file, a mesh or a plan; or the voxels of a map.

    Args:
        path: The file.

    Raises:
        SceneError: The file holds no world.
    """
    from scenegen.draw.source import read_world
    from scenegen.worlds.place import Place

    # a map in which no sensor can be is a map to look at
    if is_map(path):
        return [look_of_world(Place(str(path), read_bounded(path, MAX_ASSET_BYTES)), path.name)]
    return [look_of_world(read_world(path), path.name)]


def look_of_world(world: Any, name: str) -> Look:
    """Make a sample of a world, or of the voxels of a map.

    Args:
        world: A `World`, or a `Place`.
        name: Name for titles.
    """
    from scenegen.worlds.place import Place
    from scenegen.worlds.world import World

    corners = world.flight_bounds.copy()  # its floor is lowered below; the world keeps its own
    surfaces: Any = ()
    timeline, notes = None, list[str]()
    if isinstance(world, Place):
        corners = world.voxels.bounds
    elif isinstance(world, World):
        from scenegen.view.glb import surfaces as surfaces_of

        # flights stay above the ground, but a page has to show what they fly over
        solids = world.solids
        # planes have no lower end to show
        bounded = solids.lower[np.isfinite(solids.lower).all(axis=1)]
        heights = [*bounded[:, 2], *solids.triangles.reshape(-1, 3)[:, 2]]
        corners[0, 2] = min([corners[0, 2], *heights])
        lower, upper = solids.boxes
        beyond = (lower < corners[0] - SLACK_M) | (upper > corners[1] + SLACK_M)
        if count := np.count_nonzero(beyond.any(axis=1) & np.isfinite(lower).all(axis=1)):
            ranges = ", ".join(
                # + 0, so that -0.0 is not printed as -0
                f"{axis} {round(low, 2) + 0:g} to {high:.4g} m"
                for axis, low, high in zip("xyz", *corners, strict=True)
            )
            notes.append(
                f"voxels are drawn where the sensor may fly and below, {ranges}; {count} of "
                f"{len(lower)} solids reach beyond"
            )
        surfaces = surfaces_of(world)
        if movers := world.movers:
            timeline = Timeline(movers=movers, scan_times=np.zeros(1), end_s=movers.period_s)
    grid, origin = box_around(*corners)
    truth = world.truth(grid, origin)
    masks = {"occupancy": truth["occupancy"]}
    if "known" in truth:
        masks["unknown"] = ~truth["known"]
    return Look(
        name=name,
        grid=grid,
        origin=origin,
        position=origin + grid.extent_m / 2,
        quaternion=LEVEL,
        masks=masks,
        known=truth.get("known"),
        surfaces=surfaces,
        timeline=timeline,
        missing=tuple(notes),
    )


def box_around(low: Floats, high: Floats) -> tuple[GridSpec, Floats]:
    """Choose a grid that holds a box.

    Args:
        low: Lower corner (3,) of the box, metres.
        high: Upper corner (3,), metres.

    Returns:
        The grid with the smallest voxels of `EDGES_M` that keeps `MAX_CELLS`; and its lower corner
        (3,), metres.

    Raises:
        DatasetError: The box is too large for any.
    """
    extent = np.maximum(high - low, 1e-3)
    for edge in EDGES_M:
        # one more than needed: a point on the upper face lies in the voxel beyond it
        x, y, z = (int(count) for count in np.floor(extent / edge) + 1)
        shape = (x, y, z)
        if math.prod(shape) <= MAX_CELLS and max(shape) <= MAX_EDGE:
            break
    else:
        raise DatasetError(
            f"a box of {' × '.join(f'{length:.3g}' for length in extent)} m: expected what "
            f"{MAX_CELLS} voxels of {EDGES_M[-1]:g} m hold; take far points out, or cut it"
        )
    grid = GridSpec(shape=shape, voxel_m=edge)
    return grid, np.asarray(low, float)


def _cells(points: Floats, grid: GridSpec, origin: Floats) -> Mask:
    """The voxels of a grid that hold points (n, 3); points outside are left out."""
    mask = np.zeros(grid.shape, bool)
    # floor, since `astype` rounds towards 0, and would take points just outside for inside
    cells = np.floor((points - origin) / grid.voxel_m).astype(np.int64)
    inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
    mask[tuple(cells[inside].T)] = True
    return mask


def _thinned(points: Floats, name: str) -> tuple[Floats, list[str]]:
    """At most `MAX_POINTS` of the points (n, 3), evenly spread, and a line if they are fewer."""
    step = -(-len(points) // MAX_POINTS)
    if step == 1:
        return points, []
    thinned = points[::step]
    return thinned, [f"{name}: one point in {step} is drawn, {len(thinned)} of {len(points)}"]


def _noted(frames: list[Look], count: int) -> list[Look]:
    """The frames; the first says if not all of `count` scans are shown."""
    if len(frames) < count:
        line = f"{len(frames)} of {count} scans are shown, evenly spread"
        frames[0] = replace(frames[0], missing=(*frames[0].missing, line))
    return frames
