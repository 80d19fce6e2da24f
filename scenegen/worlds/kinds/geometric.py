"""Spheres, boxes and cylinders at any attitude, standing, stacked and floating, with walls and
clutter between them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from lidarsim.grid import Floats, Ints
from lidarsim.parameters import number
from lidarsim.solids import BOX, CYLINDER, SPHERE, bounding_boxes
from scenegen.base.limits import MAX_DRAWN_SOLIDS
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import (
    Range,
    Size,
    WorldKind,
    attitudes,
    log_uniform,
    normal,
    yaw_quaternion,
)

SHAPES = np.array([SPHERE, BOX, CYLINDER])
COLOURS = np.array([(0.80, 0.45, 0.35, 1.0), (0.40, 0.60, 0.75, 1.0), (0.75, 0.68, 0.40, 1.0)])


@dataclass(frozen=True, kw_only=True)
class Geometric(WorldKind):
    """Solids scattered over the plan and, in part, over the height.

    The paper's first kind of environment: "walls, pillars, and cluttered structures" of "spheres,
    boxes, and cylinders" (sections "Training Data Generation" and "Visual Reconstruction Results");
    it gives no figures, so these are calibrated: docs/results/findings.md.
    """

    version = 2
    graded = {
        "easy": {
            "density": (0.002, 0.05),
            "wall_density": (0.0, 0.01),
            "clutter_density": (0.0, 0.001),
        },
        "hard": {
            "density": (0.2, 0.6),
            "wall_density": (0.01, 0.04),
            "clutter_density": (0.002, 0.006),
        },
    }
    shares = ("standing_share", "stacked_share")
    crowded_by = ("density", "wall_density", "clutter_density", "clutter_count")
    accept_defaults = {"min_solids": 2.0}
    flight_defaults = {"altitude_m": (1.5, 4.0)}

    size_m: Size = (40.0, 40.0, 5.0)
    """Extent of the world along x, y and z, metres; z is how high floating solids may have their
    centres. Source: its height is calibrated, results/findings.md."""
    ground: bool = True
    """Whether there is a floor: a slab over the world's plan with its top at z = 0."""
    density: Range = number((0.002, 0.4), above=0)
    """Solids per square metre; one value a world, drawn so that its logarithm is uniform. Source:
    calibrated, results/findings.md."""
    half_size_m: Range = (0.3, 1.2)
    """Radii and half edges, metres; one value an axis of a solid. Source: calibrated,
    results/findings.md."""
    scale: Range = number((0.7, 1.2), above=0, maximum=100)
    """Factor on `half_size_m`; one value a world."""
    standing_share: float = 0.5
    """Share of solids that stand on the ground; others float at any height, or are stacked."""
    stacked_share: float = 0.2
    """Share of solids set on top of an earlier one."""
    tilted_share: float = 0.5
    """Share of solids at any attitude; the rest are upright."""
    wall_density: Range = (0.0, 0.02)
    """Walls per square metre; one value a world."""
    wall_length_m: Range = (2.0, 8.0)
    """Length along the ground, metres; one value a wall, as are the next two."""
    wall_height_m: Range = (2.0, 8.0)
    """Height above the ground, metres."""
    wall_half_thickness_m: Range = (0.1, 0.2)
    """Half the thickness, metres."""
    clutter_density: Range = (0.0, 0.003)
    """Heaps of small solids per square metre; one value a world."""
    clutter_count: tuple[int, int] = number((4, 8), minimum=0, maximum=MAX_DRAWN_SOLIDS)
    """Small solids in a heap."""
    clutter_spread_m: float = 0.5
    """Standard deviation of small solids' places about their heap's, metres."""
    clutter_half_size_m: Range = (0.1, 0.35)
    """Radii and half edges of small solids, metres."""

    def max_solids(self) -> float:
        """Count the solids of a world, those of heaps included."""
        heaps = self.clutter_density[1] * self.size_m[0] * self.size_m[1]
        return super().max_solids() + heaps * (self.clutter_count[1] - 1)

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Draw solids, walls and heaps, each of a density drawn once a world.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        # no solid has a class, here and in `pillar`: classes would change the bits of both presets
        self.add_ground(spec)
        area = self.size_m[0] * self.size_m[1]
        scale = rng.uniform(*self.scale)
        self._add_solids(spec, round(area * log_uniform(*self.density, rng=rng)), scale, rng=rng)
        self._add_walls(spec, round(area * rng.uniform(*self.wall_density)), rng=rng)
        self._add_clutter(spec, round(area * rng.uniform(*self.clutter_density)), rng=rng)

    def _add_solids(self, spec: Drawing, count: int, scale: float, *, rng: Generator) -> None:
        """Add standing, floating and stacked solids."""
        kind = rng.integers(0, len(SHAPES), count)
        shape, size = SHAPES[kind], scale * rng.uniform(*self.half_size_m, (count, 3))
        plan = rng.uniform((0.0, 0.0), self.size_m[:2], (count, 2))
        tilt = attitudes(count, self.tilted_share, rng=rng)
        place = rng.random(count)
        free_height = rng.uniform(0.0, self.size_m[2], count)
        # the earlier solid to stack each on, drawn for all so that shares do not change other draws
        # the first has no earlier one, and is not stacked below
        on = rng.integers(0, np.maximum(np.arange(count), 1))
        reach = _half_height(shape, size, tilt)
        # one number decides among standing, stacked and floating
        standing = place < self.standing_share
        z = np.where(standing, reach, free_height)
        stacked = ~standing & (place < self.standing_share + self.stacked_share)
        # one after the other: the solid below may be a stacked one itself
        for n in np.flatnonzero(stacked).tolist():
            if n > 0:
                plan[n], z[n] = plan[on[n]], z[on[n]] + reach[on[n]] + reach[n]
        spec.add_geoms(shape, size, np.stack([*plan.T, z], axis=1), tilt, COLOURS[kind])

    def _add_walls(self, spec: Drawing, count: int, *, rng: Generator) -> None:
        """Add upright slabs, turned at random."""
        # half a turn is enough: a slab has two equal faces
        ranges = (self.wall_length_m, self.wall_half_thickness_m, self.wall_height_m)
        low, high = zip(
            (0.0, self.size_m[0]), (0.0, self.size_m[1]), *ranges, (0.0, np.pi), strict=True
        )
        x, y, length, half_thickness, height, yaw = rng.uniform(low, high, (count, 6)).T
        sizes, centres = (length / 2, half_thickness, height / 2), (x, y, height / 2)
        turn = yaw_quaternion(yaw)
        spec.add_geoms(np.full(count, BOX), np.transpose(sizes), np.transpose(centres), turn)

    def _add_clutter(self, spec: Drawing, heaps: int, *, rng: Generator) -> None:
        """Add heaps of small tilted solids on the ground."""
        for _ in range(heaps):
            centre = rng.uniform((0.0, 0.0), self.size_m[:2])
            count = int(rng.integers(self.clutter_count[0], self.clutter_count[1] + 1))
            kind = rng.integers(0, len(SHAPES), count)
            shape, size = SHAPES[kind], rng.uniform(*self.clutter_half_size_m, (count, 3))
            offset = self.clutter_spread_m * normal((count, 3), rng=rng)
            tilt = attitudes(count, 1.0, rng=rng)
            # the lowest point is on the ground or above
            z = _half_height(shape, size, tilt) + np.abs(offset[:, 2])
            place = np.column_stack([centre + offset[:, :2], z])
            spec.add_geoms(shape, size, place, tilt, COLOURS[kind])


def _half_height(shape: Ints, size: Floats, quaternion: Floats) -> Floats:
    """Compute how far solids (n,) of MuJoCo's shapes, sizes and attitudes reach above their
    centres."""
    w, x, y, z = quaternion.T
    rotation = np.zeros((len(size), 3, 3))
    # only the row of z is needed
    rotation[:, 2] = np.transpose(
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    )
    return bounding_boxes(shape, size, np.zeros_like(size), rotation)[1][:, 2]
