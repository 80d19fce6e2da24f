"""A multi-storey car park: decks joined by ramps, columns, cars in bays, and walls with gates."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.random import Generator

from lidarsim.parameters import number
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts, Span, car, join

BAY_M = 2.5
"""Width of a bay for one car, metres (2.4 to 2.5 in most countries' rules)."""
DEEP_M = 5.0
"""Length of a bay, metres."""
BLOCK_M = 3 * BAY_M
"""Three bays between columns, metres."""
DECK_M = 0.25
"""Thickness of a deck, metres."""
RISE_M = 9.0
"""Run of a ramp, metres."""
HEADROOM_M = 2.0
"""Height over a ramp from which on the deck above it is open, metres."""


@dataclass(frozen=True, kw_only=True)
class Parking(Classed):
    """Two decks under a roof. On each, aisles along y have bays on both sides; between the bays of
    neighbouring aisles stand columns, parapets or walls, and fire walls cross the aisles. A random
    spanning tree of the blocks decides which are left open or have a gate, so that others are dead
    ends, seen late behind cars."""

    version = 1
    for_training = False
    graded = {
        "easy": {
            "aisle_m": (7.0, 9.0),
            "wall_share": 0.2,
            "open_share": 0.9,
            "car_share": 0.3,
            "gate_m": (2.0, 3.0),
        },
        "hard": {
            "aisle_m": (5.5, 6.2),
            "wall_share": 0.9,
            "open_share": 0.35,
            "car_share": 0.85,
            "gate_m": (0.9, 1.4),
        },
    }
    crowded_by = ("car_share", "wall_share")
    movers = ("person", "vehicle", "drone")
    flight_defaults = {"altitude_m": (0.5, 5.4), "min_distance_m": 5.0, "flights_per_world": 8}

    size_m: Size = (40.0, 40.0, 6.4)
    """Extent along x and y, metres; `level_m` decides along z."""
    ground: bool = True
    """Whether there is a floor under the lower deck."""
    level_m: Range = number((2.75, 3.2), minimum=2.5, maximum=5.0)
    """Height from deck to deck, metres; one value a world. Source: a clear height of 2.3 m or more,
    beams and a deck."""
    aisle_m: Range = number((6.0, 7.5), minimum=2.0, maximum=100.0)
    """Width of aisles, metres; one value a world. Source: 6.0 to 6.5 m for cars that park at right
    angles."""
    wall_share: float = 0.6
    """Share of closed boundaries of blocks that are walls; the others are parapets."""
    open_share: float = 0.6
    """Share of passable boundaries that are left open; the others are walls with a gate."""
    loop_share: float = 0.25
    """Share of boundaries that are passable though there is another way."""
    gate_m: Range = (1.2, 2.4)
    """Width of gates, metres."""
    car_share: float = 0.6
    """Share of bays that are taken."""
    van_share: float = 0.2
    """Share of cars that are vans, as high as a gate."""

    def max_solids(self) -> float:
        """Count cars, and what stands around each block."""
        x_m, y_m, _ = self.size_m
        blocks = (x_m / (self.aisle_m[0] + 2 * DEEP_M) + 2) * (y_m / BLOCK_M + 1)
        return 2 * blocks * (6 * 7 + 60)

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Lay out aisles and blocks, then build deck after deck.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, _) = self.begun("floor"), self.size_m
        level, aisle = rng.uniform(*self.level_m), rng.uniform(*self.aisle_m)
        pitch = aisle + 2 * DEEP_M
        first = -rng.uniform(0.2, 0.8) * pitch
        spines = [0.0, *np.arange(first + pitch, x_m - 1.0, pitch).tolist(), x_m]
        lines = [0.0, *np.arange(BLOCK_M, y_m - 1.0, BLOCK_M).tolist(), y_m]
        # the middle of each aisle: the outermost are cut by the world's edge
        aisles = [first + pitch * (n + 0.5) for n in range(len(spines) - 1)]
        # a ramp with its walls is 3.5 m wide: an aisle that the world's edge cuts has no room
        inner = [n for n, x in enumerate(aisles) if 3.0 < x < x_m - 3.0]
        ramps: dict[int, int] = {}
        for n in inner:
            # the block in which the ramp of this aisle begins; it needs the next one, too
            ramps[n] = int(rng.integers(1, max(len(lines) - 3, 2)))
        for deck in range(2):
            frame = parts.at(0.0, 0.0, deck * level)
            self._walls(frame, spines, lines, aisles, ramps, level - DECK_M, rng=rng)
            for n, x in enumerate(aisles):
                for m, (low, high) in enumerate(pairwise(lines)):
                    ramp = n in ramps and m - ramps[n] in (0, 1)
                    # the outermost aisles are cut at the world's edge
                    reach = aisle / 2 + DEEP_M
                    across = (max(-reach, -x), min(reach, x_m - x))
                    room = (high - low, level - DECK_M)
                    self._block(frame.at(x, low), aisle, across, room, ramp, rng=rng)
        for n, m in ramps.items():
            _ramp(parts.at(aisles[n], lines[m] + 1.5), level)
        _decks(parts, spines, lines, aisles, ramps, level)
        parts.add_to(spec)

    def _walls(
        self,
        parts: Parts,
        spines: list[float],
        lines: list[float],
        aisles: list[float],
        ramps: dict[int, int],
        clear: float,
        *,
        rng: Generator,
    ) -> None:
        """Add the boundaries of one deck's blocks, in a random order, and the columns."""
        borders = [
            (axis, n, m)
            for n in range(len(spines) - 1)
            for m in range(len(lines) - 1)
            for axis, last in ((0, n + 2 == len(spines)), (1, m + 2 == len(lines)))
            if not last
        ]
        joins, drawn = dict[tuple[int, int], tuple[int, int]](), rng.random((len(borders), 5))
        for b in rng.permutation(len(borders)).tolist():
            (axis, n, m), (loop, opened, walled, wide, place) = borders[b], drawn[b].tolist()
            at = (spines[n + 1], lines[m + 1])[axis]
            span = ((spines[n], spines[n + 1]), (lines[m], lines[m + 1]))[1 - axis]
            beyond = (n + 1, m) if axis == 0 else (n, m + 1)
            passable = join(joins, (n, m), beyond) or loop < self.loop_share
            whole = (span, (0.0, clear))
            if axis == 1 and ramps.get(n) == m:
                continue  # a ramp passes here
            if passable and opened >= self.open_share:
                narrow, broad = self.gate_m
                gate = narrow + wide * (broad - narrow)
                # in the aisle, not behind a car; between bays, anywhere
                low, high = span if axis == 0 else (aisles[n] - 2.5, aisles[n] + 2.5)
                low, high = max(low, span[0]) + 0.2, min(high, span[1]) - 0.2
                # no room for a gate: left open, since it may be the only way to a block
                if high - low < gate:
                    continue
                begin = low + place * (high - low - gate)
                opening = ((begin, begin + gate), (0.0, 2.1))
                parts.wall("wall", axis, at, 0.1, whole, opening)
            elif not passable:
                high = clear if walled < self.wall_share else 1.1
                parts.wall("wall", axis, at, 0.1, (span, (0.0, high)), None)
        for x in spines:
            for y in lines:
                parts.box("column", (x - 0.3, y - 0.2, 0), (x + 0.3, y + 0.2, clear))
        # parapets around the deck
        (x0, *_, x1), (y0, *_, y1) = spines, lines
        for axis, at, span in ((0, x0, (y0, y1)), (0, x1, (y0, y1)), (1, y0, (x0, x1))):
            parts.wall("wall", axis, at, 0.1, (span, (0.0, 1.1)), None)
        parts.wall("wall", 1, y1, 0.1, ((x0, x1), (0.0, 1.1)), None)

    def _block(
        self,
        parts: Parts,
        aisle: float,
        across: Span,
        room: tuple[float, float],
        ramp: bool,
        *,
        rng: Generator,
    ) -> None:
        """Add a block of an aisle along y, whose middle begins at the origin: cars, and what hangs
        under the deck. `room` is its length and height, `across` its span along x."""
        (left, right), (long, clear) = across, room
        parts.box("beam", (left, -0.15, clear - 0.4), (right, 0.15, clear))
        for side, yaw in ((-1, 0.0), (1, np.pi)):
            # x from the spine towards the aisle
            back = side * (aisle / 2 + DEEP_M)
            row = parts.at(back, long / 2, 0.0, yaw)
            for y in (-BAY_M, 0.0, BAY_M):
                taken, van, shift = rng.random(3).tolist()
                place = row.at(2.7 + 0.4 * shift, y)
                # a bay that the world's edge cuts stays empty
                ends = (back, back - side * DEEP_M)
                if abs(y) > long / 2 - 1.2 or not left <= min(ends) < max(ends) <= right:
                    continue
                row.box("sidewalk", (0.5, y - 0.9, 0), (0.65, y + 0.9, 0.1))
                if taken >= self.car_share:
                    continue
                if van < self.van_share:
                    _van(place, rng=rng)
                else:
                    car(place, rng=rng)
        low, high = max(left, -3.0), min(right, 3.0)
        if high - low < 1.0:
            return
        for x, z, radius in rng.uniform((low, 0.1, 0.04), (high, 0.3, 0.12), (2, 3)).tolist():
            parts.rod("pipe", (x, 0, clear - z - 0.1), (x, long, clear - z - 0.1), radius)
        hung, x = rng.random(), rng.uniform(-2.0, 2.0)
        if ramp or high - low < 6.0:
            return
        if hung < 0.3:  # a duct across the aisle
            parts.box("pipe", (left, 1.5, clear - 0.75), (right, 2.1, clear - 0.4))
        elif hung < 0.7:
            parts.box("sign", (x - 0.8, 2.5, clear - 0.75), (x + 0.8, 2.58, clear - 0.4))
            for rod in (x - 0.6, x + 0.6):
                parts.rod("pole", (rod, 2.54, clear - 0.4), (rod, 2.54, clear), 0.015)


