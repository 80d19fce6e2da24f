"""Building blocks of kinds: boxes, rods and balls by class, in frames of their own; uneven ground;
and random places by density."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats, Vector
from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID
from scenegen.worlds.drawing import UPRIGHT, Drawing

Point = Sequence[float]
"""Three numbers, metres."""
Span = tuple[float, float]
"""From where to where along an axis, metres."""
Rectangle = tuple[float, float, float, float]
"""Least x and y, greatest x and y, metres."""
MAX_CELLS = 500_000
"""The most points of a lattice of noise or of heights."""


class Parts:
    """Solids of one world, gathered and then added at once.

    Coordinates are metres in this frame: the world's, or one that stands upright in it."""

    def __init__(self) -> None:
        self._rows: list[tuple[str, int, Point, Point, Point]] = []
        self._origin = (0.0, 0.0, 0.0)
        self._turns = [(1.0, 0.0), (1.0, 0.0)]
        """The cosine and the sine of half the frame's turn, and of the turn."""

    def at(self, x: float, y: float, z: float = 0.0, yaw_rad: float = 0.0) -> "Parts":
        """Make a frame within this one, turned about the vertical, for the same collection of
        solids.

        Args:
            x: The frame's origin along x, metres.
            y: Along y, metres.
            z: Along z, metres.
            yaw_rad: Its turn, counter-clockwise seen from above.

        Returns:
            The frame.
        """
        frame = Parts()
        frame._rows, frame._origin = self._rows, self._moved((x, y, z))
        turns = (part.tolist() for part in sin_cos(np.array([yaw_rad / 2, yaw_rad])))
        frame._turns = [
            # angle addition formulas, for half the turn and all of it
            (c * cosine - s * sine, s * cosine + c * sine)
            for (c, s), sine, cosine in zip(self._turns, *turns, strict=True)
        ]
        return frame

    def box(self, of_class: str, low: Point, high: Point) -> None:
        """Add a box with edges along the axes.

        Args:
            of_class: Its class.
            low: Its least corner, metres.
            high: Its greatest corner.
        """
        middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        half = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
        self.solid(of_class, BOX, half, middle)

    def wall(
        self,
        of_class: str,
        axis: int,
        at: float,
        half: float,
        whole: Sequence[Span],
        opening: Sequence[Span] | None,
    ) -> None:
        """Add a wall with at most one rectangular opening.

        Args:
            of_class: Its class.
            axis: The axis across it.
            at: Where its middle is on that axis, metres.
            half: Half its thickness, metres.
            whole: Its spans along the two other axes.
            opening: The opening's spans; None for a closed wall.
        """
        (u0, u1), (v0, v1) = whole
        (a0, a1), (b0, b1) = opening or ((u1, u1), (v0, v0))
        # before, behind, below and above the opening; of a closed wall only the first has a size
        pieces = [((u0, a0), (v0, v1)), ((a1, u1), (v0, v1))]
        pieces += [((a0, a1), (v0, b0)), ((a0, a1), (b1, v1))]
        for u_span, v_span in pieces:
            # MuJoCo refuses boxes without size
            if u_span[1] - u_span[0] > 1e-6 and v_span[1] - v_span[0] > 1e-6:
                low, high = [u_span[0], v_span[0]], [u_span[1], v_span[1]]
                low.insert(axis, at - half)
                high.insert(axis, at + half)
                self.box(of_class, low, high)

    def rod(
        self, of_class: str, start: Point, end: Point, radius: float, shape: int = CYLINDER
    ) -> None:
        """Add a cylinder, or another shape with an axis, from one point to another.

        Args:
            of_class: Its class.
            start: One end, metres.
            end: The other end.
            radius: Metres; of a box, half its thickness.
            shape: `CYLINDER`, `CAPSULE` or `BOX`.
        """
        along = [b - a for a, b in zip(start, end, strict=True)]
        length = float(np.sqrt(sum(part * part for part in along)))
        x, y, z = (part / length for part in along)
        if z < 0:  # either end may be the upper one
            x, y, z = -x, -y, -z
        # the shortest turn of the z axis to the rod, by half-angle formulas; z from 0 on keeps the
        # norm above 1
        norm = float(np.sqrt(2.0 * (1.0 + z)))
        quat = (norm / 2, -y / norm, x / norm, 0.0)
        middle = [(a + b) / 2 for a, b in zip(start, end, strict=True)]
        size = (radius, radius, length / 2) if shape == BOX else (radius, length / 2, 0.0)
        self.solid(of_class, shape, size, middle, quat)

    def limb(self, of_class: str, start: Point, end: Point, radius: float) -> None:
        """Add a capsule from one point to another.

        Args:
            of_class: Its class.
            start: Centre of one cap, metres.
            end: Centre of the other.
            radius: Metres.
        """
        self.rod(of_class, start, end, radius, CAPSULE)

    def slab(
        self, of_class: str, start: Point, end: Point, width: float, thick: float, roll: float = 0.0
    ) -> None:
        """Add a box that rises from one point to another: a ramp, or a slab that leans.

        Args:
            of_class: Its class.
            start: Middle of one end face, metres.
            end: Middle of the other; not straight above the first.
            width: Its width, metres.
            thick: Its thickness.
            roll: Turn about its length: the tangent of half the angle.
        """
        x, y, z = (b - a for a, b in zip(start, end, strict=True))
        level = float(np.sqrt(x * x + y * y))
        length = float(np.sqrt(x * x + y * y + z * z))
        # half-angle formulas: first the turn about the vertical, then the rise, then the roll
        c, s = _half(x / level, y / level)
        cp, sp = _half(level / length, z / length)
        w, i, j, k = c * cp, s * sp, -c * sp, s * cp
        norm = float(np.sqrt(1 + roll * roll))
        quat = [part / norm for part in (w - i * roll, i + w * roll, j + k * roll, k - j * roll)]
        middle = [(a + b) / 2 for a, b in zip(start, end, strict=True)]
        self.solid(of_class, BOX, (length / 2, width / 2, thick / 2), middle, quat)

    def ball(
        self, of_class: str, centre: Point, radii: Point, quat: Sequence[float] = UPRIGHT
    ) -> None:
        """Add an ellipsoid.

        Args:
            of_class: Its class.
            centre: Metres.
            radii: Semi-axes, metres.
            quat: Attitude, w x y z.
        """
        self.solid(of_class, ELLIPSOID, radii, centre, quat)

    def solid(
        self,
        of_class: str,
        shape: int,
        size: Point,
        centre: Point,
        quat: Sequence[float] = UPRIGHT,
    ) -> None:
        """Add any solid.

        Args:
            of_class: Its class.
            shape: Its code, see `lidarsim.solids`.
            size: MuJoCo's sizes, metres.
            centre: Metres.
            quat: Attitude, w x y z.
        """
        (c, s), _ = self._turns
        w, x, y, z = quat
        # the product of the frame's turn, (c, 0, 0, s), and the attitude
        turned = (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)
        self._rows.append((of_class, shape, size, self._moved(centre), turned))

    def _moved(self, point: Point) -> Vector:
        (x, y, z), (x0, y0, z0), (_, (c, s)) = point, self._origin, self._turns
        return x0 + c * x - s * y, y0 + s * x + c * y, z0 + z

    def add_to(self, spec: Drawing) -> None:
        """Add all solids to a world."""
        if self._rows:
            classes, shapes, *numbers = zip(*self._rows, strict=True)
            # MuJoCo would write tiny numbers, left by rounding, in another way than zeros
            sizes, centres, quats = (
                np.where(np.abs(values) < 1e-9, 0.0, values) for values in map(np.array, numbers)
            )
            spec.add_geoms(shapes, sizes, centres, quats, classes=classes)


