"""Worlds of the kind `pillar` that look the same through one scan: samples from the recipe's prior
given the voxels that a network sees.

A Markov chain over the numbers that draw a world (Metropolis–Hastings, with moves that change how
many numbers there are: Green 1995). The prior is that of `Pillar.add_to`. A world is possible if
its scan from the given pose has the same observed and free voxels, bit for bit, and if the pose
keeps the flight's clearance. Not conditioned on: that the world had a flight and was accepted. The
true world is itself a draw from this posterior, so a chain that begins there needs no burn-in; how
far it has gone is shown by chains that begin elsewhere.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lidarsim import GridSpec, Pose, Sensor
from lidarsim.engines.forms import meet
from lidarsim.grid import Floats, Ints, Mask
from lidarsim.jit import kernel
from lidarsim.pose import rotate
from lidarsim.solids import BOX, CYLINDER, Solids, bounding_boxes
from lidarsim.voxelization import TOUCH_M, cell_at
from scenegen.truth import rasterize
from scenegen.worlds.kinds.pillar import Pillar

SECTION, HALF, RATIO, YAW, X, Y, PASSAGE, PARENT, ANGLE, GAP, NUMBERS = range(11)
"""The numbers of a pillar: uniform in [0, 1) for its section; half its width, metres; its length
over its width; its turn, radians; its place, metres; whether it forms a passage, with which earlier
pillar, in which direction, and how wide. A pillar of a passage has no use for X and Y, others none
for the last three."""
SHAPE, LENGTH, AT_X, AT_Y, SINE, COSINE, HULL, FORM = range(8)
"""What follows from them: its shape and length, its centre, its turn, its hull's radius."""
DENSITY, HALVES, ROUND, OBLONG, MOST_RATIO, SHARE, GAPS, SIZE, HEIGHT, CLEAR_M, PRIOR = (
    0, 2, 4, 5, 6, 7, 8, 10, 12, 13, 14,
)  # fmt: skip
"""The places of the prior's parameters in one array; ranges take two."""


class Seen(NamedTuple):
    """A scan's rays, the grid, what the scan made known, and the voxels that rays cross."""

    position: Any
    directions: Any
    range_m: Any
    origin: Any
    voxel_m: Any
    shape: Any
    state: Any
    cells: Any
    enters: Any
    starts: Any

    @classmethod
    def of(cls, looked: "Looked") -> "Seen":
        """What a chain of these arrays needs to know of a scan."""
        grid = looked.grid
        return cls(
            *(looked.position, looked.directions, looked.range_m),
            *(looked.origin, grid.voxel_m, np.array(grid.shape)),
            *(looked.state, *looked.paths),
        )


class State(NamedTuple):
    """A world and its scan; all arrays change in place."""

    numbers: Any
    forms: Any
    ranges: Any
    """(rays,): metres; inf without a return."""
    owners: Any
    """(rays,): the pillar that returned it, or -1."""
    crossed: Any
    """(rays,): voxels of its path that the ray crosses."""
    ends: Any
    """(rays,): the voxel of its return, or -1."""
    crossings: Any
    """(voxels,): rays that cross each."""
    hits: Any
    """(voxels,): returns in each."""


MOVES = "redraw", "nudge", "reshape", "number", "exchange", "passage", "swing"


