"""Pictures by matplotlib: of a sample, of several, of a scan, of a sensor's rays, of a world."""

import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from lidarsim import Sensor
from lidarsim.grid import Floats
from lidarsim.sensors.device import angles_deg
from scenegen.base.errors import DatasetError
from scenegen.view.canvas import HEIGHTS, VIEW, View, box_edges, colour
from scenegen.view.look import Look
from scenegen.view.panels import (
    INK,
    MAP,
    RED,
    Grid,
    across,
    add_bar,
    ball,
    blank,
    draw_panel,
    frame_box,
    height_of,
    line,
    plain,
    put_ball,
    put_box,
    put_points,
    to_bytes,
)
from scenegen.worlds.clouds import ReadReport, read_cloud

if TYPE_CHECKING:
    from scenegen.worlds.world import World


MARKS = [ball("sensor"), line("the map's box"), ball("returns", INK, ".")]
"""Legend of pictures of samples."""
FRAMES, TURN_S, TURN_DPI = 36, 8, 90
"""Pictures of a turntable, the time of a turn in seconds, and pixels an inch."""
STAY_S = 0.6
"""Time for which a film of a flight shows a sample, seconds."""
MAX_DRAWN = 500_000
"""Maximum points of a picture: of more, every second is drawn, or every third …"""
PIXELS = 1000
"""Pixels across the picture of a world."""
SUN = np.array((-0.35, -0.55, 0.9)) / np.linalg.norm((-0.35, -0.55, 0.9))
"""Unit vector towards the light."""
CUT, PLAIN = 0.3, 0.88
"""Greys of cut solids and of planes."""


