"""Clouds of shapes of all sizes, thin to large, as dense as a fractal noise has it."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import exp, log
from lidarsim.parameters import number
from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, SPHERE
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size, attitudes, log_uniform
from scenegen.worlds.kinds.parts import noise_field

SHAPES = np.array([SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX])


@dataclass(frozen=True, kw_only=True)
class Clutter(Classed):
    """Solids whose places follow a noise of several octaves, as the "Perlin maps" of planners'
    suites do (ego-planner's by complexity, fill and fractal), so that there are thickets and
    clearings; sizes are scale-free between two bounds."""

    version = 1
    graded = {
        "easy": {
            "density": (0.02, 0.08),
        },
        "hard": {
            "density": (0.5, 1.5),
        },
    }
    crowded_by = ("density",)
    flight_defaults = {"altitude_m": (1.5, 6.0)}

    size_m: Size = (40.0, 40.0, 8.0)
    """Extent of the world along x, y and z, metres."""
    ground: bool = True
    """Whether there is a floor."""
    density: Range = number((0.05, 0.5), above=0)
    """Solids per square metre; one value a world, drawn so that its logarithm is uniform. Source:
    ego-planner's random maps have 400 obstacles on 1600 m² (0.25), which lies within."""
    patch_m: Range = number((3.0, 10.0), minimum=0.5, maximum=1000)
    """Width of thickets and clearings, metres; one value a world. Source: the "complexity" of
    ego-planner's Perlin maps, as a width."""
    octaves: int = number(3, minimum=1, maximum=8)
    """Octaves of the noise, each half as wide and half as strong as the one before. Source: the
    "fractal" of ego-planner's Perlin maps."""
    contrast: float = number(3.0, minimum=0, maximum=20)
    """How much denser thickets are than clearings: the exponent of the noise. Source: does what
    "fill" does in ego-planner's Perlin maps."""
    half_size_m: Range = (0.06, 1.4)
    """Radii and half edges, metres; their logarithms are uniform."""
    thin_share: float = 0.35
    """Share of solids that are thin: two of their sizes are divided by 5."""
    tilted_share: float = 0.7
    """Share of solids at any attitude; the rest are upright."""

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Draw four times as many places as needed, and choose among them by weights of the noise.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        self.add_ground(spec)
        n = max(round(log_uniform(*self.density, rng=rng) * self.size_m[0] * self.size_m[1]), 1)
        places, patch = rng.uniform(0.0, self.size_m, (4 * n, 3)), rng.uniform(*self.patch_m)
        noise = np.zeros(len(places))
        for octave in range(self.octaves):
            noise += noise_field(places, patch / 2**octave, rng=rng) / 2**octave
        # the least of -log(u) / weight: drawn without replacement, by weight (Efraimidis 2006)
        # noise^contrast; 1e-6, since the logarithm of 0 is infinite
        weight = exp(self.contrast * log(np.maximum(noise / noise.max(), 1e-6)))
        keys = -log(rng.uniform(1e-12, 1.0, len(places))) / np.maximum(weight, 1e-30)
        # other sorts may put equal keys in another order on another processor
        places = places[np.argsort(keys, kind="stable")[:n]]
        low, high = log(np.array(self.half_size_m)).tolist()
        sizes = np.asarray(exp(rng.uniform(low, high, (n, 3))))
        thin = rng.random(n) < self.thin_share
        # the radius of round shapes; half edges of others also along y
        sizes[thin, 0] = np.maximum(sizes[thin, 0] / 5, 0.02)
        shapes = SHAPES[rng.integers(0, len(SHAPES), n)]
        boxy = thin & ((shapes == BOX) | (shapes == ELLIPSOID))
        sizes[boxy, 1] = sizes[boxy, 0]
        turns = attitudes(n, self.tilted_share, rng=rng)
        spec.add_geoms(shapes, sizes, places, turns, classes=["other"] * n)
