"""A forest on uneven ground: trunks that lean and fork, crowns, bushes and fallen trunks."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import sin_cos
from lidarsim.parameters import number
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts, height_at, hilly, scattered


@dataclass(frozen=True, kw_only=True)
class Forest(Classed):
    """Trees scattered over hilly ground. Planners' suites have 0.06 trees a square metre (trees 4 m
    apart in YOPO's) to 0.2 (ETH's forest_gen); most worlds here lie between."""

    version = 1
    graded = {
        "easy": {
            "density": (0.01, 0.04),
            "bush_density": (0.0, 0.02),
            "fallen_density": (0.0, 0.003),
        },
        "hard": {
            "density": (0.12, 0.2),
            "bush_density": (0.05, 0.12),
            "fallen_density": (0.01, 0.03),
        },
    }
    crowded_by = ("density", "bush_density")
    flight_defaults = {"altitude_m": (2.0, 4.5)}

    size_m: Size = (40.0, 40.0, 12.0)
    """Extent along x and y, metres; `height_m` decides along z."""
    ground: bool = True
    """Whether there is ground."""
    hill_m: Range = (0.3, 1.5)
    """Height of the ground's hills, metres; one value a world."""
    density: Range = (0.04, 0.12)
    """Trees per square metre; one value a world. Source: YOPO's trees 4 m apart (0.06) lie within;
    ETH's forest_gen has 0.2, as far as "hard" goes."""
    trunk_m: Range = (0.08, 0.28)
    """Radius of a trunk at its foot, metres; one value a tree."""
    height_m: Range = (5.0, 11.0)
    """Height of trees, metres; one value a tree."""
    lean: float = number(0.15, minimum=0, maximum=1)
    """How far a trunk leans at most from one limb to the next: a slope."""
    fork_share: float = 0.3
    """Share of trees that fork."""
    bare_share: float = 0.2
    """Share of trees without a crown."""
    bush_density: Range = (0.0, 0.06)
    """Bushes per square metre; one value a world."""
    fallen_density: Range = (0.0, 0.01)
    """Fallen trunks per square metre; one value a world."""

    def max_solids(self) -> float:
        """Count up to twelve solids a tree, two a bush."""
        density = 12 * self.density[1] + 2 * self.bush_density[1] + self.fallen_density[1]
        return density * self.size_m[0] * self.size_m[1]

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Draw the ground, and plant everything on it.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, _) = Parts(), self.size_m
        # a coarse lattice: the truth of its triangles takes much of a sample's time
        heights = rng.uniform(*self.hill_m) * hilly(self.size_m, 1.25, (12.0, 5.0), rng=rng)
        if self.ground:
            middle, depth = (x_m / 2, y_m / 2, 0.0), self.ground_m
            spec.add_height_field(heights, (x_m, y_m), middle, depth_m=depth)
        area = x_m * y_m

        def places(density: Range) -> list[Parts]:
            drawn = scattered(density, area, (0.0, 0.0, 0.0), (x_m, y_m, 2 * np.pi), rng=rng)
            return [parts.at(x, y, height_at(heights, self.size_m, x, y), a) for x, y, a in drawn]

        for place in places(self.density):
            self._tree(place, rng=rng)
        for place in places(self.bush_density):
            # two overlapping ellipsoids, so that bushes are not round
            for x, y, size, z in rng.uniform(-1.0, 1.0, (2, 4)).tolist():
                radius = 0.6 + 0.35 * size
                radii = (radius, radius, radius * (0.7 + 0.2 * z))
                place.ball("vegetation", (0.4 * x, 0.4 * y, 0.5 * radius), radii)
        for place in places(self.fallen_density):
            # one end may lie on a stump or a branch
            long, radius = rng.uniform(2.0, 7.0), rng.uniform(*self.trunk_m)
            lifted = rng.uniform(0.0, 1.5)
            place.limb("trunk", (-long / 2, 0, radius), (long / 2, 0, radius + lifted), radius)
        parts.add_to(spec)

    def _tree(self, parts: Parts, *, rng: Generator) -> None:
        """Add two limbs of a trunk, perhaps a third that forks off, and a crown."""
        height, radius = rng.uniform(*self.height_m), rng.uniform(*self.trunk_m)
        # an offset along x and y for each of the two limbs
        lean = self.lean * rng.uniform(-1.0, 1.0, (2, 2)) * height / 2
        knee = (*lean[0].tolist(), 0.45 * height)
        top = (*(lean[0] + lean[1]).tolist(), 0.85 * height)
        # from below the ground, which is uneven
        parts.limb("trunk", (0, 0, -0.3), knee, radius)
        parts.limb("trunk", knee, top, 0.7 * radius)
        ends, (fork, bare) = [top], rng.random(2).tolist()
        if fork < self.fork_share:
            sine, cosine = (part.item() for part in sin_cos(np.array(rng.uniform(0.0, 6.28))))
            end = (knee[0] + 0.2 * height * cosine, knee[1] + 0.2 * height * sine, 0.8 * height)
            parts.limb("trunk", knee, end, 0.5 * radius)
            ends.append(end)
        if bare < self.bare_share:
            return
        # each end of the trunk has a crown of one to three balls
        for x, y, z in ends:
            drawn = rng.uniform(-1.0, 1.0, (int(rng.integers(1, 4)), 4)).tolist()
            for dx, dy, dz, size in drawn:
                wide = 0.13 * height * (1 + 0.35 * size)
                centre = (x + wide * dx, y + wide * dy, z + 0.1 * height * dz)
                parts.ball("vegetation", centre, (wide, wide, 0.8 * wide))