def draw_sample(
    look: Look,
    *,
    title: str = "",
    panels: Sequence[str] = ("points", "observed", "occupancy"),
    width: float | None = None,
) -> Figure:
    """Draw a sample: three panels of voxels or returns, above three levels of the distances.

    Args:
        look: The sample.
        title: Title of the figure.
        panels: "points" or names of masks, one for each upper panel.
        width: Width of a figure for print, inches; None for the screen.

    Raises:
        DatasetError: The figure is too narrow.
    """
    handles = [ball("sensor"), line("the map's box")]
    grid = Grid(2, 3, title, handles, scale=1.25, width=width)
    for panel, name in zip(grid.panels[0], panels, strict=False):
        draw_panel(panel, look, name, name, ticks=not width)
    height = look.grid.shape[2]
    levels = sorted({height // 4, max(height // 2 - 1, 0), 3 * height // 4})
    for column, level in enumerate(levels):
        title = f"distances at z = {height_of(look, level):.2f} m"
        grid.level(1, column, look, level, look.tudf, title)
    grid.bar_of_heights([look], row=0)
    grid.bar_of_distances(look, row=1)
    return grid.figure


def draw_alone(look: Look, *, title: str) -> Figure:
    """Draw what is known of a scan, a map or a world: its returns, or else its occupied voxels.

    Args:
        look: What to draw.
        title: Title of the figure.
    """
    grid = Grid(1, 1, title, MARKS[1:], scale=2, width=None)
    draw_panel(grid.panels[0, 0], look, "points" if look.scans else "occupancy", "", ticks=True)
    grid.bar_of_heights([look])
    return grid.figure


def draw_sheet(looks: Sequence[Look], *, title: str, width: float | None = None) -> Figure:
    """Draw many samples on one sheet: occupied voxels, with the returns in front of them.

    Args:
        looks: The samples.
        title: Title of the figure.
        width: Width of a figure for print, inches; None for the screen.

    Raises:
        DatasetError: The figure is too narrow.
    """
    columns = across(min(4, len(looks)), width)
    grid = Grid(-(-len(looks) // columns), columns, title, MARKS, width=width)
    for panel, look in zip(grid.panels.flat, looks, strict=False):
        _with_returns(panel, look, VIEW, 0.6, look.name)
    grid.bar_of_heights(looks)
    return grid.figure


def draw_turn(look: Look, *, title: str, suffix: str = ".webp", frames: int = FRAMES) -> bytes:
    """Draw a turntable: occupied voxels and returns from all sides.

    Args:
        look: The sample.
        title: Title of the picture.
        suffix: Suffix of the file: .webp or .gif.
        frames: Number of pictures in a turn.

    Returns:
        Content of the animated picture.
    """
    turns = VIEW.azimuth + np.linspace(0, 2 * math.pi, frames, endpoint=False)
    pictures = [_frame(look, View(azimuth=float(turn)), title) for turn in turns]
    return _film(pictures, TURN_S / frames, suffix)


def draw_flight(looks: Sequence[Look], *, title: str, suffix: str) -> bytes:
    """Draw the samples of a flight one after the other.

    Args:
        looks: The samples, in order.
        title: Title of the picture.
        suffix: Suffix of the file: .webp or .gif.

    Returns:
        Content of the animated picture.
    """
    pictures = [_frame(look, VIEW, f"{title}, {look.name}") for look in looks]
    return _film(pictures, STAY_S, suffix)


def _frame(look: Look, view: View, title: str) -> Any:
    """Draw a picture of a film. A map has the same size in it however it is turned."""
    from PIL import Image

    low, high = look.corners
    figure = blank(6.4, 4.8, title, MARKS, dpi=TURN_DPI)
    panel = figure.subplots()
    _with_returns(panel, look, view, 1.2, "")
    middle, reach = view.project((low + high) / 2), 1.03 * math.hypot(*look.grid.extent_m) / 2
    # the diagonal fits at every turn
    limits = np.array([middle, middle]) + reach * np.array([[-1, -0.75], [1, 0.75]])
    panel.set(xlim=limits[:, 0], ylim=limits[:, 1])
    add_bar(panel, HEIGHTS, (low[2], high[2]), "height / m")
    return Image.open(io.BytesIO(to_bytes(figure, ".png"))).convert("RGB")


def _film(pictures: Sequence[Any], pause_s: float, suffix: str) -> bytes:
    """Encode an animated picture that shows each picture for `pause_s` seconds."""
    file = io.BytesIO()
    pictures[0].save(
        file,
        suffix.removeprefix("."),
        quality=72,
        save_all=True,
        append_images=pictures[1:],
        duration=round(pause_s * 1000),
        loop=0,
    )
    return file.getvalue()


def _with_returns(panel: Any, look: Look, view: View, size: float, title: str) -> None:
    """Draw occupied voxels with the returns in front of them."""
    draw_panel(panel, look, "occupancy", title, ticks=False, view=view)
    if look.points is not None:
        places = view.project(look.points).T
        panel.scatter(*places, s=size, color=INK, linewidths=0, zorder=6)


def _landscape(title: str, low: Floats, high: Floats, handles: Sequence[Any]) -> tuple[Figure, Any]:
    """Make a figure with one wide panel, a box in it, and a bar of heights."""
    figure = blank(9, 6.6, title, handles)
    panel = figure.subplots()
    frame_box(panel, low, high)
    add_bar(panel, HEIGHTS, (low[2], high[2]), "height / m")
    return figure, panel


def draw_scan(
    path: Path, columns: int | None = None, report: Callable[[object], None] = lambda line: None
) -> Figure:
    """Draw a scan that belongs to no dataset.

    Args:
        path: The file.
        columns: Columns of a file without a header, see `read_cloud`.
        report: Called with a line on how the file was read.

    Raises:
        DatasetError: The file cannot be read, or has no returns.
    """
    cloud, counts = read_cloud(path, columns=columns), ReadReport()
    counts.add(len(cloud.points), cloud.layout, 0)
    report(counts)
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
    if not len(points):
        raise DatasetError(f"{path}: none of its points is a return")
    points = points[:: -(-len(points) // MAX_DRAWN)]
    # a metre around the sensor at least, so that a box has room
    low, high = np.minimum(points.min(axis=0), -1), np.maximum(points.max(axis=0), 1)
    handles = [ball("sensor"), line("the box of all points and the sensor")]
    figure, panel = _landscape(plain(path.name), low, high, handles)
    put_points(panel, points, low[2], high[2], max(0.3, min(4.0, 2e4 / len(points))))
    put_ball(panel, VIEW.project(np.zeros(3)))
    return figure


def draw_patterns(sensors: Mapping[str, Sensor]) -> Figure:
    """Draw a panel for each sensor, by its name: each ray is a dot at its azimuth and elevation in
    degrees, from dark for the first in time to light for the last."""
    angles = [angles_deg(sensor.directions_body.reshape(-1, 3)) for sensor in sensors.values()]
    heights = [max(1.2, 6 * np.ptp(up) / max(np.ptp(around), 1.0)) + 0.7 for up, around in angles]
    figure = Figure(figsize=(6.4, sum(heights)), dpi=100, layout="constrained")
    panels = figure.subplots(len(heights), squeeze=False, height_ratios=heights)[:, 0]
    for panel, (name, sensor), (up, around) in zip(panels, sensors.items(), angles, strict=True):
        panel.scatter(around, up, s=1, c=sensor.times_s.ravel(), cmap="viridis", linewidths=0)
        panel.set(xlabel="azimuth / °", ylabel="elevation / °", title=plain(name))
        panel.invert_xaxis()  # seen from the body, azimuth grows to the left
        panel.grid(alpha=0.4)
    return figure


def draw_world_file(path: Path, seed: int | None = None) -> Figure:
    """Draw the world of a file.

    Args:
        path: MJCF, or a mesh.
        seed: Seed of a random flight to draw in it; None for no flight.

    Raises:
        SceneError: The file holds no world, or a map.
        GenerationError: No flight fits.
    """
    # compiles; pictures of samples do without
    from scenegen.draw.source import read_world
    from scenegen.worlds.flight import poses_in_flight
    from scenegen.worlds.world import solid

    world = solid(read_world(path), str(path))
    poses = [] if seed is None else poses_in_flight(world, seed=seed)
    places = np.stack([pose.position for pose in poses]) if poses else None
    return draw_world(world, title=plain(path.name), places=places, joined=True)


def draw_world(
    world: "World",
    *,
    title: str,
    places: Floats | None = None,
    joined: bool = False,
    box: tuple[Floats, Floats] | None = None,
) -> Figure:
    """Draw the solids in the flight bounds, and below them down to the ground, in metres.

    Solids outside are cut away. Cuts are dark grey, planes light grey, and everything else has the
    colour of its height.

    Args:
        world: The world.
        title: Title of the figure.
        places: Viewpoints (n, 3), metres in the world, drawn as balls.
        joined: Whether a red line joins them, as a flight.
        box: Lower and upper corner (3,) of a map, metres in the world, drawn in blue.
    """
    # flights stay above the ground, but the picture has to show what they fly over
    low, high = world.flight_bounds.copy()
    bounded = world.solids.lower[np.isfinite(world.solids.lower).all(axis=1)]
    low[2] = min([low[2], *bounded[:, 2], *world.solids.triangles.reshape(-1, 3)[:, 2]])
    image, extent = see(world, low, high)
    handles = [line("the flight's box, down to the ground")]
    if box is not None:
        handles.insert(0, line("the map's box", MAP, 1.4))
    if places is not None:
        handles.insert(0, ball("viewpoints"))
    figure, panel = _landscape(title, low, high, handles)
    limits = panel.axis()
    panel.imshow(image, origin="lower", extent=extent, zorder=2)
    panel.axis(limits)  # imshow has changed the limits
    if box is not None:
        put_box(panel, *box)
    if places is not None:
        panel.plot(*VIEW.project(places).T, color=RED, linewidth=float(joined), zorder=6)
        put_ball(panel, VIEW.project(places), size=24)
    return figure


def see(
    world: "World", low: Floats, high: Floats
) -> tuple[Floats, tuple[float, float, float, float]]:
    """Render a world by casting rays, so that the picture has what the sensor would meet.

    Args:
        world: The world.
        low: Lower corner (3,) of the box at whose faces parallel rays begin, metres in the world.
        high: Its upper corner (3,).

    Returns:
        Colours (rows, columns, 3), white where rays miss the box; and the extent of the picture on
        the paper: left, right, down, up.
    """
    corners = VIEW.project(np.concatenate(box_edges(low, high)).reshape(-1, 3))
    (left, down), (right, up) = corners.min(axis=0), corners.max(axis=0)
    step = max(right - left, up - down) / PIXELS
    across, upward = np.meshgrid(
        np.arange(left, right, step) + step / 2, np.arange(down, up, step) + step / 2
    )
    flat = across.reshape(-1, 1) * VIEW.right + upward.reshape(-1, 1) * VIEW.up
    # the slab method: a ray is in the box from the nearest far face to the farthest near face
    faces = np.stack([(low - flat) / VIEW.eye, (high - flat) / VIEW.eye])
    begin, end = faces.max(axis=0).min(axis=1), faces.min(axis=0).max(axis=1)
    met = begin > end
    image = np.ones((len(flat), 3))
    if met.any():  # no ray meets a box without height
        starts = flat[met] + begin[met, None] * VIEW.eye
        reach = float((begin - end)[met].max()) + 1.0
        image[met] = _shades(world, starts, reach, low[2], high[2])
    return image.reshape(*across.shape, 3), (left, right, down, up)


def _shades(world: "World", starts: Floats, reach: float, low: float, high: float) -> Floats:
    """Return colours (n, 3) of the solids that rays from `starts` (n, 3) away from the eye meet."""
    from lidarsim import AnalyticEngine  # compiles; pictures of samples cast no rays
    from lidarsim.solids import PLANE

    away = np.broadcast_to(-VIEW.eye, (len(starts), 1, 3)).copy()
    hits = AnalyticEngine.of(world.model, world.data).hits(starts, away, reach)
    seen = hits.geoms[:, 0] >= 0
    points, normals, geoms = (part[seen, 0] for part in (hits.points, hits.normals, hits.geoms))
    shades = colour((points[:, 2] - low) / max(high - low, 1e-9), HEIGHTS)
    planes = world.solids.geom[: len(world.solids.shape)][world.solids.shape == PLANE]
    shades[np.isin(geoms, planes)] = PLAIN
    shades *= 0.62 + 0.38 * np.abs(normals @ SUN)[:, None]
    shades[normals @ VIEW.eye < 0] = CUT  # the ray began inside
    image = np.ones((len(starts), 3))
    image[seen] = shades
    return image
