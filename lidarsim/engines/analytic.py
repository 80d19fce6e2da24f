"""Ray casting by closed forms, through a hierarchy of boxes, without MuJoCo's ray caster."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.engines.forms import squared_reaches
from lidarsim.engines.hierarchy import Hierarchy
from lidarsim.engines.traverse import LANES, TILE, surfaces_of, traverse, work_arrays
from lidarsim.grid import Floats, Ints, rays_of
from lidarsim.solids import PLANE, Solids

if TYPE_CHECKING:
    import mujoco

RAYS_A_THREAD = 50_000
"""A thread pays from this many rays on: about ten milliseconds of work."""


MAX_KEPT = 2**20
"""An engine caches its last cast up to this many rays, 40 bytes each: noise often asks for the
surfaces of a scan just made."""


class _Cast(NamedTuple):
    """The last cast: rays of P poses, and the items that they met."""

    max_range_m: float
    starts: Floats
    """(P, 3)."""
    skipped: Ints
    """(P,), see `AnalyticEngine._left_out`."""
    rays: Floats
    """(P, n, 3)."""
    ranges: Floats
    """(P, n)."""
    items: Ints
    """(P, n)."""


@dataclass(frozen=True, eq=False)
class Hits:
    """The surfaces that rays (P, *shape) met, all in the world frame."""

    ranges: Floats
    """(P, *shape), metres; ``inf`` where nothing was met."""
    geoms: Ints
    """(P, *shape): numbers of the model's geoms; -1 where nothing was met."""
    points: Floats
    """(P, *shape, 3), metres; NaN where nothing was met."""
    normals: Floats
    """(P, *shape, 3): unit normals, outward also where a ray comes from inside; NaN where nothing
    was met. A triangle's is the side from which its corners turn left: outward for a closed
    mesh."""


