"""A maze in three dimensions: cells on several levels, and walls and floors with windows to fly
through.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from lidarsim.grid import Floats
from lidarsim.parameters import number
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.kind import Classed, Range, Size
from scenegen.worlds.kinds.parts import Parts, Span, join

STEPS = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


class _Chances(NamedTuple):
    """Numbers from 0 to 1 that decide the wall between two cells."""

    loop: float
    """Whether the cells are joined though there is another way."""
    left_out: float
    slit: float
    shelf: float
    size_0: float
    """The window's along the first of the wall's two axes; or, as walls with a window have no
    shelf, the shelf's depth."""
    place_0: float
    """The window's along this axis; or the shelf's height."""
    size_1: float
    """The window's along the second axis."""
    place_1: float


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
    cell_m: Range = number((4.0, 6.0), minimum=1.0, maximum=1000)
    """Edge of a cell in the plan, metres; one value a world."""
    level_m: Range = number((3.0, 3.4), minimum=1.0, maximum=1000)
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

    def max_solids(self) -> float:
        """Count five solids for each of the walls around every cell."""
        # three walls belong to a cell; each has four pieces and a shelf
        return 15.0 * np.prod(self._cells(self.cell_m[0], self.level_m[0]))

    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Join cells in a random order, and build the walls between them.

        Args:
            spec: The world to add to.
            rng: Decides everything that is random.
        """
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
        joins, drawn = dict[Any, Any](), rng.random((len(walls), len(_Chances._fields))).tolist()
        for n in rng.permutation(len(walls)).tolist():
            axis, cell = walls[n]
            chances = _Chances(*drawn[n])
            neighbour = tuple(np.add(cell, STEPS[axis]).tolist())
            # joined if there was no way between them yet (Kruskal), or by chance
            joined = join(joins, cell, neighbour) or chances.loop < self.loop_share
            if not (joined and chances.left_out < self.open_share):
                self._wall(parts, axis, edges * cell, edges, half, joined, chances)
        parts.add_to(spec)

    def _wall(
        self,
        parts: Parts,
        axis: int,
        low: Floats,
        edges: Floats,
        half: float,
        joined: bool,
        chances: _Chances,
    ) -> None:
        """Add the wall beyond a cell across `axis`, with a window if cells are joined.

        It is twice `half` thick. `low` (3,) is the cell's least corner, and `edges` (3,) its edges,
        metres."""
        begin, end, size_m = low.tolist(), (low + edges).tolist(), edges.tolist()
        along = [n for n in range(3) if n != axis]
        narrowest, widest = self.window_m
        places = (chances.size_0, chances.place_0), (chances.size_1, chances.place_1)
        window: list[Span] = []
        for n, (size, place) in zip(along, places, strict=True):
            # a rim of wall remains around a window
            wide = min(narrowest + size * (widest - narrowest), size_m[n] - 0.2)
            # only upright walls have slits, up to the ceiling
            if axis < 2 and chances.slit < self.slit_share:
                wide = size_m[2] if n == 2 else narrowest
            start = begin[n] + place * (size_m[n] - wide)
            window.append((start, start + wide))
        whole = [(begin[n], end[n]) for n in along]
        of_class = "ceiling" if axis == 2 else "wall"
        parts.wall(of_class, axis, end[axis], half, whole, window if joined else None)
        if not joined and axis < 2 and chances.shelf < self.shelf_share:
            # the shelf stands out into the cell; its depth uses a chance that closed walls do not
            # need
            begin[axis] = end[axis] - 0.4 - 0.8 * chances.size_0
            begin[2] += (0.2 + 0.6 * chances.place_0) * size_m[2]
            end[2] = begin[2] + 0.08
            parts.box("shelf", begin, end)
