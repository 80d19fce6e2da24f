"""Worlds of the kind `maze` that look the same through one scan, as `posterior` has pillars.

How many cells a maze has is taken as known: the walls that are seen tell it. The rest of the recipe
is uniform: the order in which cells are joined, eight numbers a wall, and the walls' thickness. So
all moves are symmetric, and a step counts if the scan stays the same.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from posterior import Looked, Seen, end_of, turn

from lidarsim.engines.forms import meet
from lidarsim.grid import Floats, Mask
from lidarsim.jit import kernel
from lidarsim.solids import BOX, Solids, bounding_boxes
from scenegen.truth import rasterize
from scenegen.worlds.kinds.maze import STEPS, Maze

LOOP, LEFT_OUT, SLIT, SHELF, SIZE_0, PLACE_0, SIZE_1, PLACE_1, CHANCES = range(9)
"""What decides a wall, see `scenegen.worlds.kinds.maze`."""
WINDOWS, OPEN, SLITS, LOOPS, SHELVES, HALVES, CLEAR_M = 0, 2, 3, 4, 5, 6, 8
"""The places of the prior's parameters in one array; ranges take two."""
PIECES = 5
"""Boxes of a wall, at most."""
DEEPEST_M = 1.2
"""How far a shelf stands out, at most, metres."""
IN_MAP = 0.8
"""Share of the steps that are about a wall in the map."""
MOVES = "redraw", "some", "nudge", "order", "swap", "thickness"


class Numbers(NamedTuple):
    """The numbers that draw a maze."""

    cells: tuple[int, int, int]
    order: Any
    """(walls,): in which order cells are joined."""
    chances: Any
    """(walls, CHANCES)."""
    half: Any
    """(1,): half the walls' thickness, metres."""


class Layout(NamedTuple):
    """What all mazes of so many cells have in common, as seen from one pose."""

    axis: Any
    """(walls,): the axis across each."""
    low: Any
    """(walls, 3): the least corner of the cell before it, metres."""
    edges: Any
    first: Any
    """(walls,): number of the cell before it."""
    second: Any
    """(walls,): number of the cell beyond."""
    near: Any
    """Walls in the map; all where none is."""
    rays: Any
    """The rays that may meet each wall, where they enter its region, and where a wall's begin."""
    ray_enters: Any
    ray_starts: Any
    walls: Any
    """The walls that each ray may meet, the nearest first, where it enters their regions, and where
    a ray's begin."""
    wall_enters: Any
    wall_starts: Any
    floor: Any
    """(rays,): where each meets the floor, metres."""


class State(NamedTuple):
    """A maze and its scan; all arrays change in place. The last five: see `posterior.State`."""

    order: Any
    chances: Any
    half: Any
    tree: Any
    """(walls,): whether a wall's cells had no other way when they were joined."""
    boxes: Any
    """(walls, PIECES, 6): centres and half edges, metres."""
    counts: Any
    """(walls,): boxes of each."""
    ranges: Any
    crossed: Any
    ends: Any
    crossings: Any
    hits: Any


class Prior(NamedTuple):
    """A recipe's maze, and its parameters as one array."""

    kind: Maze
    values: Floats


def prior_of(kind: Maze, clear_m: float) -> Prior:
    """A recipe's mazes of which no wall is nearer to the sensor than `clear_m`, metres."""
    if not kind.ground:
        raise ValueError("ground: mazes without a floor are not supported")
    shares = kind.open_share, kind.slit_share, kind.loop_share, kind.shelf_share
    return Prior(kind, np.array([*kind.window_m, *shares, *np.array(kind.wall_m) / 2, clear_m]))


def numbers_of(kind: Maze, rng: np.random.Generator) -> Numbers:
    """The numbers of the maze that `kind` draws with `rng`, in its order."""
    edges = [rng.uniform(*kind.cell_m)] * 2 + [rng.uniform(*kind.level_m)]
    nx, ny, nz = (max(int(of / one), 1) for of, one in zip(kind.size_m, edges, strict=True))
    half = np.array([rng.uniform(*kind.wall_m) / 2])
    return _drawn((nx, ny, nz), half, rng)


