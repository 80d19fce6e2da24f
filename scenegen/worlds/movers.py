"""Movers of a world: drawn, certified not to pass through solids or each other, and written into
the world's document and read from it."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.random import Generator

from lidarsim.engines import Caster
from lidarsim.grid import Floats
from lidarsim.jit import kernel
from lidarsim.movers import CHANNELS, COEFFICIENTS, Movers, find_piece
from lidarsim.parameters import MAX_LENGTH_M
from lidarsim.solids import BOX, CAPSULE, ELLIPSOID, Solids
from scenegen.worlds.clearance import Clearance, heading_lengths
from scenegen.worlds.courses import PERIOD_TICKS, MoverCourse, from_stop_to_stop, without_stop
from scenegen.worlds.traffic import KINDS, MAX_MOVERS, MAX_SOLIDS, PERIOD_S, Traffic

GAP_M = 0.05
"""How far movers stay from solids and each other, at least, metres."""
TRIES, FEW_TRIES = 60, 15
"""Courses that are tried for one mover before the world is given up, or the mover."""
STARTS = 4
"""Places of which the first with room is where a tour begins."""
ENDS = 12
"""Ends of a leg of which the first that can be reached is taken."""
LEGS = 8
"""Most legs of a course."""
LEAST_LEG_M, MOST_LEG_M = 1.5, 15.0
STEP_DOWN_M = 0.4
"""Most air below a mover that walks or drives, beside what its balls need, metres."""
REACH_M = 50.0
"""How far below a place the ground is looked for, metres."""
SHARES = np.linspace(0.0, 1.0, 12, endpoint=False)[:, None, None]
"""Places of a leg where the ground is looked for, as shares of its length."""
LEAST_HEADING = 0.1
"""Least length of a heading before it is scaled to 1; a turn by a right angle has .7."""
TEXT = "movers"
"""Name of the document's <text> that holds movers."""


@dataclass(frozen=True)
class Body:
    """The solids of a mover, and balls that cover them, in its frame: x ahead, z up from the
    ground, metres."""

    kind: str
    shape: tuple[int, ...]
    size: Floats
    """(S, 3): MuJoCo's sizes."""
    offset: Floats
    """(S, 3): centres."""

    @cached_property
    def balls(self) -> Floats:
        """Balls (B, 4), centre and radius, that hold every point of the solids."""
        parts = []
        for shape, size, centre, half in zip(
            self.shape, self.size, self.offset, self._half, strict=True
        ):
            # balls about cells of a box reach far below a capsule: people would float
            if shape == CAPSULE:
                parts.append(_along_axis(size[0], size[1], centre))
            else:
                parts.append(_covered(centre - half, centre + half))
        return np.concatenate(parts)

    @cached_property
    def ball(self) -> tuple[float, float]:
        """Height of the centre and radius of a ball, centred above the origin, that holds all."""
        half = self._half
        low, high = (self.offset - half)[:, 2].min(), (self.offset + half)[:, 2].max()
        # on the axis of turns: two movers then are kept apart by their places alone
        middle = float(low + high) / 2
        corners = np.abs(self.offset - (0.0, 0.0, middle)) + half
        return middle, float(np.sqrt((corners * corners).sum(axis=1)).max())

    @cached_property
    def clearance_radius_m(self) -> float:
        """Radius of a ball that fits where the body does, when it moves ahead, metres."""
        # below `CAP_M`, which no distance exceeds; the certificate looks at all of a wider body
        return min(float((np.abs(self.balls[:, 1]) + self.balls[:, 3]).max()) + GAP_M, 0.99)

    @cached_property
    def sink(self) -> float:
        """How far balls that cover the lowest solids reach below the origin, metres."""
        return max(0.0, -float((self.balls[:, 2] - self.balls[:, 3]).min()))

    @cached_property
    def _half(self) -> Floats:
        """Half edges (S, 3) of boxes around the solids."""
        half = self.size.copy()
        capsules = np.array(self.shape) == CAPSULE
        half[capsules] = np.stack(
            [self.size[:, 0], self.size[:, 0], self.size[:, :2].sum(axis=1)], 1
        )[capsules]
        return half