@dataclass(frozen=True, eq=False)
class Looked:
    """A scan's rays, and what they made known."""

    position: Floats
    """(3,): the sensor's, metres."""
    directions: Floats
    """(rays, 3), unit vectors in the world."""
    range_m: float
    grid: GridSpec
    origin: Floats
    """(3,): the grid's least corner, metres."""
    state: Any
    """int8 (voxels,): 0 unknown, 1 free, 2 observed."""

    @classmethod
    def of(
        cls, pose: Pose, lidar: Sensor, grid: GridSpec, origin: Floats, observed: Mask, free: Mask
    ) -> "Looked":
        """See the fields; `observed` and `free` (*grid.shape)."""
        directions = rotate(pose.quaternion, lidar.directions_body).reshape(-1, 3)
        state = (2 * observed + free).astype(np.int8).reshape(-1)
        return cls(pose.position, directions, lidar.max_range_m, grid, origin, state)

    @cached_property
    def paths(self) -> tuple[Ints, Floats, Ints]:
        """The voxels that every ray crosses up to its range, in order: their numbers, where the ray
        enters each, metres, and where each ray's begin (rays + 1,)."""
        shape, voxel_m = np.array(self.grid.shape), self.grid.voxel_m
        cells, enters, starts = [], [], [0]
        for direction in self.directions:
            with np.errstate(divide="ignore", invalid="ignore"):
                edges = [
                    (self.origin[a] + voxel_m * np.arange(shape[a] + 1) - self.position[a])
                    / direction[a]
                    for a in range(3)
                ]
            at = np.concatenate([[0.0, self.range_m], *edges])
            at = np.unique(at[np.isfinite(at) & (at >= 0) & (at <= self.range_m)])
            long = np.diff(at) > TOUCH_M
            begin, middle = at[:-1][long], (0.5 * (at[:-1] + at[1:]))[long]
            points = self.position + middle[:, None] * direction - self.origin
            voxels = np.floor(points / voxel_m).astype(np.int64)
            inside = ((voxels >= 0) & (voxels < shape)).all(axis=1)
            cells.append(np.ravel_multi_index(tuple(voxels[inside].T), self.grid.shape))
            enters.append(begin[inside])
            starts.append(starts[-1] + int(inside.sum()))
        return np.concatenate(cells), np.concatenate(enters), np.array(starts)


def prior_of(kind: Pillar, clear_m: float) -> Floats:
    """The parameters of a recipe's pillars as one array; no pillar is nearer to the sensor than
    `clear_m`, metres."""
    if kind.height_m[0] != kind.height_m[1]:
        raise ValueError("height_m: pillars of several heights are not supported")
    return np.array(
        [
            *kind.density, *kind.half_width_m, kind.round_share, kind.oblong_share,
            kind.oblong_ratio, kind.passage_share, *kind.passage_m, *kind.size_m[:2],
            kind.height_m[0], clear_m,
        ]
    )  # fmt: skip


def most_pillars(prior: Floats) -> int:
    """The greatest number of pillars in a world."""
    return max(round(prior[DENSITY + 1] * prior[SIZE] * prior[SIZE + 1]), 1)


def numbers_of(kind: Pillar, rng: np.random.Generator) -> Floats:
    """The numbers (pillars, NUMBERS) of the world that `kind` draws with `rng`, in its order."""
    x_m, y_m, _ = kind.size_m
    count = max(round(rng.uniform(*kind.density) * x_m * y_m), 1)
    drawn = np.zeros((count, NUMBERS))
    drawn[:, SECTION] = rng.random(count)
    drawn[:, HALF] = rng.uniform(*kind.half_width_m, count)
    drawn[:, RATIO] = rng.uniform(1.0, kind.oblong_ratio, count)
    rng.uniform(*kind.height_m, count)
    drawn[:, [X, Y]] = rng.uniform((0.0, 0.0), (x_m, y_m), (count, 2))
    drawn[:, YAW] = rng.uniform(0.0, np.pi, count)
    for n in np.flatnonzero(rng.random(count) < kind.passage_share).tolist():
        if n:
            passage = rng.integers(0, n), rng.uniform(0.0, 2 * np.pi), rng.uniform(*kind.passage_m)
            drawn[n, [PASSAGE, PARENT, ANGLE, GAP]] = 1, *passage
    return drawn


def anew(kind: Pillar, numbers: Floats, rng: np.random.Generator) -> Floats:
    """The numbers of another world."""
    return numbers_of(kind, rng)


@kernel
def form(number, numbers, forms, prior):
    """Compute the form of a pillar from its numbers; its parent's is there."""
    row, made = numbers[number], forms[number]
    section, half = row[SECTION], row[HALF]
    is_round = section < prior[ROUND]
    oblong = not is_round and section < prior[ROUND] + prior[OBLONG]
    length = half * row[RATIO] if oblong else half
    made[SHAPE] = 0.0 if is_round else 1.0
    made[LENGTH] = length
    made[HULL] = half if is_round else math.sqrt(half * half + length * length)
    made[SINE], made[COSINE] = math.sin(row[YAW]), math.cos(row[YAW])
    if row[PASSAGE] > 0.0:
        other = forms[int(row[PARENT])]
        reach = made[HULL] + other[HULL] + row[GAP]
        made[AT_X] = other[AT_X] + reach * math.cos(row[ANGLE])
        made[AT_Y] = other[AT_Y] + reach * math.sin(row[ANGLE])
    else:
        made[AT_X], made[AT_Y] = row[X], row[Y]