def anew(kind: Maze, numbers: Numbers, rng: np.random.Generator) -> Numbers:
    """Those of another maze of as many cells."""
    return _drawn(numbers.cells, np.array([rng.uniform(*kind.wall_m) / 2]), rng)


def _drawn(cells: tuple[int, int, int], half: Any, rng: np.random.Generator) -> Numbers:
    walls = sum(np.prod(np.subtract(cells, step)) for step in STEPS)
    chances = rng.random((walls, CHANCES))
    return Numbers(cells, rng.permutation(walls), chances, half)


def layout_of(looked: Looked, kind: Maze, cells: tuple[int, int, int]) -> Layout:
    """See the class."""
    edges = np.array(kind.size_m) / cells
    walls = [
        (axis, cell)
        for cell in np.ndindex(*cells)
        for axis, step in enumerate(STEPS)
        if cell[axis] + step[axis] < cells[axis]
    ]
    axis, cell = np.array([one for one, _ in walls]), np.array([one for _, one in walls])
    low = edges * cell
    beyond = cell + np.array(STEPS)[axis]
    # the region in which a wall's boxes are, with its shelf
    least, most = low.copy(), low + edges
    rows = np.arange(len(walls))
    thick = kind.wall_m[1] / 2 + 1e-6
    upright = np.where(axis < 2, max(DEEPEST_M, thick), thick)
    least[rows, axis], most[rows, axis] = most[rows, axis] - upright, most[rows, axis] + thick
    with np.errstate(divide="ignore", invalid="ignore"):
        at = [
            (edge[None] - 1e-6 * sign - looked.position) / looked.directions[:, None]
            for edge, sign in ((least, 1), (most, -1))
        ]
    enters = np.nanmax(np.minimum(*at), axis=2).clip(0)
    leaves = np.nanmin(np.maximum(*at), axis=2)
    met = (enters <= leaves) & (enters <= looked.range_m)  # (rays, walls)
    end = looked.origin + np.array(looked.grid.shape) * looked.grid.voxel_m
    near = np.flatnonzero(((least < end) & (most > looked.origin)).all(axis=1))
    by_wall, by_ray = met.T.nonzero(), met.nonzero()
    nearest = np.lexsort((enters[by_ray], by_ray[0]))
    x, y, _ = kind.size_m
    ground = np.array([x / 2, y / 2, kind.ground_m / 2])
    centre = looked.position - np.array([x / 2, y / 2, -kind.ground_m / 2])
    floor = [meet(BOX, *ground, *centre, *one) for one in looked.directions]
    return Layout(
        axis=axis,
        low=low,
        edges=edges,
        first=np.ravel_multi_index(tuple(cell.T), cells),
        second=np.ravel_multi_index(tuple(beyond.T), cells),
        near=near if len(near) else np.arange(len(walls)),
        rays=by_wall[1],
        ray_enters=enters.T[by_wall],
        ray_starts=np.searchsorted(by_wall[0], np.arange(len(walls) + 1)),
        walls=by_ray[1][nearest],
        wall_enters=enters[by_ray][nearest],
        wall_starts=np.searchsorted(by_ray[0], np.arange(len(looked.directions) + 1)),
        floor=np.array(floor),
    )


@kernel
def join(plan, world):
    """Find in place between which cells there was no way when they were joined (Kruskal)."""
    homes = np.arange(plan.second.max() + 1)
    for n in world.order:
        first, second = plan.first[n], plan.second[n]
        while homes[first] != first:
            homes[first] = homes[homes[first]]
            first = homes[first]
        while homes[second] != second:
            homes[second] = homes[homes[second]]
            second = homes[second]
        world.tree[n] = first != second
        homes[first] = second


