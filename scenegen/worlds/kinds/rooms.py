"""A storey of a building: rooms and corridors with doors, windows, ceilings and furniture."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from lidarsim.parameters import number
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts, Point, Rectangle, join

PIECES = ("table", "chair", "shelf", "cupboard", "sofa")


@dataclass(frozen=True, kw_only=True)
class Rooms(Classed):
    """A floor plan by recursive division: rooms on both sides of a corridor, every room reached by
    a door. Measures are those that building codes and furniture makers use (doors .9 m wide and 2.0
    m high, tables .72 to .78 m, seats .45 m, steps of .17 m)."""

    version = 2
    graded = {
        "easy": {
            "room_m": (5.0, 14.0),
            "door_width_m": (1.2, 1.8),
            "open_share": 0.5,
            "furniture_density": (0.0, 0.06),
        },
        "hard": {
            "room_m": (3.0, 6.5),
            "door_width_m": (0.8, 1.0),
            "open_share": 0.1,
            "loop_share": 0.5,
            "furniture_density": (0.12, 0.28),
        },
    }
    crowded_by = ("furniture_density",)
    # eight short searches reject fewer worlds than three long ones do: 5 % against 20 %
    flight_defaults = {"altitude_m": (0.5, 2.2), "min_distance_m": 4.0, "flights_per_world": 8}

    size_m: Size = (34.0, 34.0, 4.0)
    """Extent along x and y, metres; `height_m` decides along z."""
    ground: bool = True
    """Whether there is a floor."""
    height_m: Range = (2.6, 3.4)
    """Clear height under the ceilings, metres; one value a world. Source: above the 2.29 m that the
    International Building Code asks of habitable rooms (1208.2)."""
    room_m: Range = number((3.5, 10.0), minimum=1.0, maximum=1000)
    """Edges of rooms, metres: a longer one is divided, none becomes shorter."""
    corridor_m: Range = (1.6, 2.8)
    """Width of the corridor, metres. Source: above the 1.12 m that the International Building Code
    asks of corridors (1020.3)."""
    wall_half_thickness_m: Range = (0.06, 0.15)
    """Half the thickness of walls, metres; one value a world. Source: partitions of 11.5 to outer
    walls of 30 cm (DIN 4172's masonry)."""
    door_width_m: Range = (0.9, 1.4)
    """Width of doors, metres; one value a door. Source: above the clear 0.815 m of the 2010 ADA
    Standards (404.2.3), up to two leaves."""
    door_height_m: float = 2.1
    """Height of doors, metres: lintels hang above. Source: above the clear 2.03 m of the 2010 ADA
    Standards (404.2.3)."""
    open_share: float = 0.2
    """Share of doors that are open up to the ceiling and twice as wide."""
    loop_share: float = 0.3
    """Share of walls between rooms that have a door though there is another way."""
    window_share: float = 0.6
    """Share of outer walls with a window."""
    ceiling_share: float = 0.85
    """Share of rooms with a ceiling."""
    furniture_density: Range = (0.03, 0.18)
    """Pieces of furniture per square metre; one value a world."""
    stairs_share: float = 0.1
    """Share of rooms with a flight of stairs."""
    column_share: float = 0.2
    """Share of rooms with columns."""

    def max_solids(self) -> float:
        """Count walls, doors and columns of the greatest number of rooms, and 12 solids a piece of
        furniture."""
        area = self.size_m[0] * self.size_m[1]
        return area / self.room_m[0] ** 2 * 40 + self.furniture_density[1] * area * 12

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Divide the plan, raise walls with openings, and furnish the rooms.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, _) = self.begun("floor"), self.size_m
        height, half = rng.uniform(*self.height_m), rng.uniform(*self.wall_half_thickness_m)
        # a narrow world keeps room on both sides
        wide = min(rng.uniform(*self.corridor_m), y_m / 3)
        low = rng.uniform(0.35, 0.65) * y_m - wide / 2
        # the corridor is the first room, and crosses the plan
        rooms = [(0.0, low, x_m, low + wide)]
        for side in ((0.0, 0.0, x_m, low), (0.0, low + wide, x_m, y_m)):
            rooms += _divided(side, self.room_m, rng=rng)
        doors = self._add_walls(parts, rooms, height, half, rng=rng)
        density = rng.uniform(*self.furniture_density)
        for n, room in enumerate(rooms):
            if rng.random() < self.ceiling_share:
                parts.box("ceiling", (*room[:2], height), (*room[2:], height + 0.2))
            # the corridor stays empty
            if n > 0:
                _furnish(parts, room, doors[n], density, rng=rng)
                self._fit_out(parts, room, height, rng=rng)
        parts.add_to(spec)

    def _add_walls(
        self,
        parts: Parts,
        rooms: list[Rectangle],
        height: float,
        half: float,
        *,
        rng: Generator,
    ) -> list[list[tuple[float, float]]]:
        """Add walls between rooms, with doors, and around all, with windows.

        Walls are `height` high and twice `half` thick, metres. Returns the doors' places, by room.
        """
        shared, joins = _shared_edges(rooms), dict[int, int]()
        doors: list[list[tuple[float, float]]] = [[] for _ in rooms]
        for n in rng.permutation(len(shared)).tolist():
            (axis, coordinate, low, high), pair = shared[n]
            width, top = rng.uniform(*self.door_width_m), min(self.door_height_m, height)
            place, loop, wider = rng.random(3).tolist()
            length = high - low
            if wider < self.open_share and length > 2 * width + 4 * half:
                width, top = 2 * width, height
            door = None
            # rooms that a door joins already have a second way only by chance
            if length > width + 4 * half and (join(joins, *pair) or loop < self.loop_share):
                # a wall's thickness remains at either end
                begin = low + 2 * half + place * (length - width - 4 * half)
                door = ((begin, begin + width), (0.0, top))
                middle = (coordinate, begin + width / 2)
                for room in pair:
                    doors[room].append(middle if axis == 0 else middle[::-1])
            # so much longer that walls meet in the corners
            span = ((low - half, high + half), (0.0, height))
            parts.wall("wall", axis, coordinate, half, span, door)
        for axis, coordinate, low, high in _rim_edges(rooms, self.size_m):
            sill, width = rng.uniform(0.7, 1.1), rng.uniform(0.3, 0.7) * (high - low)
            begin = (low + high - width) / 2
            # a lintel of 0.1 m or more remains
            window = ((begin, begin + width), (sill, min(2.2, height - 0.1)))
            opening = window if rng.random() < self.window_share else None
            parts.wall("wall", axis, coordinate, half, ((low, high), (0.0, height)), opening)
        return doors

    def _fit_out(self, parts: Parts, room: Rectangle, height: float, *, rng: Generator) -> None:
        """Add stairs and columns."""
        x0, y0, x1, y1 = room
        rising, columns = rng.random(2).tolist()
        if rising < self.stairs_share and x1 - x0 > 5 and y1 - y0 > 3:
            _stairs(parts, (x0 + 1, y0 + 0.2, 0.0), x1 - x0 - 2, height)
        if columns < self.column_share and min(x1 - x0, y1 - y0) > 4:
            radius = rng.uniform(0.12, 0.3)
            for x in np.arange(x0 + 2, x1 - 1, 4.0).tolist():
                parts.rod("column", (x, (y0 + y1) / 2, 0), (x, (y0 + y1) / 2, height), radius)


