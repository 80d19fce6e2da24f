"""A collapsed building: slabs that lean on each other, broken columns, heaps and cavities."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.random import Generator

from lidarsim.parameters import number
from lidarsim.solids import BOX
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts, scattered


@dataclass(frozen=True, kw_only=True)
class Rubble(Classed):
    """A frame of columns and floors, fallen bay by bay in the patterns that rescuers tell apart:
    floors that lean on one side, that broke in the middle, that lie upon each other, that hang, or
    that still stand. Below are voids, of which some lead nowhere."""

    version = 1
    for_training = False
    graded = {
        "easy": {
            "bay_m": (6.0, 7.5),
            "clear_share": 0.45,
            "wall_share": 0.15,
            "heap_density": (0.0, 0.008),
        },
        "hard": {
            "bay_m": (4.0, 5.0),
            "clear_share": 0.05,
            "wall_share": 0.5,
            "heap_density": (0.02, 0.035),
        },
    }
    crowded_by = ("heap_density", "wall_share")
    movers = ("person", "drone")
    flight_defaults = {"altitude_m": (0.4, 3.8), "min_distance_m": 8.0, "flights_per_world": 8}

    size_m: Size = (40.0, 40.0, 7.0)
    """Extent along x and y, metres; `storey_m` decides along z."""
    ground: bool = True
    """Whether there is ground."""
    bay_m: Range = number((4.8, 6.2), minimum=2.0, maximum=1000)
    """From column to column, metres; one value a world. Source: spans of 4 to 8 m of frames in
    reinforced concrete."""
    storey_m: Range = number((2.8, 3.4), minimum=2.0, maximum=20.0)
    """Height of a storey, metres; one value a world."""
    clear_share: float = 0.15
    """Share of bays from which a floor is gone."""
    wall_share: float = 0.3
    """Share of sides of bays where a wall still stands, broken."""
    heap_density: Range = (0.006, 0.02)
    """Heaps of debris per square metre; one value a world."""
    rebar_share: float = 0.5
    """Share of slabs out of whose edge the reinforcement stands."""

    def max_solids(self) -> float:
        """Count the slabs and walls of each bay of two storeys, and heaps."""
        x_m, y_m, _ = self.size_m
        bays = (x_m / self.bay_m[0] + 1) * (y_m / self.bay_m[0] + 1)
        return bays * 2 * 32 + 16 * self.heap_density[1] * x_m * y_m

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Let each bay fall, then strew debris.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, _) = self.begun("terrain"), self.size_m
        bay, storey = rng.uniform(*self.bay_m), rng.uniform(*self.storey_m)
        counts = [max(round(edge / bay), 1) for edge in (x_m, y_m)]
        wide, deep = x_m / counts[0], y_m / counts[1]
        for n, m in np.ndindex(counts[0] + 1, counts[1] + 1):
            _column(parts.at(n * wide, m * deep), storey, rng=rng)
        for n, m in np.ndindex(*counts):
            # along either axis, to either side
            turn = int(rng.integers(0, 4))
            # a quarter turn exchanges the edges
            size = (wide, deep) if turn % 2 == 0 else (deep, wide)
            frame = parts.at((n + 0.5) * wide, (m + 0.5) * deep, 0.0, turn * np.pi / 2)
            self._bay(frame, size, storey, rng=rng)
            for axis, chance, *broken in rng.random((2, 6)).tolist():
                if chance < self.wall_share:
                    side = parts.at(n * wide, m * deep, 0.0, np.pi / 2 if axis < 0.5 else 0.0)
                    _wall(side, deep if axis < 0.5 else wide, storey, broken)
        for x, y in scattered(self.heap_density, x_m * y_m, (0.0, 0.0), (x_m, y_m), rng=rng):
            _heap(parts.at(x, y, 0.0, rng.uniform(0.0, np.pi)), rng=rng)
        parts.add_to(spec)

    def _bay(
        self, parts: Parts, size: tuple[float, float], storey: float, *, rng: Generator
    ) -> None:
        """Add the floors over a bay of `size`, around the origin of a frame, as they fell along
        x."""
        (wide, deep), floor = size, 0.0
        half, deep = wide / 2 - 0.15, deep - 0.3
        for upper in range(2):
            gone, how, tilt, slip, bar = rng.random(5).tolist()
            top, roll = (upper + 1) * storey, 0.12 * (tilt - 0.5)
            if gone < self.clear_share:
                continue
            if how < 0.3:  # leans: one edge still hangs at its height, the other slid down
                low = floor + 0.2 + 0.3 * slip
                ends = [((half, 0, top), (-half + 0.8 * slip, 0, low))]
            elif how < 0.5:  # broke in the middle, both halves hang at their outer edges
                low = floor + 0.3 + slip
                ends = [((x, 0, top), (0.2 * x / half, 0, low)) for x in (half, -half)]
            elif how < 0.7:  # fell flat, upon what lies below
                # what lies flat carries the floors that fall after it
                floor += 0.5 + 0.9 * slip
                ends = [((half, 0, floor), (-half, 0, floor + 0.5 * tilt))]
            elif how < 0.85:  # half of it broke off, and stands on its edge
                ends = [
                    ((half, 0, top), (0.1, 0, top - 0.5 * slip)),
                    ((-half, 0, floor + 0.1), (-0.3, 0, floor + 2.0 + 0.6 * tilt)),
                ]
            else:
                ends, roll = [((half, 0, top), (-half, 0, top))], 0.0
            for start, end in ends:
                parts.slab("floor", start, end, deep, 0.22, roll)
                if bar < self.rebar_share:
                    _rebar(parts, end, deep, rng=rng)


def _rebar(parts: Parts, edge: tuple[float, float, float], deep: float, *, rng: Generator) -> None:
    """Add bent bars that stand out of a slab's edge."""
    (x, _, z), count = edge, 6
    ys = np.linspace(-0.4 * deep, 0.4 * deep, count).tolist()
    drawn = rng.uniform((-0.9, -0.3, -0.5), (0.9, 0.3, 0.6), (count, 3)).tolist()
    for y, (along, aside, up) in zip(ys, drawn, strict=True):
        end = (x + along, y + aside, max(z + up, 0.05))
        parts.limb("pole", (x, y, z), end, 0.012)