@kernel
def misses(n, forms, position, dx, dy):
    """Whether a ray passes beside the hull of pillar `n`, in the plan."""
    px, py, hull = position[0] - forms[n, AT_X], position[1] - forms[n, AT_Y], forms[n, HULL]
    across = px * dy - py * dx
    return across * across > hull * hull * (dx * dx + dy * dy)


@kernel
def range_to(row, made, height, position, direction):
    """Where a ray meets a pillar, metres; inf where it misses."""
    px, py = position[0] - made[AT_X], position[1] - made[AT_Y]
    dx, dy = direction[0], direction[1]
    pz, half = position[2] - height / 2, height / 2
    if made[SHAPE] == 0.0:
        return meet(CYLINDER, row[HALF], half, 0.0, px, py, pz, dx, dy, direction[2])
    s, c = made[SINE], made[COSINE]
    qx, qy, ex, ey = c * px + s * py, c * py - s * px, c * dx + s * dy, c * dy - s * dx
    return meet(BOX, row[HALF], made[LENGTH], half, qx, qy, pz, ex, ey, direction[2])


@kernel
def apart(row, made, x, y):
    """The distance of a point of the plan from a pillar, metres; below 0 inside a round one."""
    px, py = x - made[AT_X], y - made[AT_Y]
    if made[SHAPE] == 0.0:
        return math.sqrt(px * px + py * py) - row[HALF]
    s, c = made[SINE], made[COSINE]
    qx = max(abs(c * px + s * py) - row[HALF], 0.0)
    qy = max(abs(c * py - s * px) - made[LENGTH], 0.0)
    return math.sqrt(qx * qx + qy * qy)


@kernel
def slope(row, made, x, y):
    """How fast `apart` grows as the pillar moves away from the point along the line through both;
    0 inside a box."""
    if made[SHAPE] == 0.0:
        return 1.0
    px, py = x - made[AT_X], y - made[AT_Y]
    s, c = made[SINE], made[COSINE]
    lx, ly = abs(c * px + s * py), abs(c * py - s * px)
    qx, qy = max(lx - row[HALF], 0.0), max(ly - made[LENGTH], 0.0)
    off = math.sqrt(qx * qx + qy * qy)
    return (lx * qx + ly * qy) / (off * math.sqrt(px * px + py * py)) if off > 0.0 else 0.0


@kernel
def end_of(ray, t, seen):
    """How many voxels of its path a ray of length `t` crosses, and the voxel of its return, or -1;
    lengths are rounded as scans have them."""
    t = float(np.float32(t))
    returns = t <= seen.range_m
    reach = t if returns else seen.range_m
    low, high = seen.starts[ray], seen.starts[ray + 1]
    while low < high:
        middle = (low + high) // 2
        if seen.enters[middle] < reach - TOUCH_M:
            low = middle + 1
        else:
            high = middle
    cell = -1
    if returns:
        nx, ny, nz = seen.shape
        direction = seen.directions[ray]
        cell = cell_at(seen.position, direction, reach, seen.origin, seen.voxel_m, nx, ny, nz)
    return low - seen.starts[ray], cell


@kernel
def changed(cell, world, seen):
    """1 if the counts of a voxel say other than its state, else 0."""
    said = 2 if world.hits[cell] > 0 else 1 if world.crossings[cell] > 0 else 0
    return 1 if said != seen.state[cell] else 0