@kernel
def build(n, plan, world, prior):
    """Compute the boxes of a wall in place, as `Maze` has them."""
    axis, chances, edges = plan.axis[n], world.chances[n], plan.edges
    half, made = world.half[0], world.boxes[n]
    joined = world.tree[n] or chances[LOOP] < prior[LOOPS]
    world.counts[n] = 0
    if joined and chances[LEFT_OUT] < prior[OPEN]:
        return
    at = plan.low[n, axis] + edges[axis]
    u, v = 1 if axis == 0 else 0, 1 if axis == 2 else 2
    u0, v0 = plan.low[n, u], plan.low[n, v]
    u1, v1 = u0 + edges[u], v0 + edges[v]
    a0, a1, b0, b1 = u1, u1, v0, v0
    if joined:
        widest = prior[WINDOWS + 1] - prior[WINDOWS]
        wide = min(prior[WINDOWS] + chances[SIZE_0] * widest, edges[u] - 0.2)
        high = min(prior[WINDOWS] + chances[SIZE_1] * widest, edges[v] - 0.2)
        if axis < 2 and chances[SLIT] < prior[SLITS]:
            wide, high = prior[WINDOWS], edges[2]
        a0 = u0 + chances[PLACE_0] * (edges[u] - wide)
        b0 = v0 + chances[PLACE_1] * (edges[v] - high)
        a1, b1 = a0 + wide, b0 + high
    count = 0
    pieces = ((u0, a0, v0, v1), (a1, u1, v0, v1), (a0, a1, v0, b0), (a0, a1, b1, v1))
    for from_u, to_u, from_v, to_v in pieces:
        if to_u - from_u > 1e-6 and to_v - from_v > 1e-6:
            span(made[count], axis, at - half, at + half)
            span(made[count], u, from_u, to_u)
            span(made[count], v, from_v, to_v)
            count += 1
    if not joined and axis < 2 and chances[SHELF] < prior[SHELVES]:
        begin = plan.low[n, 2] + (0.2 + 0.6 * chances[PLACE_0]) * edges[2]
        span(made[count], axis, at - 0.4 - 0.8 * chances[SIZE_0], at)
        span(made[count], u, u0, u1)
        span(made[count], 2, begin, begin + 0.08)
        count += 1
    world.counts[n] = count


@kernel
def span(box, axis, begin, end):
    """Set where a box is along one axis."""
    box[axis], box[3 + axis] = (begin + end) / 2, (end - begin) / 2


@kernel
def range_of(ray, plan, world, seen):
    """The length of a ray, metres; inf without a return."""
    t, boxes = plan.floor[ray], world.boxes
    x, y, z = seen.position[0], seen.position[1], seen.position[2]
    dx, dy, dz = seen.directions[ray, 0], seen.directions[ray, 1], seen.directions[ray, 2]
    for n in range(plan.wall_starts[ray], plan.wall_starts[ray + 1]):
        if plan.wall_enters[n] > t:
            break
        wall = plan.walls[n]
        for k in range(world.counts[wall]):
            box = boxes[wall, k]
            px, py, pz = x - box[0], y - box[1], z - box[2]
            t = min(t, meet(BOX, box[3], box[4], box[5], px, py, pz, dx, dy, dz))
    return t if t <= seen.range_m else math.inf


@kernel
def is_clear(wall, world, prior, seen):
    """Whether a wall keeps clear of the sensor."""
    for k in range(world.counts[wall]):
        square = 0.0
        for axis in range(3):
            off = abs(seen.position[axis] - world.boxes[wall, k, axis])
            square += max(off - world.boxes[wall, k, 3 + axis], 0.0) ** 2
        if square < prior[CLEAR_M] ** 2:
            return False
    return True


@kernel
def begin(plan, world, prior, seen):
    """Build the maze and cast all rays, in place; return the count of voxels that the scan's counts
    say other than was seen."""
    join(plan, world)
    for n in range(len(world.counts)):
        build(n, plan, world, prior)
    wrong = np.count_nonzero(seen.state)  # before the first ray, nothing is known
    for ray in range(len(world.ranges)):
        world.ranges[ray] = range_of(ray, plan, world, seen)
        to_crossed, to_end = end_of(ray, world.ranges[ray], seen)
        wrong += turn(ray, to_crossed, to_end, world, seen)
    return wrong


@kernel
def put(order, start, stop):
    """Move what is at one place of an order to another, in place."""
    moved, step = order[start], 1 if stop > start else -1
    for n in range(start, stop, step):
        order[n] = order[n + step]
    order[stop] = moved