def _divided(room: Rectangle, edges_m: Sequence[float], *, rng: Generator) -> list[Rectangle]:
    """Divide a rectangle until no edge is longer than `edges_m` allows, and none shorter."""
    x0, y0, x1, y1 = room
    longer, (shortest, longest) = max(x1 - x0, y1 - y0), edges_m
    # the limit is random: rooms of all allowed sizes occur
    if longer < 2 * shortest or longer <= rng.uniform(max(2 * shortest, shortest + 1), longest):
        return [room]
    cut = rng.uniform(shortest, longer - shortest)
    # across the longer edge, so that rooms do not become corridors
    if x1 - x0 >= y1 - y0:
        halves = ((x0, y0, x0 + cut, y1), (x0 + cut, y0, x1, y1))
    else:
        halves = ((x0, y0, x1, y0 + cut), (x0, y0 + cut, x1, y1))
    return [part for half in halves for part in _divided(half, edges_m, rng=rng)]


class _Edge(NamedTuple):
    """A contact of a rectangle with another, or with the rim of the plan."""

    axis: int
    """The one across the edge."""
    coordinate: float
    """Where the edge is on that axis, metres."""
    low: float
    """Where it begins on the other axis, metres."""
    high: float
    """Where it ends."""


def _shared_edges(rooms: Sequence[Rectangle]) -> list[tuple[_Edge, tuple[int, int]]]:
    """Find where rectangles touch, and the numbers of the two."""
    edges = []
    for (a, room_a), (b, room_b) in itertools.combinations(enumerate(rooms), 2):
        for axis in (0, 1):
            along = 1 - axis
            low, high = max(room_a[along], room_b[along]), min(room_a[along + 2], room_b[along + 2])
            # either may lie before the other on this axis
            for first, second in ((room_a, room_b), (room_b, room_a)):
                # exact: both sides of a cut have the same number
                if first[axis + 2] == second[axis] and high - low > 1e-9:
                    edges.append((_Edge(axis, second[axis], low, high), (a, b)))
    return edges