@kernel
def turn(ray, to_crossed, to_end, world, seen):
    """Change what a ray crosses and where it ends; return by how many voxels more or fewer the
    counts say other than the scan did."""
    wrong, first, crossed = 0, seen.starts[ray], world.crossed[ray]
    for n in range(min(crossed, to_crossed), max(crossed, to_crossed)):
        cell = seen.cells[first + n]
        wrong -= changed(cell, world, seen)
        world.crossings[cell] += 1 if to_crossed > crossed else -1
        wrong += changed(cell, world, seen)
    if world.ends[ray] != to_end:
        for cell, by in ((world.ends[ray], -1), (to_end, 1)):
            if cell >= 0:
                wrong -= changed(cell, world, seen)
                world.hits[cell] += by
                wrong += changed(cell, world, seen)
    world.crossed[ray], world.ends[ray] = to_crossed, to_end
    return wrong


@kernel
def draw_pillar(number, row, prior, rng):
    """Draw the numbers of one pillar from the prior."""
    row[SECTION] = rng.random()
    row[HALF] = rng.uniform(prior[HALVES], prior[HALVES + 1])
    row[RATIO] = rng.uniform(1.0, prior[MOST_RATIO])
    row[YAW] = rng.uniform(0.0, math.pi)
    row[X], row[Y] = rng.uniform(0.0, prior[SIZE]), rng.uniform(0.0, prior[SIZE + 1])
    row[PASSAGE] = 1.0 if rng.random() < prior[SHARE] and number > 0 else 0.0
    if row[PASSAGE] > 0.0:
        row[PARENT] = float(rng.integers(0, number))
        row[ANGLE] = rng.uniform(0.0, 2 * math.pi)
        row[GAP] = rng.uniform(prior[GAPS], prior[GAPS + 1])


@kernel
def within(row, prior):
    """Whether the numbers of a pillar are within the prior's bounds."""
    place = row[PASSAGE] > 0.0 or (
        0.0 <= row[X] <= prior[SIZE] and 0.0 <= row[Y] <= prior[SIZE + 1]
    )
    gap = row[PASSAGE] == 0.0 or prior[GAPS] <= row[GAP] <= prior[GAPS + 1]
    half = prior[HALVES] <= row[HALF] <= prior[HALVES + 1]
    return place and gap and half and 1.0 <= row[RATIO] <= prior[MOST_RATIO]


@kernel
def share_of(count, prior):
    """The prior's probability of so many pillars, but for a factor: a density's share of the
    interval that rounds to the count."""
    area = prior[SIZE] * prior[SIZE + 1]
    low, high = prior[DENSITY] * area, prior[DENSITY + 1] * area
    least = -math.inf if count == 1 else count - 0.5  # fewer than one are one
    return max(min(count + 0.5, high) - max(least, low), 0.0)


@kernel
def near_ones(count, forms, position, range_m, close):
    """List the pillars that rays may reach in `close`, in place; return how many they are."""
    found = 0
    for k in range(count):
        if is_near(forms[k], position, range_m):
            close[found] = k
            found += 1
    return found


@kernel
def is_near(made, position, range_m):
    """Whether a pillar's hull is within range of the sensor, in the plan."""
    x, y, reach = made[AT_X] - position[0], made[AT_Y] - position[1], range_m + made[HULL]
    return x * x + y * y <= reach * reach


@kernel
def visible_ones(owners, most, visible):
    """List the pillars that return a ray in `visible`, in place; return how many they are."""
    returns = np.zeros(most, np.bool_)
    for owner in owners:
        if owner >= 0:
            returns[owner] = True
    found = 0
    for k in range(most):
        if returns[k]:
            visible[found] = k
            found += 1
    return found