@kernel
def walk(steps, rng, sharpness, shares, prior, wrong, plan, world, seen, tried, taken):
    """Take so many steps, in place; return the count of wrong voxels. `sharpness`: see
    `posterior.walk`."""
    order, chances, tree, ranges = world.order, world.chances, world.tree, world.ranges
    walls, rays = len(order), len(ranges)
    old_boxes, old_counts, old_tree = world.boxes.copy(), world.counts.copy(), tree.copy()
    changed, stamps = np.empty(walls, np.int64), np.full(rays, -1)
    listed, old_t = np.empty(rays, np.int64), np.empty(rays)
    old_crossed, old_end = np.empty(rays, np.int64), np.empty(rays, np.int64)
    old_chances = np.empty(CHANCES)
    for step in range(steps):
        move = int(np.searchsorted(shares, rng.random()))
        tried[move] += 1
        wall = int(plan.near[rng.integers(0, len(plan.near))])
        if rng.random() >= IN_MAP:
            wall = int(rng.integers(0, walls))
        old_chances[:] = chances[wall]
        old_half, start, stop = world.half[0], -1, -1
        fits = True
        if move == 0 or (move == 3 and rng.random() < 0.5):
            for n in range(CHANCES):
                chances[wall, n] = rng.random()
        elif move == 1:
            for n in range(CHANCES):
                if rng.random() < 0.3:
                    chances[wall, n] = rng.random()
        elif move == 2:
            n = int(rng.integers(SIZE_0, CHANCES))
            chances[wall, n] += 10.0 ** rng.uniform(-3.0, 0.0) * rng.normal()
            fits = 0.0 <= chances[wall, n] <= 1.0
        elif move == 5:
            world.half[0] += 10.0 ** rng.uniform(-4.0, -1.0) * rng.normal()
            fits = prior[HALVES] <= world.half[0] <= prior[HALVES + 1]
        if move in (3, 4):
            start, stop = int(np.argmax(order == wall)), int(rng.integers(0, walls))
            if move == 3:
                put(order, start, stop)
            else:
                order[start], order[stop] = order[stop], order[start]
            join(plan, world)
        several, done, wanted = 0, 0, wrong
        if fits:
            for n in range(walls):
                if move != 5 and n != wall and tree[n] == old_tree[n]:
                    continue
                build(n, plan, world, prior)
                same = world.counts[n] == old_counts[n]
                for k in range(world.counts[n]):
                    for j in range(6):
                        same = same and world.boxes[n, k, j] == old_boxes[n, k, j]
                if not same:
                    changed[several] = n
                    several += 1
                    fits = fits and is_clear(n, world, prior, seen)
        for at in range(several if fits else 0):
            low, high = plan.ray_starts[changed[at]], plan.ray_starts[changed[at] + 1]
            for n in range(low, high):
                ray = plan.rays[n]
                if stamps[ray] == step or plan.ray_enters[n] > ranges[ray] or not fits:
                    continue
                stamps[ray] = step
                t = range_of(ray, plan, world, seen)
                if t == ranges[ray]:
                    continue
                to_crossed, to_end = end_of(ray, t, seen)
                # a return elsewhere than the scan's can never be made good
                if sharpness == math.inf and to_end >= 0 and seen.state[to_end] != 2:
                    fits = False
                    continue
                listed[done], old_t[done] = ray, ranges[ray]
                old_crossed[done], old_end[done] = world.crossed[ray], world.ends[ray]
                done += 1
                ranges[ray] = t
                wanted += turn(ray, to_crossed, to_end, world, seen)
        if fits and wanted > wrong:
            fits = math.log(rng.random()) < -sharpness * (wanted - wrong)
        if fits:
            wrong = wanted
            taken[move] += 1
            old_tree[:] = tree
            for at in range(several):
                n = changed[at]
                old_boxes[n], old_counts[n] = world.boxes[n], world.counts[n]
            continue
        for n in range(done):
            ray = listed[n]
            turn(ray, old_crossed[n], old_end[n], world, seen)
            ranges[ray] = old_t[n]
        for at in range(several):
            n = changed[at]
            world.boxes[n], world.counts[n] = old_boxes[n], old_counts[n]
        tree[:] = old_tree
        chances[wall], world.half[0] = old_chances, old_half
        if move == 3:
            put(order, stop, start)
        elif move == 4:
            order[start], order[stop] = order[stop], order[start]
    return wrong


