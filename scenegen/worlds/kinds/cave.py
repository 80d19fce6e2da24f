"""A cave: chambers and tunnels between an uneven floor and an uneven roof, with stalactites and
rocks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats
from lidarsim.parameters import number
from lidarsim.solids import BOX
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size, attitudes
from scenegen.worlds.kinds.parts import Parts, height_at, hilly, scattered

RAMP_M = 1.8
"""Over this width the walls of a tunnel rise."""


@dataclass(frozen=True, kw_only=True)
class Cave(Classed):
    """Two height fields that meet where there is rock. Chambers are joined in the order in which
    they are drawn, each to the nearest before it, and a few more tunnels close loops or end dead,
    as in the worlds of the DARPA Subterranean Challenge, whose tunnels are 2 to 6 m wide."""

    version = 1
    graded = {
        "easy": {
            "height_m": (4.5, 6.5),
            "rough_m": (0.1, 0.4),
            "chamber_m": (4.0, 8.0),
            "tunnel_m": (2.0, 4.0),
            "dripstone_density": (0.0, 0.02),
            "rock_density": (0.0, 0.02),
        },
        "hard": {
            "height_m": (3.0, 3.8),
            "chamber_m": (2.0, 4.0),
            "tunnel_m": (1.0, 1.6),
            "dripstone_density": (0.06, 0.15),
            "rock_density": (0.06, 0.15),
        },
    }
    crowded_by = ("dripstone_density", "rock_density")
    flight_defaults = {"altitude_m": (0.9, 2.4), "min_distance_m": 6.0, "flights_per_world": 6}

    size_m: Size = (40.0, 40.0, 6.0)
    """Extent along x and y, metres; `height_m` decides along z."""
    ground: bool = True
    """Whether there are a floor and a roof."""
    ground_m: float = 0.2
    """Thickness of the floor that `bench` scores, metres. Floor and roof are filled 0.5 m beyond
    their lowest points."""
    height_m: Range = (3.2, 5.5)
    """From floor to roof, metres; one value a world."""
    rough_m: Range = (0.2, 0.8)
    """Height of the floor's and depth of the roof's unevenness, metres; one value a world."""
    chambers: tuple[int, int] = number((6, 10), minimum=1, maximum=200)
    """Chambers of a world."""
    chamber_m: Range = (2.5, 6.0)
    """Radius of a chamber, metres."""
    tunnel_m: Range = (1.1, 2.8)
    """Half the width of a tunnel, metres. Source: tunnels 2 to 6 m wide, as in the DARPA
    Subterranean Challenge."""
    loop_share: float = 0.4
    """More tunnels, as a share of the chambers; they close loops. Source: the DARPA Subterranean
    Challenge has loops; how many is ours."""
    dead_share: float = 0.4
    """Tunnels that end in the rock, as a share of the chambers. Source: the DARPA Subterranean
    Challenge has dead ends; how many is ours."""
    dripstone_density: Range = (0.0, 0.06)
    """Stalactites and stalagmites per square metre; one value a world."""
    rock_density: Range = (0.0, 0.06)
    """Rocks per square metre; one value a world."""

    def max_solids(self) -> float:
        """Count two solids a dripstone, one a rock."""
        area = self.size_m[0] * self.size_m[1]
        return (2 * self.dripstone_density[1] + self.rock_density[1]) * area + 2

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Dig chambers and tunnels, and put stones where there is room.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, _) = Parts(), self.size_m
        height, rough = rng.uniform(*self.height_m), rng.uniform(*self.rough_m)
        hills, dents = (hilly(self.size_m, 1.2, (7.0, 3.0), rng=rng) for _ in range(2))
        rock = np.clip(self._outside(hills.shape, rng=rng) / RAMP_M, 0.0, 1.0)
        # a smooth ramp; 0.3 m more than half the height, so that floor and roof overlap in the rock
        rock = rock * rock * (3.0 - 2.0 * rock) * (height / 2 + 0.3)
        floor, roof = rough * hills + rock, rough * dents + rock
        middle, size = (x_m / 2, y_m / 2), (x_m, y_m)
        if self.ground:
            spec.add_height_field(floor, size, (*middle, 0.0), depth_m=0.5, of_class="rock")
            spec.add_height_field(
                roof, size, (*middle, height), depth_m=0.5, hanging=True, of_class="rock"
            )
        plan = (x_m * y_m, (0.0, 0.0), size)
        for x, y in scattered(self.dripstone_density, *plan, rng=rng):
            low = height_at(floor, self.size_m, x, y)
            # heights of the roof count downwards
            high = height - height_at(roof, self.size_m, x, y)
            long, wide, side = rng.random(3).tolist()
            reach = (high - low) * (0.25 + 0.6 * long)
            # none in the rock, or where there is little room
            if high - low > 1.0:
                # seven of ten hang; feet reach into the rock, so that no gap shows
                foot, up = (high + 0.1, -1.0) if side < 0.7 else (low - 0.1, 1.0)
                radius = 0.08 + 0.25 * wide
                # the outer half is half as thick
                knee = foot + up * reach / 2
                parts.limb("rock", (x, y, foot), (x, y, knee), radius)
                parts.limb("rock", (x, y, knee), (x, y, foot + up * reach), radius / 2)
        places = scattered(self.rock_density, *plan, rng=rng)
        turns = attitudes(len(places), 1.0, rng=rng).tolist()
        for (x, y), turn in zip(places, turns, strict=True):
            _stone(parts.at(x, y, height_at(floor, self.size_m, x, y)), turn, rng=rng)
        parts.add_to(spec)

    def _outside(self, shape: tuple[int, ...], *, rng: Generator) -> Floats:
        """Compute how far points of a lattice (along y, along x) lie outside chambers and tunnels.

        Metres, negative inside."""
        x_m, y_m, _ = self.size_m
        y, x = np.meshgrid(
            np.linspace(0.0, y_m, shape[0]), np.linspace(0.0, x_m, shape[1]), indexing="ij"
        )
        count = int(rng.integers(self.chambers[0], self.chambers[1] + 1))
        # middles keep off the edges, so that most of a chamber lies in the world
        chambers = rng.uniform((4.0, 4.0), (x_m - 4.0, y_m - 4.0), (count, 2))
        radii = rng.uniform(*self.chamber_m, count)
        outside = np.full(shape, np.inf)
        for (middle_x, middle_y), radius in zip(chambers.tolist(), radii.tolist(), strict=True):
            distance = np.sqrt((x - middle_x) ** 2 + (y - middle_y) ** 2)
            outside = np.minimum(outside, distance - radius)
        for start, end in self._tunnels(chambers, rng=rng):
            distance = _from_segment(x, y, start, end)
            outside = np.minimum(outside, distance - rng.uniform(*self.tunnel_m))
        return outside

    def _tunnels(self, chambers: Floats, *, rng: Generator) -> list[tuple[Floats, Floats]]:
        """Choose where tunnels begin and end, (2,) each, metres, from the middles of chambers (n,
        2)."""
        count, tunnels = len(chambers), []
        for n in range(1, count):
            distance2 = ((chambers[:n] - chambers[n]) ** 2).sum(axis=1)
            # each to the nearest earlier one: a tree, so all chambers are joined
            tunnels.append((chambers[n], chambers[int(distance2.argmin())]))
        for _ in range(round(self.loop_share * count)):
            first, second = rng.integers(0, count, 2).tolist()
            tunnels.append((chambers[first], chambers[second]))
        for _ in range(round(self.dead_share * count)):
            start = chambers[int(rng.integers(0, count))]
            angle, far = rng.random(2).tolist()
            sine, cosine = sin_cos(np.array(2 * np.pi * angle))
            offset = (8.0 + 8.0 * far) * np.array([cosine, sine])
            tunnels.append((start, start + offset))
        return tunnels


def _from_segment(x: Floats, y: Floats, start: Floats, end: Floats) -> Floats:
    """Compute distances of points from the segment between `start` and `end` (2,), metres."""
    along = end - start
    # a loop may join a chamber to itself
    length2 = max(float(along[0] * along[0] + along[1] * along[1]), 1e-9)
    share = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / length2
    share = np.clip(share, 0.0, 1.0)  # the nearest point of the segment, from its start to its end
    dx, dy = x - start[0] - share * along[0], y - start[1] - share * along[1]
    return np.sqrt(dx * dx + dy * dy)


def _stone(parts: Parts, turn: Sequence[float], *, rng: Generator) -> None:
    """Add a box or an ellipsoid at the origin of a frame, at an attitude w x y z."""
    a, b, c, flat = rng.random(4).tolist()
    size = (0.15 + 0.6 * a, 0.15 + 0.5 * b, 0.1 + 0.4 * c)
    if flat < 0.5:
        parts.solid("rock", BOX, size, (0, 0, 0.1), turn)
    else:
        parts.ball("rock", (0, 0, 0.1), size, turn)