@kernel
def try_move(move, count, numbers, prior, forms, position, visible, several, searching, rng):
    """Propose a change of `numbers`, in place; nudges and other shapes are of the `several` pillars
    that `visible` lists. One who is `searching` for a world, and not sampling, also puts pillars
    beside visible ones.

    Returns the new count, the first pillar that is changed or -1 if none can be, and the logarithm
    of the ratio by which the proposal is corrected (prior, proposal and Jacobian, without the
    scan).
    """
    n = rng.integers(0, count)
    if move in (1, 2):
        if several == 0:
            return count, -1, 0.0
        n = visible[rng.integers(0, several)]
    row = numbers[n]
    if move == 0:  # redraw
        draw_pillar(n, row, prior, rng)
        if searching and several > 0 and row[PASSAGE] == 0.0 and rng.random() < 0.5:
            beside = forms[visible[rng.integers(0, several)]]
            row[X] = beside[AT_X] + 0.5 * rng.normal()
            row[Y] = beside[AT_Y] + 0.5 * rng.normal()
        return count, n if within(row, prior) else -1, 0.0
    if move == 1:  # nudge
        scale = 10.0 ** rng.uniform(-3.0, 0.0)
        which = rng.integers(0, 4)
        if which == 0:
            if row[PASSAGE] > 0.0:
                row[GAP] += 0.2 * scale * rng.normal()
            else:
                row[X] += scale * rng.normal()
                row[Y] += scale * rng.normal()
        elif which == 1:
            row[HALF] += 0.2 * scale * rng.normal()
        elif which == 2:
            row[RATIO] += scale * rng.normal()
        else:
            # turns have no ends
            row[YAW] = (row[YAW] + scale * rng.normal()) % math.pi
            if row[PASSAGE] > 0.0:
                row[ANGLE] = (row[ANGLE] + scale * rng.normal()) % (2 * math.pi)
        return count, n if within(row, prior) else -1, 0.0
    if move == 2:  # reshape: another section or size, whose nearest point is as near to the sensor
        if row[PASSAGE] > 0.0:
            return count, -1, 0.0
        x, y = row[X] - position[0], row[Y] - position[1]
        before = math.sqrt(x * x + y * y)
        near = apart(row, forms[n], position[0], position[1])
        steep = slope(row, forms[n], position[0], position[1])
        if rng.random() < 0.5:
            scale = 10.0 ** rng.uniform(-2.0, 0.0)
            row[HALF] += 0.2 * scale * rng.normal()
            row[RATIO] += scale * rng.normal()
            if rng.random() < 0.5:
                row[YAW] = (row[YAW] + scale * rng.normal()) % math.pi
            if not within(row, prior):
                return count, -1, 0.0
        else:
            if rng.random() < 0.5:
                row[SECTION] = rng.random()
            row[HALF] = rng.uniform(prior[HALVES], prior[HALVES + 1])
            row[RATIO] = rng.uniform(1.0, prior[MOST_RATIO])
            if rng.random() < 0.5:
                row[YAW] = rng.uniform(0.0, math.pi)
        form(n, numbers, forms, prior)
        # moved along the line from the sensor until it is as near again, by Newton's method
        after, off, steeper = before, 1.0, 1.0
        for _ in range(20):
            row[X], row[Y] = position[0] + x / before * after, position[1] + y / before * after
            form(n, numbers, forms, prior)
            off = apart(row, forms[n], position[0], position[1]) - near
            steeper = slope(row, forms[n], position[0], position[1])
            if abs(off) < 1e-12 or steeper == 0.0:
                break
            after -= off / steeper
        if not abs(off) < 1e-9 or not within(row, prior) or after <= 0.0:
            return count, -1, 0.0
        # the Jacobian: of polar coordinates, and of the distance as a function of the radius
        return count, n, math.log(after / before * steep / steeper)
    if move == 3:  # one more, or one fewer
        more = rng.random() < 0.5
        after = count + 1 if more else count - 1
        if after < 1 or after > len(numbers) or share_of(after, prior) == 0.0:
            return count, -1, 0.0
        if more:
            draw_pillar(count, numbers[count], prior, rng)
        ratio = math.log(share_of(after, prior) / share_of(count, prior))
        return after, min(count, after), ratio
    if move == 4:  # exchange the numbers of two pillars that belong to no passage
        m = rng.integers(0, count)
        for k in range(count):
            if k in (n, m) and numbers[k, PASSAGE] > 0.0:
                return count, -1, 0.0
            if numbers[k, PASSAGE] > 0.0 and int(numbers[k, PARENT]) in (n, m):
                return count, -1, 0.0
        for k in range(NUMBERS):
            numbers[n, k], numbers[m, k] = numbers[m, k], numbers[n, k]
        return count, min(n, m), 0.0
    if move == 6:  # swing: a pillar of a passage stays, and those that it stands beside move
        if row[PASSAGE] == 0.0:
            return count, -1, 0.0
        x, y, root = forms[n, AT_X], forms[n, AT_Y], n
        while numbers[root, PASSAGE] > 0.0:
            root = int(numbers[root, PARENT])
        row[ANGLE] = rng.uniform(0.0, 2 * math.pi)
        row[GAP] = rng.uniform(prior[GAPS], prior[GAPS + 1])
        form(n, numbers, forms, prior)
        numbers[root, X] += x - forms[n, AT_X]
        numbers[root, Y] += y - forms[n, AT_Y]
        return count, root if within(numbers[root], prior) else -1, 0.0
    # the same place, described as a passage beside an earlier pillar, or as of its own
    if n == 0:
        return count, -1, 0.0
    least, most = prior[GAPS], prior[GAPS + 1]
    possible, other, reach, gap = 0, -1, 0.0, 0.0
    for m in range(n):
        x, y = forms[n, AT_X] - forms[m, AT_X], forms[n, AT_Y] - forms[m, AT_Y]
        off = math.sqrt(x * x + y * y)
        between = off - forms[n, HULL] - forms[m, HULL]
        if least <= between <= most:
            possible += 1
            if rng.random() * possible < 1.0:
                other, reach, gap = m, off, between
    if row[PASSAGE] > 0.0:
        other = int(row[PARENT])
        reach = forms[n, HULL] + forms[other, HULL] + row[GAP]
    if possible == 0:
        return count, -1, 0.0
    # the prior chooses one of all earlier pillars, and the proposal one of those that it may be
    area = prior[SIZE] * prior[SIZE + 1]
    odds = prior[SHARE] * area / ((1.0 - prior[SHARE]) * 2 * math.pi * (most - least) * reach)
    ratio = math.log(odds * possible / n)
    x, y = forms[n, AT_X], forms[n, AT_Y]
    if row[PASSAGE] > 0.0:
        row[X], row[Y], row[PASSAGE] = x, y, 0.0
        return count, n if within(row, prior) else -1, -ratio
    row[GAP], row[PASSAGE], row[PARENT] = gap, 1.0, float(other)
    row[ANGLE] = math.atan2(y - forms[other, AT_Y], x - forms[other, AT_X]) % (2 * math.pi)
    return count, n, ratio


