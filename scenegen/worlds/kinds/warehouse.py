"""A warehouse: aisles between racks of pallets, conveyors, columns and trusses under the roof."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts

BAY_M = 2.7
"""Width of a bay of a rack for three pallets, metres (EN 15620)."""
PALLET_M = (1.2, 0.8, 0.15)
"""A EUR pallet (EN 13698-1), metres."""


@dataclass(frozen=True, kw_only=True)
class Warehouse(Classed):
    """Rows of double racks along y with aisles between them and a cross aisle. Aisles are 2.4 to
    3.6 m wide, as forklifts and reach trucks need them."""

    version = 1
    graded = {
        "easy": {
            "aisle_m": (3.6, 5.0),
            "empty_share": 0.5,
            "fill_share": (0.3, 0.6),
            "goods_density": (0.0, 0.02),
        },
        "hard": {
            "aisle_m": (1.8, 2.4),
            "empty_share": 0.05,
            "fill_share": (0.8, 1.0),
            "levels": (3.0, 5.0),
        },
    }
    crowded_by = ("goods_density", "fill_share")
    flight_defaults = {"altitude_m": (0.8, 6.5)}

    size_m: Size = (40.0, 40.0, 9.0)
    """Extent of the hall along x, y and z, metres."""
    ground: bool = True
    """Whether there is a floor."""
    aisle_m: Range = (2.4, 3.6)
    """Width of aisles, metres; one value a world. Source: reach trucks turn in 2.4 to 3.0 m,
    counterbalanced trucks in 3.4 to 3.7 m (makers' guides)."""
    cross_m: Range = (3.0, 6.0)
    """Width of the cross aisle, metres; one value a world."""
    levels: Range = (2.0, 4.0)
    """Levels of a rack; one value a world."""
    level_m: Range = (1.5, 2.1)
    """Height of a level, metres; one value a world."""
    empty_share: float = 0.25
    """Share of rows without a rack: a conveyor, or free floor with goods on it."""
    fill_share: Range = (0.4, 0.95)
    """Share of pallet places that are taken; one value a world."""
    goods_density: Range = (0.0, 0.06)
    """Pallets on the floor of rows without a rack, per square metre; one value a world."""
    conveyor_share: float = 0.5
    """Share of rows without a rack that have a conveyor."""
    truss_share: float = 0.8
    """Share of halls with trusses under the roof."""

    def max_solids(self) -> float:
        """Count racks of single pallets, and goods."""
        x_m, y_m, _ = self.size_m
        bays = x_m / (self.aisle_m[0] + 2.2) * (y_m / BAY_M + 1)
        floor = self.goods_density[1] * x_m * y_m
        trusses = (x_m + 2) * (y_m / 5 + 1)
        conveyors = (x_m / (self.aisle_m[0] + 2.2) + 1) * (2 * y_m + 2)
        return bays * (6 + 8 * (self.levels[1] + 1)) + 4 * floor + trusses + conveyors + 10

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Draw the hall, then row after row.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, z_m) = self.begun("floor"), self.size_m
        for x in (-0.2, x_m):
            parts.box("wall", (x, 0, 0), (x + 0.2, y_m, z_m))
        for y in (-0.2, y_m):
            parts.box("wall", (0, y, 0), (x_m, y + 0.2, z_m))
        aisle, cross = rng.uniform(*self.aisle_m), rng.uniform(*self.cross_m)
        levels = int(rng.integers(int(self.levels[0]), int(self.levels[1]) + 1))
        tall, fill = rng.uniform(*self.level_m), rng.uniform(*self.fill_share)
        goods, gap = rng.uniform(*self.goods_density), rng.uniform(0.3, 0.7) * y_m
        x = rng.uniform(1.0, aisle)
        # a double rack is 2.2 m deep
        while x + 2.3 < x_m:
            # both drawn for every row, so that shares do not change other draws
            empty, belt = rng.random(2).tolist()
            # before and behind the cross aisle
            row = ((0.8, gap - cross / 2), (gap + cross / 2, y_m - 0.8))
            if empty >= self.empty_share:
                for low, high in row:
                    bays = int((high - low) / BAY_M)
                    self._rack(parts.at(x, low), bays, levels, tall, fill, rng=rng)
            elif belt < self.conveyor_share:
                _conveyor(parts.at(x + 0.6, 1.0), y_m - 2.0, rng=rng)
            else:
                # the floor of a row without a rack
                area = 2.2 * (y_m - 2.0)
                drawn = rng.uniform((x, 1.0), (x + 2.2, y_m - 1.0), (round(goods * area), 2))
                for a, b in drawn.tolist():
                    _pallet(parts.at(a, b, 0.0, rng.uniform(0.0, np.pi)), rng=rng)
            x += 2.2 + aisle
        if rng.random() < self.truss_share:
            for y in np.arange(2.5, y_m, 5.0).tolist():
                # a truss is 1.16 m high, and hangs below the roof
                _truss(parts.at(0.0, y, z_m - 1.2), x_m)
        parts.add_to(spec)

    def _rack(
        self,
        parts: Parts,
        bays: int,
        levels: int,
        tall: float,
        fill: float,
        *,
        rng: Generator,
    ) -> None:
        """Add a double rack along y: frames, beams, and pallets on them."""
        # frames end above the last beam
        high = levels * tall + 0.3
        for bay in range(bays + 1):
            for x in (0.0, 1.0, 2.1):
                parts.box("shelf", (x, BAY_M * bay, 0), (x + 0.1, BAY_M * bay + 0.1, high))
        for level in range(levels):
            z = level * tall
            if level > 0:
                for x in (0.0, 1.0, 2.1):
                    parts.box("shelf", (x, 0, z - 0.12), (x + 0.08, BAY_M * bays, z))
            # one load for the three places of a bay on each side
            loaded = rng.random((2, bays)) < fill
            # height and length of a load: below the next beam, within the bay
            sizes = rng.uniform((0.5, 1.2), (tall - 0.35, 2.55), (2, bays, 2)).tolist()
            for side in range(2):
                for bay in np.flatnonzero(loaded[side]).tolist():
                    top, long = sizes[side][bay]
                    low = (0.05 + 1.1 * side, BAY_M * bay + 0.13, z)
                    parts.box("goods", low, (low[0] + 1.0, low[1] + long - 0.1, z + top))