class AnalyticEngine:
    """Casts rays at primitives by closed forms, and at the triangles of meshes and height fields:
    an `Engine`.

    It agrees with MuJoCo's rays but for height fields: in MuJoCo, rays from within also stop at
    height 0, where no surface is. No ray passes between triangles that share an edge or a corner.
    Many poses at once are shared by `threads`, as many as there are processors unless a number is
    given; one pose stays on one thread."""

    def __init__(self, solids: Solids, *, threads: int | None = None, parts: ArrayLike = ()):
        """Build the hierarchy over solids.

        Args:
            solids: The world.
            threads: How many threads share the poses of a cast; one for each processor if None.
            parts: (n + m,), numbers from 0 on: the part that each solid belongs to, for `hits` to
                let rays pass through.
        """
        self._threads = threads if threads is not None else len(os.sched_getaffinity(0))
        self._solids = solids
        self._last: _Cast | None = None
        self._around = (np.empty(0),) * 3  # triangles, and the corners of their boxes
        # nothing bounds planes: the tree holds the rest, and every ray meets each of them
        planes = solids.shape == PLANE
        self._planes = np.flatnonzero(planes).astype(np.uint64)
        triangles = len(planes) + np.arange(len(solids.triangles))
        self._bounded = np.concatenate([np.flatnonzero(~planes), triangles])
        self._reach2 = squared_reaches(solids.shape, solids.size)
        self._part = (
            _by_item(solids, np.asarray(parts, np.int64))
            if np.size(parts)
            else np.empty(0, np.int64)
        )
        self._hierarchy = Hierarchy.over(*self._boxes())
        self._order = self._bounded.astype(np.uint64)[self._hierarchy.order]

    @classmethod
    def of(cls, model: "mujoco.MjModel", data: "mujoco.MjData | None" = None) -> Self:
        """See `lidarsim.engines.Engine.of`.

        Args:
            model: The world.
            data: Where bodies are.

        Returns:
            The engine.

        Raises:
            ValueError: As `solids_of` does.
        """
        # loads MuJoCo, which an engine over known solids does not need
        from lidarsim.solids import solids_of

        return cls(solids_of(model, data))

    def move(self, solids: Solids) -> None:
        """Move the engine's solids: the hierarchy is refitted, which is quicker than a new engine.

        Args:
            solids: The same solids at other places.

        Raises:
            ValueError: If they are other solids than those of the engine.
        """
        constant = ("geom", "shape", "mesh_start")
        if not all(
            np.array_equal(getattr(solids, name), getattr(self._solids, name)) for name in constant
        ):
            raise ValueError(
                "other solids than the engine's, expected the same ones at other places; make a "
                "new engine"
            )
        # the balls depend on sizes only, which seldom change
        if not np.array_equal(solids.size, self._solids.size):
            self._reach2 = squared_reaches(solids.shape, solids.size)
        self._solids, self._last = solids, None
        self._hierarchy.refit(*self._boxes())

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """See `lidarsim.engines.Caster.cast`.

        Returns:
            (P, *shape), metres.
        """
        return self._meet(origins, directions, max_range_m, None)[0]

    def nearest(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        *,
        through: ArrayLike | None = None,
    ) -> tuple[Floats, Ints]:
        """Cast rays, and tell which geoms they met.

        Args:
            origins: As for `cast`.
            directions: As for `cast`.
            max_range_m: As for `cast`.
            through: As for `hits`.

        Returns:
            Ranges (P, *shape), metres, as `cast` gives them; and numbers of the geoms met, (P,
            *shape), -1 for none.
        """
        ranges, items, _, _ = self._meet(origins, directions, max_range_m, through)
        return ranges, self._owners[items]

    def hits(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        *,
        through: ArrayLike | None = None,
    ) -> Hits:
        """Cast rays, and describe the surfaces that they met.

        Of several solids at the same distance, the first is met: primitives by their numbers, then
        meshes and height fields by theirs.

        Args:
            origins: As for `cast`.
            directions: As for `cast`.
            max_range_m: As for `cast`.
            through: (P,): the part, see `parts`, that the rays of each pose pass through; -1 for
                none.

        Returns:
            Range, geom, point and normal of every ray.
        """
        query = origins, directions, max_range_m, through
        ranges, items, starts, rays = self._cached(*query) or self._meet(*query)
        solids, (points, normals) = self._solids, np.empty((2, *rays.shape))
        flat = len(starts), math.prod(rays.shape[1:-1])
        surfaces_of(
            items.reshape(flat),
            ranges.reshape(flat),
            starts,
            rays.reshape(*flat, 3),
            solids.shape,
            solids.size,
            solids.position,
            solids.rotation,
            solids.triangles,
            points.reshape(*flat, 3),
            normals.reshape(*flat, 3),
        )
        return Hits(ranges, self._owners[items], points, normals)

    def _meet(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        through: ArrayLike | None,
    ) -> tuple[Floats, Ints, Floats, Floats]:
        """Cast rays, and cache them.

        Returns ranges (P, *shape); the item that each ray met: a primitive's number, from n on a
        triangle's, or -1; origins (P, 3) and unit vectors (P, *shape, 3). Raises ValueError as
        `rays_of` does, since the kernel would read beyond arrays of other shapes."""
        # copies, for the kernel is compiled for arrays that can be written
        starts, vectors = rays_of(origins, directions, max_range_m)
        shape = vectors.shape[:-1]
        rays = vectors.reshape(len(starts), math.prod(shape[1:]), 3)
        reach = min(float(max_range_m), np.finfo(np.float64).max)  # what is missed lies at infinity
        flat = rays.shape[:2]
        ranges, items = np.full(flat, np.inf), np.full(flat, -1)
        solids, tree = self._solids, self._hierarchy
        skipped, turn = self._left_out(len(rays), through), _neighbours(shape[1:])

        # poses are independent, so that any division into threads gives the same bits
        def share(poses: slice) -> None:
            traverse(
                starts[poses],
                rays[poses],
                reach,
                turn,
                solids.shape,
                solids.size,
                solids.position,
                solids.rotation,
                self._reach2,
                self._planes,
                solids.triangles,
                tree.boxes,
                tree.links,
                tree.ends,
                self._order,
                self._part,
                skipped[poses],
                ranges[poses],
                items[poses],
                work_arrays(),
            )

        shares = min(self._threads, len(rays), ranges.size // RAYS_A_THREAD)
        if shares < 2:
            share(slice(None))
        else:
            bounds = np.linspace(0, len(rays), shares + 1).astype(int)
            with ThreadPoolExecutor(shares) as pool:  # the kernel lets go of the interpreter's lock
                list(pool.map(share, map(slice, bounds[:-1], bounds[1:])))
        small = ranges.size <= MAX_KEPT
        # a copy of the ranges alone: they go to the caller, who may write to them
        self._last = (
            _Cast(max_range_m, starts, skipped, rays, ranges.copy(), items) if small else None
        )
        return ranges.reshape(shape), items.reshape(shape), starts, vectors

    def _cached(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        through: ArrayLike | None,
    ) -> tuple[Floats, Ints, Floats, Floats] | None:
        """Return the result of `_meet` for the rays of one pose, if they are among the last cast;
        else None."""
        last = self._last  # another thread may cast meanwhile
        starts, rays = np.asarray(origins, float), np.asarray(directions, float)
        shape = rays.shape[:-1]
        single = starts.shape == shape[:1] + rays.shape[-1:] == (1, 3)
        if last is None or last.max_range_m != max_range_m or not single:
            return None
        candidates = (last.starts == starts).all(axis=1) & (
            last.skipped == self._left_out(1, through)
        )
        for pose in np.flatnonzero(candidates):
            if np.array_equal(last.rays[pose], rays.reshape(-1, 3)):
                ranges, items = last.ranges[pose].copy(), last.items[pose]
                rays_cast = last.starts[pose : pose + 1], last.rays[pose].reshape(rays.shape)
                return ranges.reshape(shape), items.reshape(shape), *rays_cast
        return None

    def _left_out(self, poses: int, through: ArrayLike | None) -> Ints:
        """Return the part that the rays of each pose pass through, (P,); -1 for none."""
        skipped = np.full(poses, -1)
        if through is not None and len(self._part):
            skipped[:] = through
        return skipped

    @cached_property
    def _owners(self) -> Ints:
        """Geoms that items belong to, (n + T + 1,).

        The last one is -1, to which the item -1 leads."""
        return np.append(_by_item(self._solids, self._solids.geom), -1)

    def _boxes(self) -> tuple[Floats, Floats]:
        """Compute boxes of the hierarchy's items: least and greatest corners, (k, 3) each."""
        solids, inside = self._solids, self._bounded
        # `ModelSolids.at` returns the same array while no mesh moves
        if self._around[0] is not solids.triangles:
            self._around = (
                solids.triangles,
                solids.triangles.min(axis=1),
                solids.triangles.max(axis=1),
            )
        _, lowest, highest = self._around
        return np.concatenate([solids.lower, lowest])[inside], np.concatenate(
            [solids.upper, highest]
        )[inside]


@lru_cache(maxsize=2)
def _neighbours(shape: tuple[int, ...]) -> NDArray[np.uint64]:
    """Order the rays (*shape) of a pose tile by tile of the last two axes.

    Returns their numbers. Rays in a row make tiles of one row."""
    *_, rows, columns = 1, 1, *shape
    number = np.arange(math.prod(shape))
    row, column = number // columns, number % columns
    tall, broad = (TILE, TILE) if rows > 1 else (1, LANES)
    # the sort is stable, so rays of a tile stay row by row
    return np.lexsort((column // broad, row // tall)).astype(np.uint64)


def _by_item(solids: Solids, values: Ints) -> Ints:
    """Repeat values (n + m,) of solids as values (n + T,) of primitives and triangles."""
    plain = len(solids.shape)
    return np.concatenate([values[:plain], np.repeat(values[plain:], np.diff(solids.mesh_start))])
