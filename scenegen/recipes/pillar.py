"""Dense upright pillars of varied radius and section, with narrow passages between some of them."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from scenegen.recipes.kind import Range, WorldKind, add_geom, yaw_quaternion


@dataclass(frozen=True, kw_only=True)
class Pillar(WorldKind):
    """Pillars scattered over the plan, independently of each other but for those that form a passage.

    The paper's second kind of environment, "densely distributed obstacles and narrow passages" (section
    "Experiments"); it gives no figures, so these are ours.
    """

    version: ClassVar[int] = 0
    crowding: ClassVar[tuple[str, ...]] = ("density",)
    accept_defaults: ClassVar[dict[str, object]] = {"min_solids": 4.0}
    flight_defaults: ClassVar[dict[str, object]] = {"altitude_m": (3.0, 6.0)}

    density: Range = (0.05, 0.13)
    """Pillars per square metre; one value a world."""
    half_width_m: Range = (0.2, 0.5)
    """Radius of a round pillar or half an edge of a square one, metres; one value a pillar."""
    round_share: float = 0.7
    """Share of pillars with a round section."""
    oblong_share: float = 0.1
    """Share of pillars with a rectangular section, up to `oblong_ratio` times as long as wide; the rest are square."""
    oblong_ratio: float = 3.0
    passage_share: float = 0.1
    """Share of pillars set beside another one, a passage's width away."""
    passage_m: Range = (0.7, 1.2)
    """Width of those passages, metres."""
    height_m: Range = (10.0, 10.0)
    """Heights of pillars, metres, from the ground up."""

    def add_to(self, spec: mujoco.MjSpec, *, rng: np.random.Generator) -> None:
        """See `WorldKind.add_to`."""
        self.add_ground(spec)
        x_m, y_m, _ = self.size_m
        count = max(round(rng.uniform(*self.density) * x_m * y_m), 1)
        section = rng.random(count)
        half = rng.uniform(*self.half_width_m, count)
        length = np.where(
            (section >= self.round_share) & (section < self.round_share + self.oblong_share),
            half * rng.uniform(1.0, self.oblong_ratio, count),
            half,
        )
        height = rng.uniform(*self.height_m, count)
        plan = rng.uniform((0.0, 0.0), (x_m, y_m), (count, 2))
        yaw = rng.uniform(0.0, np.pi, count)
        beside = np.flatnonzero(rng.random(count) < self.passage_share)
        neighbour = rng.integers(0, np.maximum(beside, 1))
        apart = np.maximum(half, length)[beside] + np.maximum(half, length)[neighbour]
        apart += rng.uniform(*self.passage_m, len(beside))
        angle = rng.uniform(0.0, 2 * np.pi, len(beside))
        plan[beside] = plan[neighbour] + apart[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        for n in range(count):
            position = (plan[n, 0], plan[n, 1], height[n] / 2)
            if section[n] < self.round_share:
                add_geom(spec, mujoco.mjtGeom.mjGEOM_CYLINDER, (half[n], height[n] / 2, 0.0), position)
            else:
                size = (half[n], length[n], height[n] / 2)
                add_geom(spec, mujoco.mjtGeom.mjGEOM_BOX, size, position, quat=yaw_quaternion(yaw[n]))