def _along_axis(radius: float, half: float, centre: Floats) -> Floats:
    """Balls (B, 4) on the axis of an upright capsule that cover it."""
    count = max(math.ceil(2.0 * half / radius), 1) + 1
    heights = np.linspace(-half, half, count)
    # halfway between two centres, the capsule's side is as far from its axis as anywhere
    gap = half / (count - 1)
    reach = math.sqrt(radius * radius + gap * gap)
    return np.column_stack(
        [np.tile(centre, (count, 1)) + heights[:, None] * (0, 0, 1), np.full(count, reach)]
    )


def _covered(low: Floats, high: Floats) -> Floats:
    """Balls (B, 4) about the cells of a box that cover it."""
    # half a metre keeps radii below `CAP_M`, as the certificate needs
    cells = np.maximum(np.ceil((high - low) / 0.5), 1).astype(int)
    edge = (high - low) / cells
    index = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 3)
    radius = math.sqrt(float(edge @ edge)) / 2
    return np.column_stack([low + (index + 0.5) * edge, np.full(len(index), radius)])


def person(rng: Generator) -> Body:
    """Draw a person: one upright capsule.

    Stature and shoulder breadth span the 5th percentile of women to the 95th of men (DIN 33402-2).
    """
    height, radius = rng.uniform(1.53, 1.86), rng.uniform(0.19, 0.26)
    half = height / 2 - radius
    return Body(
        "person", (CAPSULE,), np.array([[radius, half, 0.0]]), np.array([[0, 0, height / 2]])
    )


def vehicle(rng: Generator) -> Body:
    """Draw a vehicle: a box with a cabin, of the sizes of passenger cars (as the cars of `street`),
    and as high above the ground."""
    long, wide, high = rng.uniform((3.8, 1.65, 1.4), (4.8, 1.9, 1.9)).tolist()
    base, body, shift = 0.22, 0.55 * high, rng.uniform(-0.3, 0.3)
    size = [[long / 2, wide / 2, (body - base) / 2], [0.27 * long, 0.45 * wide, (high - body) / 2]]
    offset = [[0, 0, (base + body) / 2], [shift, 0, (body + high) / 2]]
    return Body("vehicle", (BOX, BOX), np.array(size), np.array(offset))


def drone(rng: Generator) -> Body:
    """Draw a drone: a flat ellipsoid, 0.3 to 0.9 m across with its rotors."""
    radius = rng.uniform(0.15, 0.45)
    size = np.array([[radius, radius, 0.3 * radius]])
    return Body("drone", (ELLIPSOID,), size, np.zeros((1, 3)))


SHAPES = (BOX, CAPSULE, ELLIPSOID)
BODIES: dict[str, Callable[[Generator], Body]] = {
    "person": person,
    "vehicle": vehicle,
    "drone": drone,
}


Zones = dict[str, list[Floats]]
"""Boxes (2, 3), metres, in which the courses of each kind of mover have their corners."""


def draw_movers(
    solids: Solids, caster: Caster, zones: Zones, traffic: Traffic, *, rng: Generator
) -> Movers | None:
    """Draw the movers of a world.

    A course is accepted if balls that cover the mover stay `GAP_M` from every solid at all times,
    and balls around movers from each other. So some courses that are free are rejected, too.

    Args:
        solids: What stands in the world.
        caster: Casts rays at it, which find the ground.
        zones: Where movers belong; a kind without zones has no movers.
        traffic: How many there are, and how they move.
        rng: Decides everything that is random.

    Returns:
        The movers; None if the least number of a kind finds no room.
    """
    boxes = [box for of_kind in zones.values() for box in of_kind]
    around = np.stack(
        [np.min(boxes, axis=0)[0] - MOST_LEG_M, np.max(boxes, axis=0)[1] + MOST_LEG_M]
    )
    clearance = Clearance(solids, around)
    accepted: list[tuple[Body, MoverCourse]] = []
    # the largest first: they find room last
    for kind in sorted(KINDS, key=lambda name: name != "vehicle"):
        low, high = traffic.counts(kind) if zones.get(kind) else (0, 0)
        wanted = int(rng.integers(low, high + 1))
        for number in range(wanted):
            # the world is not given up for those beyond the least number
            tries = TRIES if number < low else FEW_TRIES
            found = _draw_mover(
                kind, clearance, caster, zones[kind], traffic, accepted, tries, rng=rng
            )
            if found is None and number < low:
                return None
            if found is None:
                break
            accepted.append(found)
    return _joined(accepted)