def _half(cosine: float, sine: float) -> tuple[float, float]:
    """Compute cosine and sine of half an angle between -pi and pi."""
    # rounding may lead beyond 1
    half = float(np.sqrt(max(1 - cosine, 0.0) / 2))
    return float(np.sqrt(max(1 + cosine, 0.0) / 2)), half if sine >= 0 else -half


def car(parts: Parts, *, rng: Generator) -> None:
    """Add a car along x: body, cabin and wheels.

    Args:
        parts: A frame with its middle at the origin.
        rng: Decides its size.
    """
    long, wide, high = rng.uniform((3.8, 1.65, 1.4), (4.8, 1.9, 1.9)).tolist()
    body, shift = 0.55 * high, rng.uniform(-0.3, 0.3)
    parts.box("vehicle", (-long / 2, -wide / 2, 0.22), (long / 2, wide / 2, body))
    cabin = (shift - 0.27 * long, -0.45 * wide, body), (shift + 0.27 * long, 0.45 * wide, high)
    parts.box("vehicle", *cabin)
    for x in (-0.32 * long, 0.32 * long):
        for y in (-wide / 2, wide / 2 - 0.2):
            parts.rod("tyre", (x, y, 0.31), (x, y + 0.2, 0.31), 0.31)


def join(homes: dict[Any, Any], first: Any, second: Any) -> bool:
    """Join two sets, as union and find do (Galler and Fischer 1964).

    Args:
        homes: The parent of each element that has one; changed in place.
        first: An element.
        second: Another one.

    Returns:
        Whether they were in different sets.
    """
    while first in homes:
        first = homes[first]
    while second in homes:
        second = homes[second]
    if first == second:
        return False
    homes[first] = second
    return True