def _column(parts: Parts, storey: float, *, rng: Generator) -> None:
    """Add a column at the origin of a frame: whole, or a stump with its upper part beside it."""
    whole, cut, turn, far = rng.random(4).tolist()
    high = 2 * storey if whole < 0.45 else storey * (0.3 + 1.2 * cut)
    parts.box("column", (-0.22, -0.22, 0), (0.22, 0.22, high))
    if whole > 0.7:
        # the part that broke off leans on the stump
        reach, side = 1.2 + far, 1 if turn < 0.5 else -1
        foot = (side * reach, reach * (2 * cut - 1), 0.15)
        parts.slab("column", foot, (0.1 * side, 0, high + 0.3), 0.4, 0.4)


def _wall(parts: Parts, long: float, storey: float, broken: list[float]) -> None:
    """Add a wall along x from the origin of a frame, in strips that broke at different heights, and
    a hole."""
    hole, width, *heights = broken
    edges = [0.0, (0.15 + 0.4 * hole) * long, (0.15 + 0.4 * hole) * long + 0.8 + 0.8 * width, long]
    for n, (a, b) in enumerate(pairwise(edges)):
        # the strip in the middle is the hole, under what is left of a lintel
        high = storey * (0.35 + 0.6 * heights[n % 2])
        if n == 1 and high > 2.3:
            parts.box("wall", (a, -0.1, 2.1), (b, 0.1, high))
        elif n != 1 and b - a > 0.1:
            parts.box("wall", (a, -0.1, 0), (b, 0.1, high))


def _heap(parts: Parts, *, rng: Generator) -> None:
    """Add blocks of any attitude, the largest ones in the middle and below."""
    spread, count = rng.uniform(0.6, 1.6), int(rng.integers(6, 15))
    drawn = rng.uniform(-1.0, 1.0, (count, 9)).tolist()
    for x, y, z, a, b, c, *turn in drawn:
        outer = max(abs(x), abs(y))
        size = [(0.22 + 0.12 * part) * spread * (1.3 - 0.6 * outer) for part in (a, b, c)]
        centre = (spread * x, spread * y, (0.5 + 0.5 * z) * spread * (1 - outer) * 0.8)
        # any direction of four numbers is a turn
        norm = float(np.sqrt(1 + sum(part * part for part in turn)))
        quat = (1 / norm, *(part / norm for part in turn))
        parts.solid("rock", BOX, size, centre, quat)