@kernel
def recast(t, owner, direction, position, height, ones, count, numbers, forms):
    """Where a ray ends, and at which pillar, that ended at `t` without the first `count` of
    `ones`."""
    for n in range(count):
        k = ones[n]
        if not misses(k, forms, position, direction[0], direction[1]):
            met = range_to(numbers[k], forms[k], height, position, direction)
            if met < t:
                t, owner = met, k
    return t, owner


@kernel
def begin(count, prior, world, seen):
    """Cast all rays in a world, in place; return the count of wrong voxels."""
    numbers, forms = world.numbers, world.forms
    for k in range(count):
        form(k, numbers, forms, prior)
    wrong = 0
    for cell in range(len(seen.state)):  # before the first ray, nothing is known
        wrong += changed(cell, world, seen)
    every = np.arange(count)
    for ray in range(len(world.ranges)):
        t, owner = recast(
            math.inf, -1, seen.directions[ray], seen.position, prior[HEIGHT], every, count, numbers,
            forms,
        )  # fmt: skip
        if t <= seen.range_m:
            world.ranges[ray], world.owners[ray] = t, owner
        to_crossed, to_end = end_of(ray, world.ranges[ray], seen)
        wrong += turn(ray, to_crossed, to_end, world, seen)
    return wrong


@kernel
def walk(steps, rng, sharpness, chances, prior, count, wrong, world, seen, tried, taken):
    """Take so many steps, in place; return the count of pillars, and of wrong voxels.

    With a finite `sharpness`, a world whose scan differs in n voxels is e^(-sharpness n) as likely
    as one that looks the same.
    """
    # arrays that are read for every ray: out of a tuple, each reading would take as long again
    numbers, forms, ranges, owners = world.numbers, world.forms, world.ranges, world.owners
    position, directions, range_m = seen.position, seen.directions, seen.range_m
    rays, most = len(ranges), len(numbers)
    old_numbers, old_forms = numbers.copy(), forms.copy()
    moved = np.zeros(most, np.bool_)
    close, moving_ones = np.empty(most, np.int64), np.empty(most, np.int64)
    visible, visible_then = np.empty(most, np.int64), np.empty(most, np.int64)
    several = visible_ones(owners, most, visible)
    list_of, old_t = np.empty(rays, np.int64), np.empty(rays)
    old_owner, old_crossed = np.empty(rays, np.int64), np.empty(rays, np.int64)
    old_end = np.empty(rays, np.int64)
    for _ in range(steps):
        move = int(np.searchsorted(chances, rng.random()))
        tried[move] += 1
        after, first, ratio = try_move(
            move, count, numbers, prior, forms, position, visible, several,
            sharpness < math.inf, rng,
        )  # fmt: skip
        wanted = wrong
        done, then = 0, several
        fits = first >= 0 and math.log(rng.random()) < ratio
        threshold = math.log(rng.random())
        is_seen = False
        if fits:
            moved[:] = False
            for k in range(first, max(count, after)):
                same = k < count and k < after
                if same:
                    for j in range(NUMBERS):
                        if numbers[k, j] != old_numbers[k, j]:
                            same = False
                    if numbers[k, PASSAGE] > 0.0 and moved[int(numbers[k, PARENT])]:
                        same = False
                if same:
                    continue
                moved[k] = True
                if k < count:
                    is_seen = is_seen or is_near(old_forms[k], position, range_m)
                if k < after:
                    form(k, numbers, forms, prior)
                    is_seen = is_seen or is_near(forms[k], position, range_m)
                    if apart(numbers[k], forms[k], position[0], position[1]) < prior[CLEAR_M]:
                        fits = False
                        break
        if fits and is_seen:
            nearby = near_ones(after, forms, position, range_m, close)
            moving = 0
            for n in range(nearby):
                if moved[close[n]]:
                    moving_ones[moving] = close[n]
                    moving += 1
            for ray in range(rays):
                t, owner = ranges[ray], owners[ray]
                lost = owner >= 0 and (moved[owner] or owner >= after)
                touched = lost
                for n in range(moving):
                    dx, dy = directions[ray, 0], directions[ray, 1]
                    touched = touched or not misses(moving_ones[n], forms, position, dx, dy)
                if not touched:
                    continue
                ones, several_ones = moving_ones, moving
                if lost:
                    t, owner, ones, several_ones = math.inf, -1, close, nearby
                t, owner = recast(
                    t, owner, directions[ray], position, prior[HEIGHT], ones, several_ones, numbers,
                    forms,
                )  # fmt: skip
                if t > range_m:
                    t, owner = math.inf, -1
                if t == ranges[ray] and owner == owners[ray]:
                    continue
                to_crossed, to_end = end_of(ray, t, seen)
                # a return elsewhere than the scan's can never be made good
                if sharpness == math.inf and to_end >= 0 and seen.state[to_end] != 2:
                    fits = False
                    break
                list_of[done], old_t[done] = ray, ranges[ray]
                old_owner[done], old_end[done] = owners[ray], world.ends[ray]
                old_crossed[done] = world.crossed[ray]
                done += 1
                ranges[ray], owners[ray] = t, owner
                wanted += turn(ray, to_crossed, to_end, world, seen)
            if fits and wanted > wrong:
                fits = sharpness < math.inf and threshold < -sharpness * (wanted - wrong)
            if fits and done > 0:
                then = visible_ones(owners, most, visible_then)
                if move in (1, 2):
                    # on the way back, the pillar is chosen from those that are visible then
                    possible = (visible_then[:then] == first).any()
                    fits = possible and rng.random() * then < several
        if fits:
            for k in range(first, max(count, after)):
                if moved[k] and k < after:
                    old_numbers[k], old_forms[k] = numbers[k], forms[k]
            # pillars that only changed their description keep their form, not their numbers
            old_numbers[first], old_forms[first] = numbers[first], forms[first]
            count, wrong = after, wanted
            if done > 0:
                several = then
                visible[:then] = visible_then[:then]
            taken[move] += 1
            continue
        for n in range(done):
            ray = list_of[n]
            turn(ray, old_crossed[n], old_end[n], world, seen)
            ranges[ray], owners[ray] = old_t[n], old_owner[n]
        for k in range(max(count, after)):  # not row by row: a view costs more than its numbers
            for j in range(NUMBERS):
                numbers[k, j] = old_numbers[k, j]
            for j in range(FORM):
                forms[k, j] = old_forms[k, j]
    return count, wrong


