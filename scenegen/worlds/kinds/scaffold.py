"""A street of façades in tube scaffolding: standards, ledgers, planks, braces, nets and boards."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.random import Generator

from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts, scattered

LIFT_M = 2.0
"""Height of a lift, metres (EN 12811)."""
TUBE_M = 0.024
"""Radius of a tube, metres (EN 39)."""


@dataclass(frozen=True, kw_only=True)
class Scaffold(Classed):
    """Two façades along x face each other across a lane, both behind scaffolds. Scaffolds also
    bridge the lane in places, with some of their sides netted or boarded. Windows lead to rooms,
    which are dead ends."""

    version = 1
    for_training = False
    graded = {
        "easy": {
            "lane_m": (7.0, 10.0),
            "bay_m": (2.6, 3.2),
            "plank_share": 0.3,
            "closed_share": 0.05,
            "bridge_share": 0.1,
            "brace_share": 0.1,
        },
        "hard": {
            "lane_m": (3.5, 4.5),
            "bay_m": (1.6, 2.0),
            "plank_share": 0.75,
            "closed_share": 0.35,
            "bridge_share": 0.55,
            "brace_share": 0.45,
            "litter_density": (0.05, 0.15),
        },
    }
    crowded_by = ("closed_share", "bridge_share")
    movers = ("person", "drone")
    flight_defaults = {"altitude_m": (0.5, 8.5), "min_distance_m": 8.0, "flights_per_world": 8}

    size_m: Size = (40.0, 40.0, 9.6)
    """Extent along x, y and z, metres; façades are as high."""
    ground: bool = True
    """Whether there is ground."""
    lane_m: Range = (4.5, 7.0)
    """Width of the lane between the scaffolds, metres; one value a world."""
    bay_m: Range = (2.1, 2.8)
    """Width of a bay along the façade, metres; one value a world. Source: 1.5 to 3.0 m (EN
    12811)."""
    deep_m: Range = (1.1, 1.5)
    """Depth of a bay, metres; one value a world. Source: classes of width W09 to W15 (EN 12811)."""
    plank_share: float = 0.5
    """Share of bays with planks, at each lift."""
    closed_share: float = 0.18
    """Share of the bays' outer sides that have a net or boards."""
    bridge_share: float = 0.3
    """Share of bays along the lane where the scaffold crosses it."""
    brace_share: float = 0.3
    """Share of the bays' sides with a diagonal."""
    litter_density: Range = (0.0, 0.05)
    """Pallets, barrels and heaps in the lane, per square metre; one value a world."""

    def max_solids(self) -> float:
        """Count tubes, planks and closed sides of bays, and rooms behind."""
        x_m, _, z_m = self.size_m
        bays, lifts = x_m / self.bay_m[0] + 1, z_m / LIFT_M + 1
        rows = 4 + self.lane_m[1] / self.deep_m[0] + 2
        return bays * rows * (4 + lifts * 6) + 2 * bays * lifts * 8 + 400

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Build both sides, then the bridges between them.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, z_m) = self.begun("terrain"), self.size_m
        lane, deep = rng.uniform(*self.lane_m), rng.uniform(*self.deep_m)
        # whole bays: the last one ends with the façade
        count = max(round(x_m / rng.uniform(*self.bay_m)), 1)
        # standards go on for a metre above the last lift, to carry its rail
        bay, lifts = x_m / count, max(int((z_m - 1.0) / LIFT_M), 1)
        for turn in (0.0, np.pi):
            # x along the façade, y from the middle of the lane outwards
            side = parts.at(x_m / 2, y_m / 2, 0.0, turn).at(-x_m / 2, lane / 2)
            rows = np.array([0.0, deep, 2 * deep])
            self._bays(side, np.arange(count + 1) * bay, rows, lifts, rng=rng)
            front = 2 * deep + 0.3
            # rooms are 4 m deep at least, if need be beyond the world's edge
            self._house(side.at(0.0, front), max(y_m / 2 - lane / 2 - front, 4.0), rng=rng)
        n = 0
        while n < count:
            wide = int(rng.integers(1, 3))
            if rng.random() < self.bridge_share:
                rows = np.linspace(0.0, lane, max(round(lane / 2.0), 2) + 1)
                across = parts.at(n * bay, (y_m - lane) / 2)
                xs = np.arange(min(wide, count - n) + 1) * bay
                self._bays(across, xs, rows, lifts, rng=rng)
            # a bay stays open: two bridges side by side would be one
            n += wide + 1
        inside = (0.5, -lane / 2 + 0.5), (x_m - 0.5, lane / 2 - 0.5)
        for x, y in scattered(self.litter_density, x_m * lane, *inside, rng=rng):
            _litter(parts.at(x, y_m / 2 + y, 0.0, rng.uniform(0.0, np.pi)), rng=rng)
        parts.add_to(spec)

    def _bays(
        self, parts: Parts, xs: np.ndarray, ys: np.ndarray, lifts: int, *, rng: Generator
    ) -> None:
        """Add bays of tubes between all of `xs` along and `ys` across, metres."""
        top, (x0, *_, x1), (y0, *_, y1) = lifts * LIFT_M + 1.0, xs.tolist(), ys.tolist()
        for x, y in product(xs.tolist(), ys.tolist()):
            parts.rod("beam", (x, y, 0), (x, y, top), TUBE_M)
        for lift in range(1, lifts + 1):
            z = lift * LIFT_M
            for y in ys.tolist():
                parts.rod("beam", (x0, y, z), (x1, y, z), TUBE_M)
            for x in xs.tolist():
                parts.rod("beam", (x, y0, z), (x, y1, z), TUBE_M)
            for y in (y0, y1):  # rails
                parts.rod("beam", (x0, y, z + 1.0), (x1, y, z + 1.0), TUBE_M)
        # planks at each lift, and the sides below it
        for n, m, lift in np.ndindex(len(xs) - 1, len(ys) - 1, lifts):
            (a, b), (c, d), z = xs[n : n + 2].tolist(), ys[m : m + 2].tolist(), lift * LIFT_M
            # all five for every bay, so that shares do not change other draws
            planked, closed, braced, axis, far = rng.random(5).tolist()
            if planked < self.plank_share:
                # three planks with gaps, through which rays pass
                for y in np.linspace(c + 0.05, d - 0.05, 4).tolist()[:-1]:
                    wide = (d - c - 0.1) / 3
                    low = (a, y + 0.02, z + LIFT_M)
                    # no class is of planks: as in `industrial`, what people walk on is `stairs`
                    parts.box("stairs", low, (b, y + wide - 0.02, z + LIFT_M + 0.05))
            # a side across x or y, on either end
            x, y = (b if far < 0.5 else a), (d if far < 0.5 else c)
            ends = ((x, c), (x, d)) if axis < 0.5 else ((a, y), (b, y))
            (u, v), (s, t) = ends
            if closed < self.closed_share:
                of_class = "fence" if closed < 0.6 * self.closed_share else "goods"
                thick = 0.01 if of_class == "fence" else 0.03
                low, high = (u - thick, v - thick, z + 0.1), (s + thick, t + thick, z + LIFT_M)
                parts.box(of_class, low, high)
            elif braced < self.brace_share:
                parts.rod("beam", (u, v, z + 0.1), (s, t, z + LIFT_M), TUBE_M)

    def _house(self, parts: Parts, deep: float, *, rng: Generator) -> None:
        """Add storeys of rooms behind y = 0, each with a window or a door to the scaffold."""
        (x_m, _, z_m), storey = self.size_m, rng.uniform(2.9, 3.3)
        rooms = max(round(x_m / rng.uniform(3.5, 6.0)), 1)
        wide, back = x_m / rooms, min(deep, rng.uniform(4.0, 6.0))
        for level in range(max(int(z_m / storey), 1)):
            z = level * storey
            parts.box("ceiling", (0, 0, z + storey - 0.25), (x_m, deep, z + storey))
            # solid behind the rooms, which are dead ends
            parts.box("building", (0, back, z), (x_m, deep, z + storey))
            for n in range(rooms):
                low, high, place, bare = rng.random(4).tolist()
                # three in ten have no sill: they are doors to the scaffold
                width, sill = 0.9 + 0.9 * low, 0.9 * (high < 0.7)
                begin = n * wide + 0.2 + place * (wide - width - 0.4)
                opening = ((begin, begin + width), (z + sill, z + 2.2))
                whole = ((n * wide, (n + 1) * wide), (z, z + storey - 0.25))
                parts.wall("building", 1, 0.15, 0.15, whole, opening if bare < 0.8 else None)
                parts.box("wall", (n * wide - 0.1, 0, z), (n * wide + 0.1, back, z + storey))


def _litter(parts: Parts, *, rng: Generator) -> None:
    """Add a pallet of stones, a barrel, or a board on trestles, around the origin of a frame."""
    what, size = rng.random(2).tolist()
    if what < 0.5:
        parts.box("goods", (-0.6, -0.4, 0), (0.6, 0.4, 0.4 + 1.2 * size))
    elif what < 0.8:
        parts.rod("tank", (0, 0, 0), (0, 0, 0.9), 0.3)
    else:
        parts.box("furniture", (-1.0, -0.3, 0.8), (1.0, 0.3, 0.85))
        for x in (-0.8, 0.8):
            parts.box("furniture", (x - 0.04, -0.3, 0), (x + 0.04, 0.3, 0.8))