def noise_field(points: Floats, cell_m: float, *, rng: Generator) -> Floats:
    """Draw smooth noise: random values at the corners of a lattice, interpolated (value noise).

    Args:
        points: (n, d), d at most 3.
        cell_m: Width of its hills.
        rng: Draws the values.

    Returns:
        (n,): from 0 to 1.

    Raises:
        ValueError: If the lattice has more than `MAX_CELLS` points.
    """
    scaled = (points - points.min(axis=0)) / cell_m
    whole = np.floor(scaled).astype(np.int64)
    part = scaled - whole
    # smoothstep: without a kink at the lattice's points
    part = part * part * (3.0 - 2.0 * part)
    # before it is drawn: a lattice too fine would take all memory
    _check_cells(float(np.prod(whole.max(axis=0) + 2.0)), f"noise of {cell_m:g} m")
    lattice = rng.random(tuple(whole.max(axis=0) + 2))
    noise = np.zeros(len(points))
    for corner in itertools.product((0, 1), repeat=points.shape[1]):
        weight = np.ones(len(points))
        for axis, far in enumerate(corner):
            # multilinear interpolation between the cell's corners
            weight = weight * (part[:, axis] if far else 1.0 - part[:, axis])
        noise += weight * lattice[tuple((whole + np.array(corner)).T)]
    return noise


def hilly(
    size_m: Sequence[float], step_m: float, cells_m: Sequence[float], *, rng: Generator
) -> Floats:
    """Draw heights: noise with hills of several widths, each of half the height of the one before.

    Args:
        size_m: Extents of the plan along x and y, metres.
        step_m: About the distance of points, metres.
        cells_m: Widths of hills, metres.
        rng: Draws the noise.

    Returns:
        (along y, along x): from 0 to 1.
    """
    _check_cells((size_m[0] / step_m + 1) * (size_m[1] / step_m + 1), "uneven ground")
    counts = [max(round(edge / step_m), 1) + 1 for edge in size_m[:2]]
    axes = [
        np.arange(count) * (edge / (count - 1))
        for count, edge in zip(counts, size_m[:2], strict=True)
    ]
    y, x = np.meshgrid(axes[1], axes[0], indexing="ij")
    points = np.stack([x.reshape(-1), y.reshape(-1)], axis=1)
    total, weight = np.zeros(len(points)), 0.0
    for n, cell in enumerate(cells_m):
        total += noise_field(points, cell, rng=rng) / 2**n
        weight += 1.0 / 2**n
    return (total / weight).reshape(y.shape)


def _check_cells(cells: float, name: str) -> None:
    """Raise ValueError if a lattice would take too much memory."""
    if cells > MAX_CELLS:
        raise ValueError(
            f"{name} has {cells:.3g} points, expected {MAX_CELLS} at most; lower size_m, or make "
            f"it coarser"
        )


def height_at(heights: Floats, size_m: Sequence[float], x: float, y: float) -> float:
    """Find the least height around a place of a plan, on which solids do not float.

    Args:
        heights: (along y, along x), metres.
        size_m: Extents of the plan along x and y, metres.
        x, y: The place, metres.

    Returns:
        The least height at the four points of the lattice around it, metres.
    """
    rows, columns = heights.shape
    # places on the rim belong to the outermost cell
    i = min(max(int(y / size_m[1] * (rows - 1)), 0), rows - 2)
    j = min(max(int(x / size_m[0] * (columns - 1)), 0), columns - 2)
    return float(heights[i : i + 2, j : j + 2].min())


def scattered(
    density: ArrayLike, area_m2: float, low: Point, high: Point, *, rng: Generator
) -> list[list[float]]:
    """Draw points between two corners.

    Args:
        density: Least and greatest number of points per square metre.
        area_m2: The area that counts, square metres.
        low: The least corner, k numbers.
        high: The greatest corner.
        rng: Draws them.

    Returns:
        n points of k numbers each.
    """
    n = round(rng.uniform(*np.asarray(density).tolist()) * area_m2)
    points: list[list[float]] = rng.uniform(low, high, (n, len(low))).tolist()
    return points
