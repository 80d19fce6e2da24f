"""A machine hall or plant: pipes, tanks, machines, catwalks with gratings, stairs and scaffolds."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from lidarsim.solids import CYLINDER
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts, scattered

QUARTER = np.pi / 2


@dataclass(frozen=True, kw_only=True)
class Industrial(Classed):
    """Thin things beside large ones. Pipes have outer diameters of ISO 4200 (.06 to .6 m), scaffold
    tubes 48 mm and bays of 2.0 by 0.7 by 2.0 m (EN 12810), catwalks railings of 1.1 m and stairs
    steps of 0.2 by 0.25 m (ISO 14122)."""

    version = 1
    graded = {
        "easy": {
            "bundles": (1.0, 3.0),
            "machine_density": (0.002, 0.008),
            "scaffold_density": (0.0, 0.001),
            "tank_density": (0.0, 0.003),
            "catwalks": (0.0, 1.0),
        },
        "hard": {
            "bundles": (8.0, 14.0),
            "machine_density": (0.02, 0.04),
            "scaffold_density": (0.006, 0.015),
            "tank_density": (0.006, 0.015),
            "catwalks": (4.0, 8.0),
        },
    }
    crowded_by = ("machine_density", "scaffold_density", "tank_density")
    movers = ("person", "vehicle", "drone")
    flight_defaults = {"altitude_m": (0.8, 6.0)}

    size_m: Size = (40.0, 40.0, 9.0)
    """Extent of the hall along x, y and z, metres."""
    ground: bool = True
    """Whether there is a floor."""
    bundles: Range = (3.0, 8.0)
    """Bundles of pipes that cross the hall; one value a world."""
    pipe_m: Range = (0.04, 0.3)
    """Radius of a pipe, metres. Source: outer diameters of 0.08 to 0.61 m, as in ISO 4200."""
    tank_density: Range = (0.0, 0.008)
    """Tanks per square metre; one value a world."""
    tank_m: Range = (0.6, 2.0)
    """Radius of a tank, metres."""
    machine_density: Range = (0.005, 0.02)
    """Machines per square metre; one value a world."""
    scaffold_density: Range = (0.0, 0.006)
    """Scaffolds per square metre; one value a world."""
    catwalks: Range = (1.0, 4.0)
    """Catwalks that cross the hall; one value a world."""
    column_m: Range = (6.0, 10.0)
    """Distance of columns, metres; one value a world."""

    def max_solids(self) -> float:
        """Count the solids of everything, at its greatest number."""
        x_m, y_m, _ = self.size_m
        density = (
            3 * self.tank_density[1] + 6 * self.machine_density[1] + 60 * self.scaffold_density[1]
        )
        # pipes and catwalks may run along either edge
        long = max(x_m, y_m)
        columns = (x_m / self.column_m[0] + 1) * (y_m / self.column_m[0] + 2)
        pipes, walks = self.bundles[1] * (30 + long / 2), self.catwalks[1] * (4 * long + 30)
        return density * x_m * y_m + pipes + walks + columns

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Draw the hall, and one group of things after the other.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
        parts, (x_m, y_m, z_m) = self.begun("floor"), self.size_m
        spacing = rng.uniform(*self.column_m)
        # rows of columns under beams that cross the hall
        for x in np.arange(spacing / 2, x_m, spacing).tolist():
            for y in np.arange(spacing / 2, y_m, spacing).tolist():
                parts.box("column", (x - 0.15, y - 0.15, 0), (x + 0.15, y + 0.15, z_m))
            parts.box("beam", (x - 0.12, 0, z_m - 0.5), (x + 0.12, y_m, z_m))
        for _ in range(round(rng.uniform(*self.bundles))):
            self._pipes(self._lane(parts, rng=rng), rng=rng)
        for _ in range(round(rng.uniform(*self.catwalks))):
            self._catwalk(self._lane(parts, rng=rng), rng=rng)
        for make, density in (
            (self._tank, self.tank_density),
            (_machine, self.machine_density),
            (_scaffold, self.scaffold_density),
        ):
            inside = ((1.0, 1.0), (x_m - 1.0, y_m - 1.0))
            for x, y in scattered(density, x_m * y_m, *inside, rng=rng):
                # quarter turns, in line with the hall
                make(parts.at(x, y, 0.0, int(rng.integers(0, 4)) * QUARTER), rng=rng)
        parts.add_to(spec)

    def _lane(self, parts: Parts, *, rng: Generator) -> Parts:
        """Make a frame whose x axis crosses the hall along x or along y."""
        x_m, y_m, _ = self.size_m
        if rng.random() < 0.5:
            return parts.at(0.0, rng.uniform(0.1, 0.9) * y_m)
        return parts.at(rng.uniform(0.1, 0.9) * x_m, 0.0, 0.0, QUARTER)

    def _pipes(self, parts: Parts, *, rng: Generator) -> None:
        """Add parallel pipes at one height on hangers; some turn down to the floor."""
        # the shorter edge, since the lane may run along either; a metre below the roof, pipes pass
        # under its beams
        long, z = min(self.size_m[:2]), rng.uniform(0.4, self.size_m[2] - 1.0)
        y = 0.0
        # side by side: the next pipe begins beyond the last one's surface
        for radius in rng.uniform(*self.pipe_m, int(rng.integers(1, 6))).tolist():
            y += radius
            # half of the pipes end in the hall's second half, and turn down there
            end = long * (0.5 + 0.5 * rng.random()) if rng.random() < 0.5 else long
            parts.rod("pipe", (0, y, z), (end, y, z), radius)
            if end < long:
                # closes the corner between the two cylinders
                parts.ball("pipe", (end, y, z), (radius, radius, radius))
                parts.rod("pipe", (end, y, 0), (end, y, z), radius)
            y += radius + rng.uniform(0.05, 0.3)
        for x in np.arange(1.0, long, 4.0).tolist():
            parts.box("beam", (x, -0.05, z - 0.4), (x + 0.08, y, z - 0.32))
            parts.box("beam", (x, -0.05, 0), (x + 0.08, 0.03, z - 0.32))

    def _tank(self, parts: Parts, *, rng: Generator) -> None:
        radius, (long, lying) = rng.uniform(*self.tank_m), rng.random(2).tolist()
        # lying tanks have round ends and a saddle, upright ones a domed top
        if lying < 0.4:
            half, z = radius * (0.8 + long), radius + 0.5
            parts.rod("tank", (-half, 0, z), (half, 0, z), radius)
            for x in (-half, half):
                parts.ball("tank", (x, 0, z), (0.5 * radius, radius, radius))
            parts.box("beam", (-half / 2, -0.1, 0), (half / 2, 0.1, 0.6))
        else:
            high = 1.5 + 4.0 * long
            parts.solid("tank", CYLINDER, (radius, high / 2, 0.0), (0, 0, high / 2))
            parts.ball("tank", (0, 0, high), (radius, radius, 0.4 * radius))

    def _catwalk(self, parts: Parts, *, rng: Generator) -> None:
        """Add a grating along x on brackets, with railings and a flight of stairs."""
        long, z, wide = min(self.size_m[:2]), rng.uniform(2.2, 5.0), rng.uniform(0.7, 1.2)
        # bars with gaps: rays pass through a grating
        for y in np.arange(0.0, wide, 0.24).tolist():
            parts.box("stairs", (0, y, z - 0.06), (long, y + 0.06, z))
        for x in np.arange(0.0, long, 2.0).tolist():
            parts.box("stairs", (x, 0, z - 0.1), (x + 0.06, wide, z - 0.04))
            for y in (0.0, wide):
                parts.rod("fence", (x, y, z), (x, y, z + 1.1), 0.025)
        for y in (0.0, wide):
            for up in (0.55, 1.1):
                parts.rod("fence", (0, y, z + up), (long, y, z + up), 0.025)
        foot = rng.uniform(0.2, 0.6) * long
        for n in range(int(z / 0.2)):
            # the flight of stairs runs beside the grating
            low = (foot + 0.25 * n, -1.0, 0.2 * n + 0.12)
            parts.box("stairs", low, (low[0] + 0.28, -0.1, 0.2 * n + 0.18))


def _machine(parts: Parts, *, rng: Generator) -> None:
    """Add boxes and a drum on a base."""
    x, y, z = rng.uniform((0.6, 0.4, 0.6), (2.0, 1.2, 1.8)).tolist()
    parts.box("machine", (-x, -y, 0), (x, y, 0.25))
    parts.box("machine", (-0.9 * x, -0.8 * y, 0.25), (0.2 * x, 0.8 * y, z))
    parts.rod("machine", (0.2 * x, 0, 0.3 + 0.3 * z), (0.95 * x, 0, 0.3 + 0.3 * z), 0.3 * z)
    parts.rod("pipe", (-0.5 * x, 0, z), (-0.5 * x, 0, z + rng.uniform(0.3, 3.0)), 0.08)
    parts.box("machine", (0.9 * x, -y, 0), (0.9 * x + 0.3, -0.5 * y, 1.6))


def _scaffold(parts: Parts, *, rng: Generator) -> None:
    """Add bays of tubes and planks."""
    bays, lifts = (int(n) for n in rng.integers((1, 1), (4, 4)))
    for bay in range(bays + 1):
        for y in (0.0, 0.73):
            parts.rod("beam", (2.0 * bay, y, 0), (2.0 * bay, y, 2.0 * lifts + 1.0), 0.024)
    for lift in range(1, lifts + 1):
        z = 2.0 * lift
        parts.box("stairs", (0, 0.05, z), (2.0 * bays, 0.68, z + 0.05))
        for y in (0.0, 0.73):
            for up in (0.0, 1.0):
                parts.rod("beam", (0, y, z + up), (2.0 * bays, y, z + up), 0.024)
        for bay in range(bays):
            parts.rod("beam", (2.0 * bay, 0, z - 2.0), (2.0 * bay + 2.0, 0, z), 0.024)
