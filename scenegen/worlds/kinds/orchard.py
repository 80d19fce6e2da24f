"""An orchard: rows of low trees with branching crowns on trellises, and aisles between them."""

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import sin_cos
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts


@dataclass(frozen=True, kw_only=True)
class Orchard(Classed):
    """Rows along y under hail nets. Posts carry wires, and trees branch twice and bear leaves in
    clumps. Rows are interrupted by passages; carts, crates, ladders and nets that hang down block
    aisles, often beyond the passage where one could still turn."""

    version = 1
    for_training = False
    graded = {
        "easy": {
            "row_m": (4.5, 5.5),
            "tree_m": (3.0, 4.0),
            "stretch_m": (6.0, 9.0),
            "blocked_share": 0.1,
            "clumps": (4.0, 7.0),
        },
        "hard": {
            "row_m": (2.9, 3.5),
            "tree_m": (1.5, 1.9),
            "stretch_m": (11.0, 17.0),
            "blocked_share": 0.4,
            "clumps": (10.0, 13.0),
        },
    }
    crowded_by = ("blocked_share", "-row_m")
    movers = ("person", "drone")
    flight_defaults = {"altitude_m": (0.5, 3.4), "min_distance_m": 8.0, "flights_per_world": 8}

    size_m: Size = (36.0, 36.0, 4.6)
    """Extent along x and y, metres; along z, the height of the hail nets at most."""
    ground: bool = True
    """Whether there is ground."""
    row_m: Range = (3.2, 4.2)
    """From row to row, metres; one value a world. Source: 3.0 to 4.5 m in apple orchards on
    trellises (growers' guides)."""
    tree_m: Range = (1.8, 2.6)
    """From tree to tree in a row, metres; one value a world. Source: 0.8 to 3 m, as above."""
    stretch_m: Range = (8.0, 13.0)
    """Length of a row between two passages, metres."""
    passage_m: Range = (1.8, 3.0)
    """Width of a passage through a row, metres."""
    height_m: Range = (2.6, 3.8)
    """Height of trees, metres; one value a tree."""
    clumps: Range = (7.0, 10.0)
    """Clumps of leaves of a tree; one value a world."""
    blocked_share: float = 0.22
    """Share of stretches of an aisle in which something stands in the way."""
    netted_share: float = 0.7
    """Share of worlds with hail nets over the rows."""

    def max_solids(self) -> float:
        """Count trees, posts with their wires, and what stands in the aisles."""
        x_m, y_m, _ = self.size_m
        rows = x_m / self.row_m[0] + 2
        trees = y_m / self.tree_m[0] * (15 + self.clumps[1])
        stretches = y_m / (self.stretch_m[0] + self.passage_m[0]) + 2
        return rows * (trees + stretches * (40 + self.stretch_m[1]) + 4 + 2 * y_m)

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Plant row after row, then block aisles.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, _, z_m) = self.begun("terrain"), self.size_m
        pitch, apart = rng.uniform(*self.row_m), rng.uniform(*self.tree_m)
        clumps, top = round(rng.uniform(*self.clumps)), rng.uniform(0.9, 1.0) * z_m
        netted = rng.random() < self.netted_share
        rows = np.arange(rng.uniform(0.3, 1.0) * pitch, x_m, pitch).tolist()
        for x in rows:
            for low, high in self._stretches(rng=rng):
                _trellis(parts, x, (low, high), top)
                for y in np.arange(low + 0.4 * apart, high - 0.3, apart).tolist():
                    height = rng.uniform(*self.height_m)
                    _tree(parts.at(x, y), height, clumps, rng=rng)
        for x, beyond in pairwise(rows):
            # stretches of its own: what blocks an aisle may be far from the next passage
            for low, high in self._stretches(rng=rng):
                blocked, at = rng.random(), rng.uniform(low, high)
                if blocked < self.blocked_share:
                    _blocked(parts.at((x + beyond) / 2, at), (beyond - x) / 2, top, rng=rng)
            if netted:
                # the net's strings along the aisle; it sags in the middle
                for n in range(4):
                    at, sag = x + n / 4 * (beyond - x), 0.3 * (1 - abs(n - 2) / 2)
                    ends = (at, 0, top - sag), (at, self.size_m[1], top - sag)
                    parts.rod("cable", *ends, 0.012)
        if netted:
            for y in np.arange(0.5, self.size_m[1], 1.0).tolist():
                for (x, beyond), (sags, rises) in product(pairwise(rows), ((0.0, 0.3), (0.3, 0.0))):
                    middle = (x + beyond) / 2
                    begin, end = (x, middle) if rises else (middle, beyond)
                    parts.rod("cable", (begin, y, top - sags), (end, y, top - rises), 0.012)
        parts.add_to(spec)

    def _stretches(self, *, rng: Generator) -> list[tuple[float, float]]:
        """Divide the length of a row by passages."""
        # begun before the world's edge: else the first passages of all rows would be nearly in line
        y, stretches = -rng.uniform(0.0, self.stretch_m[1]), []
        while y < self.size_m[1]:
            end = y + rng.uniform(*self.stretch_m)
            low, high = max(y, 0.0), min(end, self.size_m[1])
            if high - low > 1.5:  # no post stands by itself
                stretches.append((low, high))
            y = end + rng.uniform(*self.passage_m)
        return stretches


