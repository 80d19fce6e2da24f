"""Dense upright pillars of varied radius and section, with narrow passages between some of them."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import sin_cos
from lidarsim.parameters import number
from lidarsim.solids import BOX, CYLINDER
from scenegen.worlds.drawing import UPRIGHT, Drawing
from scenegen.worlds.kinds.kind import Range, WorldKind, yaw_quaternion


@dataclass(frozen=True, kw_only=True)
class Pillar(WorldKind):
    """Pillars scattered over the plan, independently of each other but for those that form a
    passage.

    The paper's second kind of environment, "densely distributed obstacles and narrow passages"
    (section "Experiments"); it gives no figures, so these are ours.
    """

    version = 2
    graded = {
        "easy": {
            "density": (0.02, 0.05),
        },
        "hard": {
            "density": (0.1, 0.16),
            "passage_share": 0.2,
        },
    }
    shares = ("round_share", "oblong_share")
    crowded_by = ("density",)
    accept_defaults = {"min_solids": 4.0}
    flight_defaults = {"altitude_m": (3.0, 6.0)}

    density: Range = (0.05, 0.10)
    """Pillars per square metre; one value a world. Source: calibrated, results/findings.md."""
    half_width_m: Range = (0.25, 0.55)
    """Radius of a round pillar or half an edge of a square one, metres; one value a pillar. Source:
    calibrated, results/findings.md."""
    round_share: float = 0.7
    """Share of pillars with a round section."""
    oblong_share: float = 0.1
    """Share of pillars with a rectangular section, up to `oblong_ratio` times as long as wide; the
    rest are square."""
    oblong_ratio: float = number(3.0, minimum=1, maximum=1000)
    """Greatest ratio of the two edges of a rectangular section."""
    passage_share: float = 0.1
    """Share of pillars set beside an earlier one, a passage's width away; a few then stand outside
    `size_m`."""
    passage_m: Range = (0.7, 1.2)
    """Width of those passages between the pillars' round hulls, metres; between flat sides they are
    wider. Source: from a little more than the robot's 0.6 m to twice that: the paper's "narrow
    passages"."""
    height_m: Range = (10.0, 10.0)
    """Heights of pillars, metres, from the ground up."""

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Draw all pillars at once, then move those of the passages beside earlier ones.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        self.add_ground(spec)
        x_m, y_m, _ = self.size_m
        # one at least: worlds without solids are refused, and pillars may have no floor
        count = max(round(rng.uniform(*self.density) * x_m * y_m), 1)
        section = rng.random(count)
        round_ = section < self.round_share
        half = rng.uniform(*self.half_width_m, count)
        length = np.where(
            ~round_ & (section < self.round_share + self.oblong_share),
            half * rng.uniform(1.0, self.oblong_ratio, count),
            half,
        )
        height = rng.uniform(*self.height_m, count)
        plan = rng.uniform((0.0, 0.0), (x_m, y_m), (count, 2))
        yaw = rng.uniform(0.0, np.pi, count)
        # radius of the circle around the section, which no turn makes larger
        hull = np.where(round_, half, np.sqrt(half * half + length * length))
        # the first has no earlier one
        moved = [
            n for n in np.flatnonzero(rng.random(count) < self.passage_share).tolist() if n > 0
        ]
        drawn = [
            (rng.integers(0, n), rng.uniform(0.0, 2 * np.pi), rng.uniform(*self.passage_m))
            for n in moved
        ]
        sine, cosine = sin_cos([angle for _, angle, _ in drawn])
        # in rising order, so that an earlier pillar already stands where it stays
        for n, (neighbour, _, gap), *direction in zip(moved, drawn, cosine, sine, strict=True):
            plan[n] = plan[neighbour] + (hull[n] + hull[neighbour] + gap) * np.array(direction)
        quats = np.where(round_[:, None], UPRIGHT, yaw_quaternion(yaw))
        shapes = np.where(round_, CYLINDER, BOX)
        sizes = np.stack([half, np.where(round_, height / 2, length), height / 2], axis=1)
        spec.add_geoms(shapes, sizes, np.stack([*plan.T, height / 2], axis=1), quats)