def _rim_edges(rooms: Sequence[Rectangle], size_m: Sequence[float]) -> Iterator[_Edge]:
    """Find where rectangles touch the rim of a plan of `size_m` from the origin."""
    for room in rooms:
        for axis, side in ((0, 0), (0, 2), (1, 1), (1, 3)):
            if room[side] in (0.0, size_m[axis]):
                yield _Edge(axis, room[side], room[1 - axis], room[3 - axis])


def _furniture(parts: Parts, kind: str, *, rng: Generator) -> None:
    """Add a piece of furniture around the origin of a frame."""
    a, b, c = rng.random(3).tolist()
    if kind == "table":
        x, y, z = 0.6 + 0.4 * a, 0.35 + 0.2 * b, 0.72 + 0.06 * c
        parts.box("furniture", (-x, -y, z - 0.04), (x, y, z))
        _legs(parts, x, y, z - 0.04)
    elif kind == "chair":
        parts.box("furniture", (-0.22, -0.22, 0.41), (0.22, 0.22, 0.45))
        parts.box("furniture", (-0.22, 0.18, 0.45), (0.22, 0.22, 0.85 + 0.2 * a))
        _legs(parts, 0.22, 0.22, 0.41)
    elif kind == "shelf":
        x, y, z = 0.4 + 0.4 * a, 0.15 + 0.08 * b, 1.2 + 0.9 * c
        for side in (-x, x):
            parts.box("shelf", (side - 0.02, -y, 0), (side + 0.02, y, z))
        for level in np.linspace(0.1, z, 5).tolist():
            parts.box("shelf", (-x, -y, level - 0.03), (x, y, level))
    elif kind == "cupboard":
        parts.box("furniture", (-0.4 - 0.4 * a, -0.3, 0), (0.4 + 0.4 * a, 0.3, 0.8 + 1.3 * c))
    else:
        x = 0.7 + 0.5 * a
        parts.box("furniture", (-x, -0.45, 0), (x, 0.45, 0.42))
        parts.box("furniture", (-x, 0.25, 0.42), (x, 0.45, 0.85))
        for side in (-x, x - 0.15):
            parts.box("furniture", (side, -0.45, 0.42), (side + 0.15, 0.45, 0.62))


def _legs(parts: Parts, x: float, y: float, z: float) -> None:
    for dx, dy in ((-x, -y), (-x, y - 0.05), (x - 0.05, -y), (x - 0.05, y - 0.05)):
        parts.box("furniture", (dx, dy, 0), (dx + 0.05, dy + 0.05, z))


def _furnish(
    parts: Parts,
    room: Rectangle,
    doors: Sequence[tuple[float, float]],
    density: float,
    *,
    rng: Generator,
) -> None:
    """Furnish a room with pieces per square metre, none in front of its doors."""
    x0, y0, x1, y1 = room
    # rounded by chance: small rooms would otherwise never, or always, have a piece
    pieces = round(density * (x1 - x0) * (y1 - y0) + rng.uniform(-0.5, 0.5))
    # off the walls by about half a piece
    inside = ((x0 + 0.9, y0 + 0.9), (max(x1 - 0.9, x0 + 0.9), max(y1 - 0.9, y0 + 0.9)))
    for px, py in rng.uniform(*inside, (max(pieces, 0), 2)).tolist():
        kind, turn = rng.integers(0, len(PIECES)), rng.integers(0, 4)
        # 1.3 m from a door's middle; a piece in its way is left out
        if all((px - x) ** 2 + (py - y) ** 2 > 1.7 for x, y in doors):
            _furniture(parts.at(px, py, 0.0, turn * (np.pi / 2)), PIECES[kind], rng=rng)


def _stairs(parts: Parts, low: Point, length: float, height: float) -> None:
    """Add steps along x that rise from `low` until `length` or `height` ends them, metres."""
    x, y, z = low
    for n in range(min(int(height / 0.17), int(length / 0.28))):
        # slabs of up to 0.37 m, so that stairs are open below
        step = (x + 0.28 * n, y, z + max(0.17 * n - 0.2, 0.0))
        parts.box("stairs", step, (step[0] + 0.3, y + 1.1, z + 0.17 * (n + 1)))