def _pallet(parts: Parts, *, rng: Generator) -> None:
    """Add a pallet with a load, around the origin of a frame."""
    x, y, z = (PALLET_M[0] / 2, PALLET_M[1] / 2, PALLET_M[2])
    parts.box("goods", (-x, -y, 0), (x, y, z))
    a, b, c = rng.random(3).tolist()
    parts.box("goods", (-x * (0.6 + 0.4 * a), -y, z), (x, y * (0.6 + 0.4 * b), z + 0.3 + 1.4 * c))


def _conveyor(parts: Parts, long: float, *, rng: Generator) -> None:
    """Add a belt along y on legs, with goods on it."""
    high = rng.uniform(0.7, 2.6)
    parts.box("machine", (-0.4, 0, high - 0.15), (0.4, long, high))
    for y in np.arange(0.5, long, 2.5).tolist():
        for x in (-0.4, 0.34):
            parts.box("machine", (x, y, 0), (x + 0.06, y + 0.06, high))
    for y, a, b in rng.uniform((0.5, 0.2, 0.2), (long - 1, 0.6, 0.6), (int(long / 3), 3)).tolist():
        parts.box("goods", (-a / 2, y, high), (a / 2, y + a, high + b))


def _truss(parts: Parts, long: float) -> None:
    """Add two chords along x with posts and diagonals between them."""
    for z in (0.0, 1.0):
        parts.box("beam", (0, -0.08, z), (long, 0.08, z + 0.16))
    for x in np.arange(0.0, long - 2.4, 2.5).tolist():
        parts.box("beam", (x, -0.05, 0.1), (x + 0.1, 0.05, 1.0))
        parts.limb("beam", (x, 0, 0.1), (x + 2.5, 0, 1.0), 0.05)