class Chain:
    """A chain of mazes that look the same from one pose; see `posterior.Chain`."""

    chances = np.cumsum([0.25, 0.25, 0.2, 0.2, 0.09, 0.01])

    def __init__(self, looked: Looked, prior: Prior, numbers: Numbers, seed: Any):
        self.looked, self.prior, self._cells = looked, prior, numbers.cells
        self._rng = np.random.default_rng(seed)
        self._plan = layout_of(looked, prior.kind, numbers.cells)
        walls, rays, voxels = len(numbers.order), len(looked.directions), len(looked.state)
        self._world = State(
            order=numbers.order.copy(),
            chances=numbers.chances.copy(),
            half=numbers.half.copy(),
            tree=np.zeros(walls, np.bool_),
            boxes=np.zeros((walls, PIECES, 6)),
            counts=np.zeros(walls, np.int64),
            ranges=np.full(rays, np.inf),
            crossed=np.zeros(rays, np.int64),
            ends=np.full(rays, -1),
            crossings=np.zeros(voxels, np.int32),
            hits=np.zeros(voxels, np.int32),
        )
        self._seen = Seen.of(looked)
        self.tried, self.taken = np.zeros((2, len(MOVES)), np.int64)
        self.wrong = begin(self._plan, self._world, prior.values, self._seen)

    def walk(self, steps: int, sharpness: float = math.inf) -> None:
        """Take so many steps; see `posterior.walk`."""
        how = steps, self._rng, sharpness, self.chances, self.prior.values, self.wrong
        arguments: Any = *how, self._plan, self._world, self._seen, self.tried, self.taken
        self.wrong = walk(*arguments)

    def world(self) -> tuple[Numbers, Floats]:
        """The numbers of the maze now, and its boxes (n, 6)."""
        world, there = self._world, np.arange(PIECES) < self._world.counts[:, None]
        numbers = Numbers(self._cells, world.order.copy(), world.chances.copy(), world.half.copy())
        return numbers, world.boxes[there]

    def joined(self) -> Mask:
        """Between which cells there is no closed wall, (walls,)."""
        loops = self._world.chances[:, LOOP] < self.prior.values[LOOPS]
        return np.asarray(self._world.tree | loops)

    def state(self) -> Any:
        """What the scan of the maze now makes known, as `Looked.state`, (voxels,)."""
        return np.where(self._world.hits > 0, 2, self._world.crossings > 0).astype(np.int8)

    def clear(self) -> bool:
        """Whether all walls keep clear of the sensor."""
        return all(
            is_clear(n, self._world, self.prior.values, self._seen)
            for n in range(len(self._world.counts))
        )

    def occupancy(self) -> Mask:
        """The occupied voxels of the maze now, (*grid.shape)."""
        x, y, _ = self.prior.kind.size_m
        depth = self.prior.kind.ground_m / 2
        floor = [x / 2, y / 2, -depth, x / 2, y / 2, depth]
        solids = solids_of(np.concatenate([[floor], self.world()[1]]))
        return rasterize(solids, self.looked.grid, self.looked.origin)


def solids_of(boxes: Floats) -> Solids:
    """The solids of boxes (n, 6): centres and half edges."""
    count = len(boxes)
    shape, rotation = np.full(count, BOX), np.tile(np.eye(3), (count, 1, 1))
    position, size = boxes[:, :3].copy(), boxes[:, 3:].copy()
    lower, upper = bounding_boxes(shape, size, position, rotation)
    return Solids(
        shape=shape, size=size, position=position, rotation=rotation, lower=lower, upper=upper,
        triangles=np.zeros((0, 3, 3)), mesh_start=np.zeros(1, np.int64),
        mesh_filled=np.zeros(0, bool), geom=np.arange(count),
    )  # fmt: skip