def _draw_mover(
    kind: str,
    clearance: Clearance,
    caster: Caster,
    zones: Sequence[Floats],
    traffic: Traffic,
    accepted: Sequence[tuple[Body, MoverCourse]],
    tries: int,
    *,
    rng: Generator,
) -> tuple[Body, MoverCourse] | None:
    """Draw a body, and courses until one is accepted; None after `tries`."""
    body = BODIES[kind](rng)
    for _ in range(tries):
        tour = _Tour(body, clearance, caster, zones[int(rng.integers(len(zones)))], rng)
        course = tour.course(traffic)
        if course is None:
            continue
        # one round says all: the others go the same way
        once = course.begin_s < course.round_s
        alone = clearance.course_is_free(
            course.begin_s[once], course.pieces[once], course.round_s, body.balls, GAP_M
        )
        if not alone:
            continue
        # tours begin at rest: without this, all movers of a world would stand at the same time
        course = course.begun_at(int(rng.integers(PERIOD_TICKS)))
        if all(_stay_apart((body, course), other) for other in accepted):
            return body, course
    return None


@dataclass
class _Tour:
    """Draws the corners of a tour of one mover."""

    body: Body
    clearance: Clearance
    caster: Caster
    zone: Floats
    rng: Generator

    def course(self, traffic: Traffic) -> MoverCourse | None:
        """Draw a course; None if no leg is free."""
        kind = self.body.kind
        speed = float(self.rng.uniform(*getattr(traffic, f"{kind}_mps")))
        acceleration = getattr(traffic, f"{kind}_mps2")
        behaviour = BEHAVIOURS[int(self.rng.integers(len(BEHAVIOURS)))]
        points = behaviour(self)
        # else people would walk on in the air beyond a wall or a roof
        if points is None or (kind != "drone" and self._leaves_the_ground(points)):
            return None
        if behaviour is _Tour.loop:
            return without_stop(points, speed, acceleration, traffic.turn_rad_s)
        # who stops and goes waits; others turn at once
        most_s = 4.0 if behaviour is _Tour.stops else 0.5
        waits = self.rng.uniform(0.0, most_s, len(points)).tolist()
        # a car needs more room to turn than a road has
        backs_up, rate = kind == "vehicle", traffic.turn_rad_s
        return from_stop_to_stop(points, speed, acceleration, rate, waits, backs_up=backs_up)

    def line(self) -> Floats | None:
        """Along a line and back."""
        start = self._start()
        end = self._leg_from(start)
        return None if end is None else np.array([start, end])

    def stops(self) -> Floats | None:
        """Along a line and back, with stops on the way."""
        ends = self.line()
        if ends is None:
            return None
        shares = np.linspace(0.0, 1.0, int(self.rng.integers(3, 5)))[:, None]
        there = ends[0] + shares * (ends[1] - ends[0])
        # the way back, without the two ends, where it would stop twice
        return np.concatenate([there, there[-2:0:-1]])

    def wander(self) -> Floats | None:
        """Through random places, and back the same way."""
        points = [self._start()]
        # half of the legs: the way back takes as many
        for _ in range(int(self.rng.integers(2, LEGS // 2 + 1))):
            if (next_point := self._leg_from(points[-1])) is None:
                break
            points.append(next_point)
        return np.array(points + points[-2:0:-1]) if len(points) > 1 else None

    def loop(self) -> Floats | None:
        """Round a regular polygon."""
        # a triangle turns by more than a right angle, which `without_stop` refuses
        corners, radius = int(self.rng.integers(4, 9)), self.rng.uniform(2.0, 8.0)
        # a direction without sines, whose last bits depend on the library
        x, y = self.rng.uniform(-1.0, 1.0, 2).tolist()
        length = math.sqrt(x * x + y * y) or 1.0
        spoke, points = np.array([x, y]) / length * radius, list[Floats]()
        cosine, sine = TURNS[corners]
        middle = self._start()
        for _ in range(corners):
            points.append(middle + np.append(spoke, 0.0))
            spoke = np.array(
                [cosine * spoke[0] - sine * spoke[1], sine * spoke[0] + cosine * spoke[1]]
            )
        corners_of_loop = np.array(points)
        inside = (corners_of_loop[:, :2] >= self.zone[0, :2]) & (
            corners_of_loop[:, :2] <= self.zone[1, :2]
        )
        return self._on_ground(corners_of_loop) if inside.all() else None

    def _start(self) -> Floats:
        """A random place of the zone, if possible with room for the mover; of a mover on the
        ground, above the ground there."""
        low, high = self.zone
        # quicker than `uniform` with bounds that are arrays
        places = low + (high - low) * self.rng.random((STARTS, 3))
        if self.body.kind != "drone":
            places = self._above_ground(places)
        for start in places:
            x, y, z = start.tolist()
            # a first look saves tries; it is the certificate that decides
            if self.clearance.at(x, y, z + self.body.ball[0]) > self.body.clearance_radius_m:
                break
        return np.asarray(start)

    def _on_ground(self, points: Floats) -> Floats:
        """Set places (n, 3) of a mover on the ground to one height, above the highest ground below
        them; drones stay where they are."""
        if self.body.kind == "drone":
            return points
        above = self._above_ground(points)
        return np.column_stack([points[:, :2], np.full(len(points), above[:, 2].max())])

    def _leaves_the_ground(self, points: Floats) -> bool:
        """Whether the ground falls by more than `STEP_DOWN_M` below some place of a tour (n, 3)."""
        along = points + SHARES * (np.concatenate([points[1:], points[:1]]) - points)
        places = along.reshape(-1, 3)
        return bool((places[:, 2] - self._above_ground(places)[:, 2] > STEP_DOWN_M).any())

    def _above_ground(self, points: Floats) -> Floats:
        """Set each of some places (n, 3) to a height above the ground below it."""
        down = np.zeros((len(points), 1, 3))
        down[:, 0, 2] = -1.0
        result = points.copy()
        # from the zone's upper side: what is above it, such as a ceiling, is no ground
        top = result[:, 2] = self.zone[1, 2]
        depth = self.caster.cast(result, down, REACH_M)[:, 0]
        # kinds without ground have it at z = 0
        ground = np.where(np.isfinite(depth), top - depth, 0.0)
        # a fifth more: in finite steps, a gap of exactly `GAP_M` cannot be told from a smaller one
        result[:, 2] = ground + (self.body.sink + 1.2 * GAP_M)
        return result

    def _leg_from(self, start: Floats) -> Floats | None:
        """Draw the end of a free straight leg, or None."""
        (low_x, low_y), (high_x, high_y) = self.zone[:, :2].tolist()
        extent_x, extent_y = min(high_x - low_x, MOST_LEG_M), min(high_y - low_y, MOST_LEG_M)
        longest = max(extent_x, extent_y, LEAST_LEG_M)
        x, y, z = start.tolist()
        middle = x, y, z + self.body.ball[0]
        for u, v, w in self.rng.random((ENDS, 3)).tolist():
            # narrow zones are long: legs run along them
            way_x, way_y = (2.0 * u - 1.0) * extent_x, (2.0 * v - 1.0) * extent_y
            length = LEAST_LEG_M + (longest - LEAST_LEG_M) * w
            share = length / (math.sqrt(way_x * way_x + way_y * way_y) or 1.0)
            end = x + way_x * share, y + way_y * share, middle[2]
            inside = low_x <= end[0] <= high_x and low_y <= end[1] <= high_y
            if inside and self.clearance.motion_is_free(middle, end, self.body.clearance_radius_m):
                return np.array([end[0], end[1], z])
        return None


BEHAVIOURS = (_Tour.line, _Tour.stops, _Tour.wander, _Tour.loop)
# written out: the last bits of a library's sines depend on the machine
TURNS = {
    4: (0.0, 1.0),
    5: (0.30901699437494745, 0.9510565162951535),
    6: (0.5, 0.8660254037844386),
    7: (0.6234898018587336, 0.7818314824680298),
    8: (0.7071067811865476, 0.7071067811865475),
}
"""Cosine and sine of the angle between corners of regular polygons."""


def _stay_apart(first: tuple[Body, MoverCourse], second: tuple[Body, MoverCourse]) -> bool:
    """Whether balls around two movers stay `GAP_M` apart for a period."""
    heights = first[0].ball[0], second[0].ball[0]
    near = GAP_M + first[0].ball[1] + second[0].ball[1]
    # two that stand all the time would divide by 0
    speed = max(first[1].fastest_mps, 1e-6) + max(second[1].fastest_mps, 1e-6)
    # endless courses: both are looked at within one period
    return bool(_are_apart(first[1].table, second[1].table, PERIOD_S, heights, near, speed))


@kernel
def _are_apart(first, second, end, heights, near, speed):
    """Walk in steps that the two cannot use up; a gap below a millimetre counts as none."""
    time = 0.0
    while time < end:
        _, _, x, y, z = find_piece(0, time, first)
        _, _, u, v, w = find_piece(0, time, second)
        dx, dy, dz = u - x, v - y, w + heights[1] - z - heights[0]
        gap = math.sqrt(dx * dx + dy * dy + dz * dz) - near
        if gap < 1e-3:
            return False
        time += gap / speed
    return True


def _joined(movers: Sequence[tuple[Body, MoverCourse]]) -> Movers:
    """Join bodies and courses."""
    bodies, courses = [body for body, _ in movers], [course for _, course in movers]
    owner = [m for m, body in enumerate(bodies) for _ in body.shape]
    counts = [len(course.begin_s) for course in courses]
    return Movers(
        kind=np.array([1 + KINDS.index(body.kind) for body in bodies], np.int64),
        owner=np.array(owner, np.int64),
        shape=np.array([shape for body in bodies for shape in body.shape], np.int64),
        # an empty array first: NumPy joins no empty list, and a world may have no movers
        size=np.concatenate([np.empty((0, 3)), *(body.size for body in bodies)]),
        offset=np.concatenate([np.empty((0, 3)), *(body.offset for body in bodies)]),
        piece_start=np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64),
        begin_s=np.concatenate([np.empty(0), *(course.begin_s for course in courses)]),
        course=np.concatenate(
            [np.empty((0, CHANNELS, COEFFICIENTS)), *(course.pieces for course in courses)]
        ),
        period_s=PERIOD_S,
    )


def with_text(mjcf: bytes, movers: Movers) -> bytes:
    """Write movers into a document, as the text `TEXT` of its custom elements.

    Args:
        mjcf: The document, UTF-8.
        movers: The movers.

    Returns:
        The document, whose solids are the same.
    """
    # a text, not geoms: so the model, flights, truth and labels stay those of what stands
    text = f'{{"period_s":{movers.period_s},"movers":{encoded(movers)}}}'
    # single quotes around it: JSON is full of double ones
    element = f"<custom><text name=\"{TEXT}\" data='{text}'/></custom>\n</mujoco>"
    before, _, after = mjcf.rpartition(b"</mujoco>")
    return before + element.encode() + after


def encoded(movers: Movers) -> str:
    """Write movers as JSON.

    Args:
        movers: The movers.

    Returns:
        A list with an object for each: its `kind`; its `solids` (n, 7): MuJoCo's code of the shape,
        three sizes, and the centre in the mover's frame, metres; `begin_s` (P,) of the pieces of
        its course; and their `course` (P, CHANNELS * COEFFICIENTS).
    """
    entries = []
    for m, kind in enumerate(movers.kind.tolist()):
        own, (first, last) = movers.owner == m, movers.piece_start[m : m + 2].tolist()
        solids = np.column_stack([movers.shape[own], movers.size[own], movers.offset[own]])
        begin_s = movers.begin_s[first:last]
        course = movers.course[first:last].reshape(last - first, -1)
        entries.append(
            f'{{"kind":"{KINDS[kind - 1]}","solids":{_table(solids)},"begin_s":{_list(begin_s)},'
            f'"course":{_table(course)}}}'
        )
    return f"[{','.join(entries)}]"


def _table(rows: Floats) -> str:
    """Write a table in JSON; equal rows, as rounds have, only once."""
    texts = dict[bytes, str]()
    for row in rows:
        # by bytes, since -0.0 equals 0.0 but is written in another way
        key = row.tobytes()
        if key not in texts:
            texts[key] = _list(row)
    return f"[{','.join([texts[row.tobytes()] for row in rows])}]"


def _list(values: Floats) -> str:
    """Write finite numbers in JSON, quicker than `json`."""
    # Python writes the shortest digits that are read back as the same bits
    return str(values.tolist()).replace(" ", "")


def read_text(text: str) -> Movers:
    """Read movers from a document's text.

    Args:
        text: As `with_text` writes it.

    Returns:
        The movers.

    Raises:
        ValueError: If it is something else.
    """
    try:
        table = json.loads(text)
        entries, period_s = table["movers"], float(table["period_s"])
        movers = _joined([_read_entry(entry) for entry in entries])
    # a stranger's text may be any JSON, nested however deep
    except (KeyError, OverflowError, TypeError, ValueError, RecursionError):
        raise ValueError(
            f"<text name={TEXT!r}>: is no table of movers; generate the dataset anew"
        ) from None
    fault = fault_of(movers)
    if period_s != PERIOD_S or fault:
        raise ValueError(f"<text name={TEXT!r}>: {fault or f'period_s is not {PERIOD_S:g}'}")
    return movers


def _read_entry(entry: Any) -> tuple[Body, MoverCourse]:
    solids = np.array(entry["solids"], float).reshape(-1, 7)
    begin_s = np.array(entry["begin_s"], float).reshape(-1)
    pieces = np.array(entry["course"], float).reshape(len(begin_s), CHANNELS, COEFFICIENTS)
    shapes = tuple(int(shape) for shape in solids[:, 0])
    return Body(entry["kind"], shapes, solids[:, 1:4], solids[:, 4:]), MoverCourse(begin_s, pieces)


def fault_of(movers: Movers) -> str:
    """Tell what keeps kernels from using a table of movers that somebody else wrote.

    Returns:
        What was expected; "" if nothing is wrong.
    """
    numbers = (movers.size, movers.offset, movers.begin_s, movers.course)
    # False for NaN, too
    finite = all((np.abs(values) <= MAX_LENGTH_M).all() for values in numbers)
    if len(movers) > MAX_MOVERS or not finite:
        return f"expected {MAX_MOVERS} movers at most, and finite numbers up to {MAX_LENGTH_M:g}"
    solids = np.bincount(movers.owner, minlength=len(movers))
    pieces = np.diff(movers.piece_start)
    # a capsule has two sizes, the other shapes three
    sized = (movers.size > 0) | ((movers.shape == CAPSULE)[:, None] & (np.arange(3) == 2))
    shapes = np.isin(movers.shape, SHAPES).all() and sized.all()
    if not shapes or (solids < 1).any() or (solids > MAX_SOLIDS).any() or (pieces < 1).any():
        return f"expected 1 to {MAX_SOLIDS} boxes, capsules or ellipsoids and a course for each"
    if not np.isin(movers.kind, np.arange(1, len(KINDS) + 1)).all():
        return f"expected kinds from 1 to {len(KINDS)}"
    # the piece after each; after a mover's last one comes its first, a period later
    first, last = movers.piece_start[:-1], movers.piece_start[1:] - 1
    following = np.arange(1, len(movers.begin_s) + 1)
    following[last] = first
    lasting = movers.begin_s[following] - movers.begin_s
    lasting[last] += movers.period_s
    repeats = math.isfinite(movers.period_s)
    if not (lasting > 0).all() or (repeats and movers.begin_s[first].any()):
        return "expected pieces that rise, where they repeat from 0 on to the end of the period"
    # kernels look for the greatest speed at the ends of a piece: right up to the second degree
    if movers.course[:, :3, 3].any() or not (heading_lengths(movers) >= LEAST_HEADING).all():
        return f"expected places of second degree, and headings of a length of {LEAST_HEADING:g}"
    ends = lasting < math.inf
    start, linear, square, cube = np.moveaxis(movers.course[ends], 2, 0)
    time_s, begin = lasting[ends, None], movers.course[following[ends], :, 0]
    if (np.abs(start + time_s * (linear + time_s * (square + time_s * cube)) - begin) > 1e-6).any():
        return "expected courses without jumps"
    return ""
