"""A maze in three dimensions: cells on several levels, and walls and floors with windows to fly
through."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.parameters import number
from scenegen.recipes.kind import Classed, Range, Size
from scenegen.recipes.parts import Parts, Span, join
from scenegen.worlds.drawing import Drawing

STEPS = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


@dataclass(frozen=True, kw_only=True)
class Maze(Classed):
    """Cells joined by a random spanning tree (Kruskal 1956, edges in random order), and loops. A
    wall between joined cells is left out, or has a window or a slit; shelves stand out of some of
    the others. Narrow passages by design: windows are 2 to 4 times as wide as the robot."""

    version = 2
    graded = {
        "easy": {
            "cell_m": (5.5, 7.5),
            "window_m": (1.8, 3.0),
            "open_share": 0.6,
            "loop_share": 0.5,
            "shelf_share": 0.05,
        },
        "hard": {
            "cell_m": (3.8, 4.8),
            "window_m": (1.5, 2.1),
            "open_share": 0.2,
            "loop_share": 0.4,
            "shelf_share": 0.4,
        },
    }
    crowded_by = ("shelf_share",)
    flight_defaults = {"altitude_m": (0.6, 6.2), "min_distance_m": 4.0, "flights_per_world": 6}

    size_m: Size = (40.0, 40.0, 6.8)
    """Extent of the maze along x, y and z, metres."""
    ground: bool = True
    """Whether there is a floor under the lowest level."""
    cell_m: Range = number((4.0, 6.0), least=1.0, most=1000, rising=True)
    """Edge of a cell in the plan, metres; one value a world."""
    level_m: Range = number((3.0, 3.4), least=1.0, most=1000, rising=True)
    """Height of a level, metres; one value a world."""
    wall_m: Range = (0.1, 0.3)
    """Thickness of walls, metres; one value a world."""
    window_m: Range = (1.3, 2.6)
    """Edges of windows, metres. Source: two to four times the robot's 0.6 m: narrow by design."""
    open_share: float = 0.4
    """Share of walls between joined cells that are left out."""
    slit_share: float = 0.15
    """Share of the remaining ones whose window is a slit from floor to ceiling."""
    loop_share: float = 0.35
    """Share of walls between cells that are joined though there is another way."""
    shelf_share: float = 0.2
    """Share of closed walls with a shelf."""

    def _cells(self, cell: float, level: float) -> tuple[int, int, int]:
        x_m, y_m, z_m = self.size_m
        return max(int(x_m / cell), 1), max(int(y_m / cell), 1), max(int(z_m / level), 1)

    def most_solids(self) -> float:
        """Five solids for each of the walls around every cell."""
        return 15.0 * np.prod(self._cells(self.cell_m[0], self.level_m[0]))

    def add_to(self, spec: Drawing, *, rng: np.random.Generator) -> None:
        """Join cells in a random order, and build what is between them."""
        parts = self.begun("floor")
        shape = self._cells(rng.uniform(*self.cell_m), rng.uniform(*self.level_m))
        edges = np.array(self.size_m) / shape
        half = rng.uniform(*self.wall_m) / 2
        walls = [
            (axis, cell)
            for cell in np.ndindex(*shape)
            for axis, step in enumerate(STEPS)
            if cell[axis] + step[axis] < shape[axis]
        ]
        ways, chances = dict[Any, Any](), rng.random((len(walls), 8)).tolist()
        for n in rng.permutation(len(walls)).tolist():
            axis, cell = walls[n]
            other = tuple(a + b for a, b in zip(cell, STEPS[axis], strict=True))
            joined = join(ways, cell, other) or chances[n][0] < self.loop_share
            if not (joined and chances[n][1] < self.open_share):
                low = [a * b for a, b in zip(cell, edges.tolist(), strict=True)]
                self._wall(parts, axis, low, edges.tolist(), half, joined, chances[n][2:])
        parts.add_to(spec)

    def _wall(
        self,
        parts: Parts,
        axis: int,
        low: list[float],
        edges: list[float],
        half: float,
        joined: bool,
        chances: list[float],
    ) -> None:
        """The wall beyond a cell across `axis`, with a window where cells are joined."""
        across = [n for n in range(3) if n != axis]
        slit, shelf, a, b, c, d = chances
        of_class = "ceiling" if axis == 2 else "wall"
        least, most = self.window_m
        window: list[Span] = []
        for n, (size, place) in zip(across, ((a, b), (c, d)), strict=True):
            wide = min(least + size * (most - least), edges[n] - 0.2)
            if axis < 2 and slit < self.slit_share:
                wide = edges[2] if n == 2 else least
            begin = low[n] + place * (edges[n] - wide)
            window.append((begin, begin + wide))
        ends = [low[n] + edges[n] for n in range(3)]
        whole = [(low[n], ends[n]) for n in across]
        parts.wall(of_class, axis, ends[axis], half, whole, window if joined else None)
        if not joined and axis < 2 and shelf < self.shelf_share:
            corner, opposite = list(low), list(ends)
            corner[axis] = ends[axis] - 0.4 - 0.8 * a
            corner[2] = low[2] + (0.2 + 0.6 * b) * edges[2]
            opposite[2] = corner[2] + 0.08
            parts.box("shelf", corner, opposite)