def _van(parts: Parts, *, rng: Generator) -> None:
    """Add a van along x, which hides what is behind it."""
    long, wide, high = rng.uniform((4.6, 1.85, 1.95), (5.0, 2.0, 2.25)).tolist()
    parts.box("vehicle", (-long / 2, -wide / 2, 0.25), (0.3 * long, wide / 2, high))
    parts.box("vehicle", (0.3 * long, -wide / 2, 0.25), (long / 2, wide / 2, 0.55 * high))
    for x in (-0.32 * long, 0.34 * long):
        for y in (-wide / 2, wide / 2 - 0.2):
            parts.rod("tyre", (x, y, 0.33), (x, y + 0.2, 0.33), 0.33)


def _ramp(parts: Parts, level: float) -> None:
    """Add a ramp along y from the origin up to the next deck, between low walls."""
    for x in (-1.7, 1.7):
        parts.slab("wall", (x, 0, 0.3), (x, RISE_M, level + 0.3), 0.15, 0.9)
    # lower by half its thickness, so that its upper side meets the decks
    parts.slab("floor", (0, 0, -0.1), (0, RISE_M, level - 0.1), 3.3, 0.2)


def _decks(
    parts: Parts,
    spines: list[float],
    lines: list[float],
    aisles: list[float],
    ramps: dict[int, int],
    level: float,
) -> None:
    """Add the upper deck, with holes over the ramps, and the roof."""
    half = DECK_M / 2
    for n, m in np.ndindex(len(spines) - 1, len(lines) - 1):
        whole, opening = ((spines[n], spines[n + 1]), (lines[m], lines[m + 1])), None
        if n in ramps:
            begin = lines[ramps[n]] + 1.5
            # open from where the ramp comes near the deck to where it meets it
            hole = (begin + RISE_M * (1 - HEADROOM_M / level), begin + RISE_M)
            low, high = max(hole[0], lines[m]), min(hole[1], lines[m + 1])
            if low < high:
                opening = ((aisles[n] - 1.8, aisles[n] + 1.8), (low, high))
        parts.wall("floor", 2, level - half, half, whole, opening)
    corner, roof = (spines[-1], lines[-1], 2 * level), 2 * level - DECK_M
    parts.box("ceiling", (spines[0], lines[0], roof), corner)
