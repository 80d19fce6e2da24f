"""Vineyards: rows of vines between posts and wires."""

from dataclasses import dataclass

import numpy as np

from lidarsim.parameters import number
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed
from scenegen.worlds.kinds.parts import Parts


@dataclass(frozen=True, kw_only=True)
class Vineyard(Classed):
    """Rows along x. A vine is a trunk with a few balls of leaves."""

    version = 1
    crowded_by = ("leaves_m", "-row_m")
    graded = {
        "easy": {"row_m": (4.0, 5.0), "missing_share": 0.5},
        "hard": {"row_m": (2.0, 2.4), "leaves_m": (0.4, 0.6), "missing_share": 0.0},
    }
    flight_defaults = {"altitude_m": (0.8, 2.5)}
    accept_defaults = {"min_solids": 10.0}
    size_m: tuple[float, float, float] = (40.0, 40.0, 4.0)
    """Extent along x, y and z, metres."""
    ground: bool = True
    """Whether there is ground."""
    row_m: tuple[float, float] = (2.4, 4.0)
    """From row to row, metres; one value a world."""
    vine_m: float = number(1.5, minimum=0.5, maximum=10)
    """From vine to vine, metres."""
    leaves_m: tuple[float, float] = (0.25, 0.5)
    """Radius of a ball of leaves, metres; one value a vine."""
    missing_share: float = 0.1
    """Share of places without a vine."""

    def max_solids(self) -> float:
        """Six solids a place: a post, a wire, and a vine of four."""
        x_m, y_m, _ = self.size_m
        return 6 * (x_m / self.vine_m + 1) * (y_m / self.row_m[0] + 1)

    def add_to(self, spec: Drawing, *, rng: np.random.Generator) -> None:
        """Draw the ground, and one row after the other."""
        parts, (x_m, y_m, _) = self.begun("terrain"), self.size_m
        for y in np.arange(1.0, y_m, rng.uniform(*self.row_m)).tolist():
            row = parts.at(0.0, y)
            row.rod("cable", (0, 0, 1.6), (x_m, 0, 1.6), 0.01)
            for x in np.arange(1.0, x_m, self.vine_m).tolist():
                row.rod("pole", (x, 0, 0), (x, 0, 1.8), 0.04)
                if rng.random() >= self.missing_share:
                    self._vine(row.at(x, 0.1, yaw_rad=rng.uniform(0, 6)), rng=rng)
        parts.add_to(spec)

    def _vine(self, parts: Parts, *, rng: np.random.Generator) -> None:
        """A vine at the origin of a frame."""
        radius = rng.uniform(*self.leaves_m)
        parts.limb("trunk", (0, 0, 0), (0.1, 0, 1.0), 0.04)
        for z in rng.uniform(0.8, 1.5, 3).tolist():
            parts.ball("vegetation", (0.1, 0, z), (radius, radius, 0.8 * radius))
