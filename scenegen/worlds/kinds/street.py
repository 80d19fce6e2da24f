"""A street: two rows of houses with relief, and lamps, wires and cars between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.random import Generator

from lidarsim.grid import Floats
from lidarsim.solids import BOX
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts, Point, car, scattered

STOREY_M = 3.2
# the second side is the first one turned by half a turn
SIDES = ((1, 0.0), (-1, np.pi))

STRETCH_M = 12.0
"""Least length of road for one moving vehicle, metres."""


@dataclass(frozen=True, kw_only=True)
class Street(Classed):
    """A street along x. Houses have bays between piers, sills, balconies, arcades, eaves and
    gables; widths of lanes and pavements are those of road design manuals (lanes 3.0 to 3.5 m,
    parking 2 m, pavements 2 to 4 m), lamp posts stand 10 to 15 m apart."""

    version = 1
    graded = {
        "easy": {
            "road_m": (9.0, 14.0),
            "tree_density": (0.0, 0.01),
            "bush_density": (0.0, 0.02),
            "wire_share": 0.0,
            "car_share": 0.2,
        },
        "hard": {
            "road_m": (5.0, 7.0),
            "pavement_m": (1.5, 2.5),
            "tree_density": (0.03, 0.08),
            "bush_density": (0.05, 0.1),
            "wire_share": 1.0,
            "car_share": 0.9,
        },
    }
    crowded_by = ("tree_density", "bush_density")
    movers = ("person", "vehicle", "drone")
    flight_defaults = {"altitude_m": (0.8, 8.0)}

    size_m: Size = (40.0, 40.0, 12.0)
    """Extent along x and y, metres; `storeys` decides along z."""
    ground: bool = True
    """Whether there are a road and pavements."""
    road_m: Range = (6.0, 11.0)
    """Width of the road, metres; one value a world. Source: two lanes of 3.0 to 3.5 m, with parking
    of 2 m on no, one or both sides (NACTO, Urban Street Design Guide)."""
    pavement_m: Range = (2.0, 4.5)
    """Width of each pavement, metres; one value a world. Source: 1.5 to 3.7 m of walking, and what
    stands at the kerb (NACTO, Urban Street Design Guide)."""
    house_m: Range = (6.0, 13.0)
    """Width of a house along the street, metres."""
    storeys: Range = (2.0, 5.0)
    """Storeys of a house."""
    bay_m: Range = (2.2, 3.6)
    """Width of a bay of windows, metres; one value a house."""
    relief_m: Range = (0.15, 0.4)
    """How far piers and sills stand out, metres; one value a house."""
    balcony_share: float = 0.3
    """Share of bays with a balcony."""
    arcade_share: float = 0.25
    """Share of houses whose ground floor is an arcade."""
    gable_share: float = 0.4
    """Share of houses with a gabled roof; the others are flat, with eaves."""
    gap_share: float = 0.2
    """Share of houses that are left out: a yard behind a fence."""
    car_share: float = 0.5
    """Share of parking spaces that are taken."""
    tree_density: Range = (0.0, 0.03)
    """Trees per square metre of pavement; one value a world."""
    bush_density: Range = (0.0, 0.05)
    """Hedges per square metre of pavement; one value a world."""
    wire_share: float = 0.5
    """Share of streets with wires between lamp posts."""

    def mover_zones(self, bounds: Floats) -> dict[str, list[Floats]]:
        """Keep vehicles to the middle of the road, between parked cars; see
        `WorldKind.mover_zones`."""
        begin, end, top = float(bounds[0, 0]), float(bounds[1, 0]), float(bounds[1, 2])
        middle = self.size_m[1] / 2
        # one vehicle a stretch has room; two in one lane would meet
        count = max(int((end - begin) / STRETCH_M), 1)
        # more than half a vehicle's length: those of neighbouring stretches do not meet at the ends
        gap = min(3.0, (end - begin) / 4)
        stretches = [
            np.array([[low + gap, middle - 0.2, 0.0], [high - gap, middle + 0.2, top]])
            for low, high in pairwise(np.linspace(begin, end, count + 1).tolist())
        ]
        return super().mover_zones(bounds) | {"vehicle": stretches}

    def max_solids(self) -> float:
        """Count the relief of two rows of houses, and everything on the pavements."""
        x, storeys = self.size_m[0], self.storeys[1] + 1
        bays = 2 * x / self.bay_m[0] + 2 * x / self.house_m[0]
        plants = (self.tree_density[1] * 8 + self.bush_density[1]) * 2 * x * self.pavement_m[1]
        return bays * (4 + 8 * storeys) + plants + 8 * x

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Draw the ground, then each side of the street in a frame of its own.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, _) = self.begun("road"), self.size_m
        road, pavement = rng.uniform(*self.road_m), rng.uniform(*self.pavement_m)
        for side, yaw in SIDES:
            # x along the street, y from its middle outwards
            # turned by half, a frame begins at the other end of the street
            frame = parts.at(0.0 if side > 0 else x_m, y_m / 2, 0.0, yaw)
            if self.ground:
                frame.box("sidewalk", (0, road / 2, 0), (x_m, y_m / 2, 0.14))
            self._houses(frame, road / 2 + pavement, rng=rng)
            self._pavement(frame, road / 2, pavement, rng=rng)
            # parking spaces along the kerb
            for x in np.arange(0.5, x_m - 5.0, 6.2).tolist():
                if rng.random() < self.car_share:
                    car(frame.at(x + 2.5, road / 2 - 1.1), rng=rng)
        parts.add_to(spec)

    def _houses(self, parts: Parts, front: float, *, rng: Generator) -> None:
        x, (x_m, y_m, _) = 0.0, self.size_m
        # no house is narrower than a metre
        while x < x_m - 1.0:
            width = min(rng.uniform(*self.house_m), x_m - x)
            if rng.random() < self.gap_share:
                parts.box("fence", (x, front, 0), (x + width, front + 0.1, rng.uniform(0.8, 1.8)))
            else:
                # to the edge of the world, and at least 3 m
                back = max(y_m / 2, front + 3.0)
                self._house(parts.at(x, front), width, back - front, rng=rng)
            x += width

    def _house(self, parts: Parts, width: float, deep: float, *, rng: Generator) -> None:
        """Add a house behind y = 0, whose front runs along x."""
        storeys = int(rng.integers(int(self.storeys[0]), int(self.storeys[1]) + 1))
        top, relief = storeys * STOREY_M, rng.uniform(*self.relief_m)
        bays = max(int(width / rng.uniform(*self.bay_m)), 1)
        bay, pier = width / bays, rng.uniform(0.25, 0.45)
        arcade, gable = rng.random(2).tolist()
        # the facade begins above an arcade
        if first := int(arcade < self.arcade_share):
            _colonnade(parts, (width, deep, STOREY_M), bays, pier, rng=rng)
        _facade(parts, (width, deep), bays, pier, relief, (first * STOREY_M, top))
        for storey in range(first, storeys):
            z = storey * STOREY_M
            # a sill below the windows, and a cornice at the ceiling
            parts.box("building", (0, relief / 2, z + 0.7), (width, relief, z + 0.95))
            parts.box("building", (0, -0.1, z + STOREY_M - 0.25), (width, relief, z + STOREY_M))
            # none at the ground; drawn for every storey, so that the number of draws is the same
            for n in np.flatnonzero(rng.random(bays) < self.balcony_share * (storey > 0)).tolist():
                _balcony(parts.at(n * bay + pier / 2, 0, z), bay - pier, rng=rng)
        over = rng.uniform(0.2, 0.8)
        if gable < self.gable_share:
            _gable_roof(parts.at(0.0, -over, top), width, deep + 2 * over, rng.uniform(0.5, 0.9))
        else:
            parts.box("roof", (0, -over, top), (width, deep, top + 0.3))

    def _pavement(self, parts: Parts, kerb: float, wide: float, *, rng: Generator) -> None:
        x_m, gap = self.size_m[0], rng.uniform(10.0, 15.0)
        posts = np.arange(rng.uniform(0.5, gap), x_m, gap).tolist()
        height, wired = rng.uniform(5.0, 8.0), rng.random() < self.wire_share
        _lamp_posts(parts, posts, kerb, height, wired=wired)
        # a few signs at random places of the pavement
        for x, offset in rng.uniform(
            (0.0, 0.5), (x_m, wide), (int(rng.integers(0, 5)), 2)
        ).tolist():
            parts.rod("pole", (x, kerb + offset, 0), (x, kerb + offset, 2.4), 0.04)
            parts.box("sign", (x - 0.35, kerb + offset - 0.05, 1.9), (x + 0.35, kerb + offset, 2.6))
        for (x,) in scattered(self.tree_density, x_m * wide, (1.0,), (x_m - 1.0,), rng=rng):
            _tree(parts.at(x, kerb + 1.0), rng.uniform(4.0, 8.0), rng=rng)
        for x, long in scattered(self.bush_density, x_m * wide, (0.0, 1.0), (x_m, 5.0), rng=rng):
            high = rng.uniform(0.5, 1.6)
            low = (x, kerb + wide - 0.8, 0.0)
            parts.box("vegetation", low, (min(x + long, x_m), kerb + wide - 0.1, high))


def _tree(parts: Parts, height: float, *, rng: Generator) -> None:
    """Add a tree of this height at the origin of a frame: a trunk under a crown of ellipsoids."""
    bole = height * rng.uniform(0.3, 0.5)
    parts.limb("trunk", (0, 0, 0), (0.02 * height, 0, bole + 0.2 * height), 0.025 * height)
    spread = 0.22 * height
    for _ in range(int(rng.integers(3, 7))):
        x, y, z, size, flat = rng.uniform(-1.0, 1.0, 5).tolist()
        radius = spread * (0.8 + 0.3 * size)
        middle = (spread * x, spread * y, (bole + height) / 2 + (height - bole) * 0.3 * z)
        parts.ball("vegetation", middle, (radius, radius, radius * (0.8 + 0.2 * flat)))


def _balcony(parts: Parts, width: float, *, rng: Generator) -> None:
    """Add a balcony along x, in front of y = 0, with a wall or a railing."""
    depth = rng.uniform(0.8, 1.4)
    parts.box("building", (0, -depth, -0.15), (width, 0, 0.0))
    if rng.random() < 0.5:
        parts.box("fence", (0, -depth, 0), (width, -depth + 0.08, 1.0))
    else:
        parts.limb("fence", (0, -depth, 1.0), (width, -depth, 1.0), 0.03)
        for x in np.linspace(0.0, width, 5).tolist():
            parts.limb("fence", (x, -depth, 0), (x, -depth, 1.0), 0.02)


def _colonnade(parts: Parts, size: Point, bays: int, pier: float, *, rng: Generator) -> None:
    """Add a ground floor of `size` that stands back behind a row of columns along x at y = 0."""
    width, deep, high = size
    # the block that carries the upper storeys, set back
    parts.box("building", (0, rng.uniform(1.8, 2.8), 0), (width, deep, high))
    for n in range(bays + 1):
        x = min(max(n * (width / bays), pier / 2), width - pier / 2)
        parts.rod("column", (x, pier / 2, 0), (x, pier / 2, high), pier / 2)


def _facade(
    parts: Parts,
    size: tuple[float, float],
    bays: int,
    pier: float,
    relief: float,
    span: tuple[float, float],
) -> None:
    """Add a block of `size` along x and y, from one height to another.

    Its front at y = 0 has piers between bays, which stand out by `relief`."""
    (width, deep), (bottom, top) = size, span
    parts.box("building", (0, relief, bottom), (width, deep, top))
    for n in range(bays + 1):
        # the outer piers stay within the front
        low = min(max(n * (width / bays) - pier / 2, 0.0), width - pier)
        parts.box("building", (low, 0, bottom), (low + pier, relief, top))


def _gable_roof(parts: Parts, width: float, deep: float, rise: float) -> None:
    """Add two planes that rise by `rise` over a rectangle from the origin, with the ridge along
    x."""
    half = float(np.sqrt(1 + rise * rise)) * deep / 4
    # half the slope's angle by half-angle formulas, for a quaternion about x
    cosine = float(np.sqrt((1 + 1 / np.sqrt(1 + rise * rise)) / 2))
    sine = float(np.sqrt(1 - cosine * cosine))
    for side, turn in ((0.25, sine), (0.75, -sine)):
        size, middle = (width / 2 + 0.2, half, 0.1), (width / 2, deep * side, rise * deep / 4)
        parts.solid("roof", BOX, size, middle, (cosine, turn, 0.0, 0.0))


def _lamp_posts(
    parts: Parts, places: Sequence[float], kerb: float, height: float, *, wired: bool
) -> None:
    """Add lamp posts along x behind a kerb, whose arms hang over the road; wires between them if
    `wired`."""
    y = kerb + 0.4
    for x in places:
        parts.rod("pole", (x, y, 0), (x, y, height), 0.09)
        parts.limb("pole", (x, y, height), (x, kerb - 1.2, height + 0.2), 0.05)
    if wired:
        for left, right in pairwise(places):
            for z in (height - 0.1, height - 0.6):
                _cable(parts, (left, y, z), (right, y, z))


def _cable(parts: Parts, start: Point, end: Point) -> None:
    """Add a wire between two points that sags by 0.3 m: two straight pieces."""
    x, y, z = ((a + b) / 2 for a, b in zip(start, end, strict=True))
    parts.limb("cable", start, (x, y, z - 0.3), 0.025)
    parts.limb("cable", (x, y, z - 0.3), end, 0.025)