def _trellis(parts: Parts, x: float, span: tuple[float, float], top: float) -> None:
    """Add posts along y from one end of a stretch to the other, and wires between the outer two."""
    low, high = span
    count = max(round((high - low) / 6.0), 1)
    for y in np.linspace(low, high, count + 1).tolist():
        parts.rod("pole", (x, y, 0), (x, y, top), 0.05)
    for z in np.arange(0.7, top - 0.8, 0.55).tolist():
        parts.rod("cable", (x, low, z), (x, high, z), 0.01)
    # the end posts are held by stays within the row
    stay = min(1.5, (high - low) / 2)
    for y, foot in ((low, low + stay), (high, high - stay)):
        parts.limb("pole", (x, foot, 0), (x, y, 0.7 * top), 0.04)


def _tree(parts: Parts, height: float, clumps: int, *, rng: Generator) -> None:
    """Add a tree at the origin of a frame: a bole, boughs around it, which are trained along y, and
    twigs with leaves."""
    bole, radius = rng.uniform(0.5, 0.8), rng.uniform(0.05, 0.09)
    lean, drawn = rng.uniform(-0.12, 0.12, 2).tolist(), rng.random((4, 4)).tolist()
    top = (lean[0] * height, lean[1] * height, 0.85 * height)
    parts.limb("trunk", (0, 0, 0), (0.4 * top[0], 0.4 * top[1], bole + 0.4), radius)
    parts.limb("trunk", (0.4 * top[0], 0.4 * top[1], bole + 0.4), top, 0.6 * radius)
    tips = [top]
    for n, (turn, far, rise, twig) in enumerate(drawn):
        # boughs in turn around the bole, higher and shorter ones last
        # by the golden angle, .382 of a turn: no bough hides the one below it
        angle = 2 * np.pi * (0.382 * n + 0.1 * turn)
        sine, cosine = (part.item() for part in sin_cos(np.array(angle)))
        z, reach = bole + (height - bole) * 0.18 * n, 0.6 + 0.5 * far - 0.08 * n
        foot = (0.4 * top[0], 0.4 * top[1], z)
        # half as far across the row: trees on a trellis are trained along it
        cosine *= 0.5
        fork = (reach * 0.6 * cosine, reach * 0.6 * sine, z + 0.25 + 0.2 * rise)
        parts.limb("trunk", foot, fork, 0.45 * radius)
        for side in (-0.5, 0.5):
            bent = side * (0.5 + twig)
            tip = (
                fork[0] + 0.45 * reach * (cosine - bent * sine),
                fork[1] + 0.45 * reach * (sine + bent * cosine),
                fork[2] + 0.25 + 0.3 * rise,
            )
            if side > 0 or twig < 0.5:
                parts.limb("trunk", fork, tip, 0.25 * radius)
                tips.append(tip)
    for n, (x, y, z) in enumerate(rng.uniform(-0.15, 0.15, (clumps, 3)).tolist()):
        # leaves around the tips, the first of them at the top
        tip, size = tips[n % len(tips)], 0.32 + x
        parts.ball("vegetation", (tip[0] + y, tip[1] + z, tip[2]), (size, size, 0.75 * size))


def _blocked(parts: Parts, half: float, top: float, *, rng: Generator) -> None:
    """Put something in the way, across the middle of an aisle of twice `half`."""
    what, turn = rng.random(), rng.uniform(-0.3, 0.3)
    if what < 0.35:  # a net that hangs from row to row
        parts.box("fence", (-half, -0.02, 0.1), (half, 0.02, top))
    elif what < 0.65:  # stacks of crates, side by side
        for x in np.arange(-half + 0.7, half - 0.1, 1.2).tolist():
            high, yaw = 0.6 * int(rng.integers(2, 6)), rng.uniform(-0.15, 0.15)
            stack = parts.at(x, rng.uniform(-0.4, 0.4), 0.0, yaw)
            stack.box("goods", (-0.55, -0.5, 0), (0.55, 0.5, high))
    elif what < 0.85:  # a cart with crates
        cart, wide = parts.at(0.0, 0.0, 0.0, turn), min(half - 0.5, 0.9)
        cart.box("vehicle", (-wide, -1.6, 0.5), (wide, 1.6, 0.7))
        for x in (-wide - 0.1, wide):
            for y in (-0.9, 0.9):
                cart.rod("tyre", (x, y, 0.35), (x + 0.1, y, 0.35), 0.35)
        for y in (-1.0, 0.1):
            high = 0.7 + 0.6 * int(rng.integers(1, 4))
            cart.box("goods", (-wide, y, 0.7), (wide, y + 1.0, high))
    else:  # a ladder with three legs
        ladder = parts.at(0.0, 0.0, 0.0, turn)
        for x in (-0.4, 0.4):
            ladder.limb("beam", (x, -0.6, 0), (0.5 * x, 0, 2.8), 0.03)
        ladder.limb("beam", (0, 0.9, 0), (0, 0, 2.8), 0.03)
        for rung in np.arange(0.1, 0.95, 0.12).tolist():
            x, y, z = 0.4 - 0.2 * rung, -0.6 * (1 - rung), 2.8 * rung
            ladder.limb("beam", (-x, y, z), (x, y, z), 0.02)