class Chain:
    """A chain of worlds that look the same from one pose.

    Args:
        looked: What the scan made known.
        prior: See `prior_of`.
        numbers: (pillars, NUMBERS): the world that it begins with.
        seed: Of its moves: what `numpy.random.default_rng` takes.
    """

    chances = np.cumsum([0.12, 0.28, 0.4, 0.03, 0.03, 0.06, 0.08])

    def __init__(self, looked: Looked, prior: Floats, numbers: Floats, seed: Any):
        self.looked, self.prior = looked, prior
        self._rng = np.random.default_rng(seed)
        self.count = len(numbers)
        rays, voxels = len(looked.directions), len(looked.state)
        most = most_pillars(prior)
        self._world = State(
            numbers=np.zeros((most, NUMBERS)),
            forms=np.zeros((most, FORM)),
            ranges=np.full(rays, np.inf),
            owners=np.full(rays, -1),
            crossed=np.zeros(rays, np.int64),
            ends=np.full(rays, -1),
            crossings=np.zeros(voxels, np.int32),
            hits=np.zeros(voxels, np.int32),
        )
        self._world.numbers[: self.count] = numbers
        self._seen = Seen.of(looked)
        self.tried, self.taken = np.zeros((2, len(MOVES)), np.int64)
        self.wrong = begin(self.count, prior, self._world, self._seen)

    def walk(self, steps: int, sharpness: float = math.inf) -> None:
        """Take so many steps; see `walk`."""
        how = steps, self._rng, sharpness, self.chances, self.prior, self.count, self.wrong
        arguments: Any = *how, self._world, self._seen, self.tried, self.taken
        self.count, self.wrong = walk(*arguments)

    def world(self) -> tuple[Floats, Floats]:
        """The numbers and forms of the pillars now."""
        return self._world.numbers[: self.count].copy(), self._world.forms[: self.count].copy()

    def state(self) -> Any:
        """What the scan of the world now makes known, as `Looked.state`, (voxels,)."""
        return np.where(self._world.hits > 0, 2, self._world.crossings > 0).astype(np.int8)

    def clear(self) -> bool:
        """Whether all pillars keep clear of the sensor."""
        x, y = self.looked.position[:2]
        return all(
            apart(*one, x, y) >= self.prior[CLEAR_M] for one in zip(*self.world(), strict=True)
        )

    def occupancy(self) -> Mask:
        """The occupied voxels of the world now, (*grid.shape)."""
        seen = self.looked
        return rasterize(solids_of(*self.world(), self.prior[HEIGHT]), seen.grid, seen.origin)


