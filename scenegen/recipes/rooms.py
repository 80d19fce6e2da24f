"""A storey of a building: rooms and corridors with doors, windows, ceilings and furniture."""

from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar

import numpy as np

from lidarsim.parameters import number
from scenegen.recipes.kind import Range, WorldKind
from scenegen.recipes.parts import Parts
from scenegen.worlds.classes import CLASSES
from scenegen.worlds.drawing import Drawing

Rectangle = tuple[float, float, float, float]
"""Least x and y, greatest x and y, metres."""
QUARTER = np.pi / 2
PIECES = ("table", "chair", "shelf", "cupboard", "sofa")


@dataclass(frozen=True, kw_only=True)
class Rooms(WorldKind):
    """A floor plan by recursive division: rooms on both sides of a corridor, every room reached by
    a door. Measures are those that building codes and furniture makers use (doors .9 m wide and
    2.0 m high, tables .72 to .78 m, seats .45 m, steps of .17 m)."""

    version: ClassVar[int] = 1
    graded: ClassVar[dict[str, dict[str, object]]] = {
        "easy": {
            "room_m": (5.0, 14.0),
            "door_width_m": (1.2, 1.8),
            "open_share": 0.5,
            "furniture_density": (0.0, 0.06),
        },
        "hard": {
            "room_m": (3.0, 6.5),
            "door_width_m": (0.8, 1.0),
            "open_share": 0.05,
            "furniture_density": (0.15, 0.35),
        },
    }
    crowded_by: ClassVar[tuple[str, ...]] = ("furniture_density",)
    classes: ClassVar[tuple[str, ...]] = CLASSES
    flight_defaults: ClassVar[dict[str, object]] = {
        "altitude_m": (0.5, 2.2),
        "min_distance_m": 4.0,
        "flights_per_world": 8,
    }

    size_m: tuple[float, float, float] = (34.0, 34.0, 4.0)
    """Extent of the storey along x, y and z, metres."""
    ground: bool = True
    """Whether there is a floor."""
    height_m: Range = (2.6, 3.4)
    """Clear height under the ceilings, metres; one value a world."""
    room_m: Range = number((3.5, 10.0), least=1.0, most=1000, rising=True)
    """Edges of rooms, metres: a longer one is divided, none becomes shorter."""
    corridor_m: Range = (1.6, 2.8)
    """Width of the corridor, metres."""
    wall_half_thickness_m: Range = (0.06, 0.15)
    """Half the thickness of walls, metres; one value a world."""
    door_width_m: Range = (0.9, 1.4)
    """Width of doors, metres; one value a door."""
    door_height_m: float = 2.1
    """Height of doors, metres: lintels hang above."""
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

    def most_solids(self) -> float:
        """Walls, doors and columns of as many rooms as there may be, and furniture of 12 solids."""
        area = self.size_m[0] * self.size_m[1]
        return area / self.room_m[0] ** 2 * 40 + self.furniture_density[1] * area * 12

    def add_to(self, spec: Drawing, *, rng: np.random.Generator) -> None:
        """Divide the plan, raise walls with openings, and furnish the rooms."""
        parts, (x_m, y_m, _) = Parts(), self.size_m
        if self.ground:
            parts.box("floor", (0, 0, -self.ground_m), (x_m, y_m, 0))
        height, half = rng.uniform(*self.height_m), rng.uniform(*self.wall_half_thickness_m)
        wide = min(rng.uniform(*self.corridor_m), y_m / 3)
        low = rng.uniform(0.35, 0.65) * y_m - wide / 2
        corridor = (0.0, low, x_m, low + wide)
        rooms = [
            corridor,
            *self._divided((0.0, 0.0, x_m, low), rng=rng),
            *self._divided((0.0, low + wide, x_m, y_m), rng=rng),
        ]
        doors = self._add_walls(parts, rooms, height, half, rng=rng)
        density = rng.uniform(*self.furniture_density)
        for n, room in enumerate(rooms):
            if rng.random() < self.ceiling_share:
                parts.box("ceiling", (*room[:2], height), (*room[2:], height + 0.2))
            if n > 0:
                self._furnish(parts, room, doors[n], height, density, rng=rng)
        parts.add_to(spec)

    def _divided(self, room: Rectangle, *, rng: np.random.Generator) -> list[Rectangle]:
        """Rooms that fill a rectangle."""
        x0, y0, x1, y1 = room
        longer, least = max(x1 - x0, y1 - y0), self.room_m[0]
        if longer < 2 * least or longer <= rng.uniform(max(2 * least, least + 1), self.room_m[1]):
            return [room]
        at = rng.uniform(least, longer - least)
        if x1 - x0 >= y1 - y0:
            halves = ((x0, y0, x0 + at, y1), (x0 + at, y0, x1, y1))
        else:
            halves = ((x0, y0, x1, y0 + at), (x0, y0 + at, x1, y1))
        return [part for one in halves for part in self._divided(one, rng=rng)]

    def _add_walls(
        self,
        parts: Parts,
        rooms: list[Rectangle],
        height: float,
        half: float,
        *,
        rng: np.random.Generator,
    ) -> list[list[tuple[float, float]]]:
        """Walls between rooms and around all; the doors' places, by room."""
        shared = []
        for (a, one), (b, other) in combinations(enumerate(rooms), 2):
            for axis in (0, 1):
                across = 1 - axis
                low, high = max(one[across], other[across]), min(one[across + 2], other[across + 2])
                for first, second in ((one, other), (other, one)):
                    if first[axis + 2] == second[axis] and high - low > 1e-9:
                        shared.append((axis, second[axis], low, high, a, b))
        home = list(range(len(rooms)))
        doors: list[list[tuple[float, float]]] = [[] for _ in rooms]

        def root(n: int) -> int:
            while home[n] != n:
                n = home[n]
            return n

        for n in rng.permutation(len(shared)).tolist():
            axis, at, low, high, a, b = shared[n]
            width, top = rng.uniform(*self.door_width_m), min(self.door_height_m, height)
            place, chance, wider = rng.random(3).tolist()
            if wider < self.open_share and high - low > 2 * width + 4 * half:
                width, top = 2 * width, height
            opening = None
            if high - low > width + 4 * half and (root(a) != root(b) or chance < self.loop_share):
                home[root(a)] = root(b)
                begin = low + 2 * half + place * (high - low - width - 4 * half)
                opening = (begin, begin + width, 0.0, top)
                middle = (at, begin + width / 2)
                for one in (a, b):
                    doors[one].append(middle if axis == 0 else middle[::-1])
            self._wall(parts, axis, at, (low - half, high + half), height, half, opening)
        for room in rooms:
            for axis, side in ((0, 0), (0, 2), (1, 1), (1, 3)):
                if room[side] in (0.0, self.size_m[axis]):
                    low, high = room[1 - axis], room[3 - axis]
                    sill, width = rng.uniform(0.7, 1.1), rng.uniform(0.3, 0.7) * (high - low)
                    begin = (low + high - width) / 2
                    window = (begin, begin + width, sill, min(2.2, height - 0.1))
                    opening = window if rng.random() < self.window_share else None
                    self._wall(parts, axis, room[side], (low, high), height, half, opening)
        return doors

    def _wall(
        self,
        parts: Parts,
        axis: int,
        at: float,
        span: tuple[float, float],
        height: float,
        half: float,
        opening: tuple[float, float, float, float] | None,
    ) -> None:
        """A wall across `axis` with at most one opening: from, to, sill and lintel."""
        begin, end, sill, top = opening or (span[1], span[1], 0.0, 0.0)
        pieces = [(span[0], begin, 0.0, height), (end, span[1], 0.0, height)]
        pieces += [(begin, end, 0.0, sill), (begin, end, top, height)]
        for low, high, bottom, above in pieces:
            if high - low > 1e-6 and above - bottom > 1e-6:
                one, other = (at - half, low, bottom), (at + half, high, above)
                if axis == 1:
                    one, other = (low, at - half, bottom), (high, at + half, above)
                parts.box("wall", one, other)

    def _furnish(
        self,
        parts: Parts,
        room: Rectangle,
        doors: list[tuple[float, float]],
        height: float,
        density: float,
        *,
        rng: np.random.Generator,
    ) -> None:
        x0, y0, x1, y1 = room
        pieces = round(density * (x1 - x0) * (y1 - y0) + rng.uniform(-0.5, 0.5))
        inside = ((x0 + 0.9, y0 + 0.9), (max(x1 - 0.9, x0 + 0.9), max(y1 - 0.9, y0 + 0.9)))
        for px, py in rng.uniform(*inside, (max(pieces, 0), 2)).tolist():
            kind, turn = rng.integers(0, len(PIECES)), rng.integers(0, 4)
            if all((px - x) ** 2 + (py - y) ** 2 > 1.7 for x, y in doors):
                _piece(parts.at(px, py, 0.0, turn * QUARTER), PIECES[kind], rng=rng)
        stairs, columns = rng.random(2).tolist()
        if stairs < self.stairs_share and x1 - x0 > 5 and y1 - y0 > 3:
            for n in range(min(int(height / 0.17), int((x1 - x0 - 2) / 0.28))):
                low = (x0 + 1 + 0.28 * n, y0 + 0.2, max(0.17 * n - 0.2, 0.0))
                parts.box("stairs", low, (low[0] + 0.3, y0 + 1.3, 0.17 * (n + 1)))
        if columns < self.column_share and min(x1 - x0, y1 - y0) > 4:
            radius = rng.uniform(0.12, 0.3)
            for x in np.arange(x0 + 2, x1 - 1, 4.0).tolist():
                parts.rod("column", (x, (y0 + y1) / 2, 0), (x, (y0 + y1) / 2, height), radius)


def _piece(parts: Parts, kind: str, *, rng: np.random.Generator) -> None:
    """A piece of furniture around the origin of a frame."""
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
