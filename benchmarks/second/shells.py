# ruff: noqa
# mypy: ignore-errors
"""Kinds whose solids are thin: hollow boxes and slabs, and crowns of single leaves."""

from dataclasses import dataclass

import numpy as np

from lidarsim.solids import BOX
from scenegen.worlds.kinds.kind import Classed, attitudes


@dataclass(frozen=True, kw_only=True)
class Shells(Classed):
    """Houses with rooms, sheds, cupboards, cars and tables, all of thin sheets; fences and poles."""

    version = 1
    crowded_by = ("density",)
    flight_defaults = {"altitude_m": (0.6, 5.0)}
    size_m: tuple[float, float, float] = (40.0, 40.0, 8.0)
    ground: bool = True
    density: tuple[float, float] = (0.008, 0.035)
    """Things per square metre; one value a world."""

    def max_solids(self):
        return 40 * self.density[1] * self.size_m[0] * self.size_m[1]

    def add_to(self, spec, *, rng):
        parts, (x_m, y_m, _) = self.begun("terrain"), self.size_m
        count = int(rng.uniform(*self.density) * x_m * y_m)
        for _ in range(count):
            x, y, yaw = rng.uniform(1, x_m - 1), rng.uniform(1, y_m - 1), rng.uniform(0, 6.3)
            frame = parts.at(x, y, 0.0, 0.0 if rng.random() < 0.5 else yaw)
            what = rng.random()
            if what < 0.25:
                self.hollow(
                    frame, rng.uniform(3, 9), rng.uniform(3, 8), rng.uniform(2.4, 6.5), 0.12, rng
                )
            elif what < 0.5:
                self.hollow(
                    frame,
                    rng.uniform(0.5, 2.5),
                    rng.uniform(0.4, 1.2),
                    rng.uniform(0.5, 2.4),
                    0.025,
                    rng,
                )
            elif what < 0.6:  # a car: a shell with open windows
                a, b = rng.uniform(3.8, 4.8), rng.uniform(1.6, 1.9)
                self.hollow(frame.at(0, 0, 0.25), a, b, 0.75, 0.03, rng)
                self.hollow(frame.at(0.2, 0, 1.0), 0.55 * a, b - 0.2, 0.5, 0.03, rng)
            elif what < 0.72:
                a, b, h = rng.uniform(0.6, 2.2), rng.uniform(0.5, 1.2), rng.uniform(0.5, 1.1)
                frame.box("furniture", (-a / 2, -b / 2, h - 0.04), (a / 2, b / 2, h))
                for u in (-a / 2 + 0.05, a / 2 - 0.05):
                    for v in (-b / 2 + 0.05, b / 2 - 0.05):
                        frame.rod("furniture", (u, v, 0), (u, v, h), 0.03)
            elif what < 0.88:
                a, h, t = rng.uniform(1.5, 10), rng.uniform(0.8, 5.0), rng.uniform(0.02, 0.15)
                frame.box("fence", (-a / 2, -t / 2, 0), (a / 2, t / 2, h))
            else:
                h = rng.uniform(1.5, 7.5)
                frame.rod("pole", (0, 0, 0), (0, 0, h), rng.uniform(0.02, 0.12))
                if rng.random() < 0.4:
                    frame.box("sign", (-0.5, -0.03, h - 0.6), (0.5, 0.03, h))
        parts.add_to(spec)

    def hollow(self, parts, a, b, h, t, rng):
        """A box of sheets with doors or windows; large ones have rooms."""
        sides = [
            (0, -a / 2, (-b / 2, b / 2)),
            (0, a / 2, (-b / 2, b / 2)),
            (1, -b / 2, (-a / 2, a / 2)),
            (1, b / 2, (-a / 2, a / 2)),
        ]
        if a > 5:
            sides.append((0, rng.uniform(-0.2, 0.2) * a, (-b / 2, b / 2)))
        open_side = int(rng.integers(0, 8))
        for n, (axis, at, span) in enumerate(sides):
            if n == open_side and a < 3:
                continue
            wide = span[1] - span[0]
            low = span[0] + rng.uniform(0.1, 0.5) * wide
            hole = (low, low + rng.uniform(0.15, 0.4) * wide)
            tall = (0.0, min(2.1, 0.8 * h)) if rng.random() < 0.5 else (0.35 * h, 0.8 * h)
            opening = (hole, tall) if rng.random() < 0.7 else None
            parts.wall("building", axis, at, t / 2, (span, (0.0, h)), opening)
        if rng.random() < 0.7:
            parts.box("roof", (-a / 2, -b / 2, h), (a / 2, b / 2, h + t))


@dataclass(frozen=True, kw_only=True)
class Leaves(Classed):
    """Trees with branches and single leaves, and bushes of leaves."""

    version = 1
    crowded_by = ("trees",)
    flight_defaults = {"altitude_m": (0.8, 5.0)}
    size_m: tuple[float, float, float] = (40.0, 40.0, 12.0)
    ground: bool = True
    trees: tuple[float, float] = (10.0, 120.0)

    def max_solids(self):
        return 140.0 * self.trees[1]

    def add_to(self, spec, *, rng):
        parts, (x_m, y_m, _) = self.begun("terrain"), self.size_m
        count = int(rng.uniform(*self.trees))
        each = min(120, int(9000 / count))
        bare, long = rng.uniform(0.1, 0.7), rng.uniform(0.6, 2.5)
        for _ in range(count):
            frame = parts.at(rng.uniform(0.5, x_m - 0.5), rng.uniform(0.5, y_m - 0.5))
            if rng.random() < 0.2:
                radius = rng.uniform(0.4, 1.5)
                self.leaves(frame, (0, 0, 0.6 * radius), radius, each, rng)
                continue
            h, r = rng.uniform(4, 14), rng.uniform(0.06, 0.3)
            lean = rng.uniform(-0.3, 0.3, 2).tolist()
            frame.limb("trunk", (0, 0, 0), (lean[0], lean[1], h), r)
            for _ in range(int(rng.integers(3, 12))):
                z = rng.uniform(bare, 1.0) * h
                u, v = rng.uniform(-long, long, 2).tolist()
                end = (u, v, z + rng.uniform(-0.3, 0.8))
                frame.limb("trunk", (lean[0] * z / h, lean[1] * z / h, z), end, 0.25 * r)
                self.leaves(frame, end, 0.45 * long, each // 8, rng)
        parts.add_to(spec)

    def leaves(self, frame, centre, radius, count, rng):
        places = np.array(centre) + rng.uniform(-radius, radius, (count, 3))
        for place, quat in zip(
            places.tolist(), attitudes(count, 1.0, rng=rng).tolist(), strict=True
        ):
            if place[2] > 0.02:
                half = rng.uniform(0.03, 0.12)
                frame.solid("vegetation", BOX, (half, half, 0.01), place, quat)