def solids_of(numbers: Floats, forms: Floats, height_m: float) -> Solids:
    """The solids of pillars."""
    count, half = len(numbers), height_m / 2
    is_round = forms[:, SHAPE] == 0
    shape = np.where(is_round, CYLINDER, BOX)
    second = np.where(is_round, half, forms[:, LENGTH])
    size = np.stack([numbers[:, HALF], second, np.where(is_round, 0.0, half)], axis=1)
    position = np.stack([forms[:, AT_X], forms[:, AT_Y], np.full(count, half)], axis=1)
    sine, cosine = forms[:, SINE], forms[:, COSINE]
    rotation = np.tile(np.eye(3), (count, 1, 1))
    rotation[:, 0, 0], rotation[:, 0, 1] = cosine, -sine
    rotation[:, 1, 0], rotation[:, 1, 1] = sine, cosine
    rotation[is_round] = np.eye(3)
    lower, upper = bounding_boxes(shape, size, position, rotation)
    none = np.zeros(0, bool)
    return Solids(
        shape=shape, size=size, position=position, rotation=rotation, lower=lower, upper=upper,
        triangles=np.zeros((0, 3, 3)), mesh_start=np.zeros(1, np.int64), mesh_filled=none,
        geom=np.arange(count),
    )  # fmt: skip
