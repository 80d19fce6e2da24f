"""Courses of movers: motion profiles that are polynomials of time, see `lidarsim.movers`.

Courses are made of straight legs and, at the corners of loops, of parabolas: pieces of at most
second degree in time. Times of pieces are whole multiples of `TICK_S`, so that sums of them are
exact."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarsim.grid import Floats, Ints, Vector
from lidarsim.movers import CHANNELS, COEFFICIENTS
from scenegen.worlds.traffic import PERIOD_S

TICK_S = 2.0**-10
"""Resolution of the times at which pieces begin, seconds."""
PERIOD_TICKS = round(PERIOD_S / TICK_S)
LEAST_TURN = 8
"""Ticks of a turn, at least: coefficients of shorter ones may exceed what tables hold. Even."""

Pair = tuple[float, float]
"""x and y."""
Polynomial = tuple[float, float, float, float]
"""COEFFICIENTS of a polynomial."""
STILL = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class MoverCourse:
    """One mover's course over a period."""

    begin_s: Floats
    """(P,)."""
    pieces: Floats
    """(P, CHANNELS, COEFFICIENTS)."""
    round_s: float = PERIOD_S
    """How long it takes to go once; then it goes the same way again, or stands, seconds."""

    @cached_property
    def table(self) -> tuple[float, Ints, Floats, Floats]:
        """The course as `lidarsim.movers.find_piece` takes it, mover 0 of 1. It does not repeat."""
        return math.inf, np.array([0, len(self.begin_s)]), self.begin_s, self.pieces

    def begun_at(self, ticks: int) -> "MoverCourse":
        """Return the course that begins later in the period; what it leaves out comes at the end.

        Args:
            ticks: When it begins, in ticks of the period, which has `PERIOD_TICKS`.
        """
        time_s = ticks * TICK_S
        # the piece that is under way is divided: its end comes first, its beginning last
        first = int(np.searchsorted(self.begin_s, time_s, side="right")) - 1
        begin_s = np.append(self.begin_s[first:], self.begin_s[: first + 1] + PERIOD_S) - time_s
        pieces = np.concatenate([self.pieces[first:], self.pieces[: first + 1]])
        pieces[0], begin_s[0] = _after(pieces[0], -begin_s[0]), 0.0
        # nothing is left of a piece that begins at this time
        lasting = begin_s < PERIOD_S
        return MoverCourse(begin_s[lasting], pieces[lasting], self.round_s)

    @cached_property
    def fastest_mps(self) -> float:
        """Greatest speed, metres a second."""
        lengths = np.diff(np.append(self.begin_s, PERIOD_S))[:, None]
        linear, square = self.pieces[:, :3, 1], self.pieces[:, :3, 2]
        # at the begin or end of a piece; between, none is faster
        speeds = np.stack([linear, linear + 2.0 * lengths * square])
        return math.sqrt((speeds * speeds).sum(axis=-1).max())


def _after(piece: Floats, seconds: float) -> Floats:
    """Return a piece's polynomials (CHANNELS, COEFFICIENTS) of the time since some seconds after
    its beginning."""
    start, linear, square, cube = piece.T
    steeper = square + 3.0 * seconds * cube
    return np.column_stack(
        [
            start + seconds * (linear + seconds * (square + seconds * cube)),
            linear + seconds * (square + steeper),
            steeper,
            cube,
        ]
    )


class _Writer:
    """Writes a course piece by piece, each for a whole number of ticks.

    In plain numbers: arrays of three take ten times as long."""

    def __init__(self) -> None:
        self.ticks, self.begins, self.channels = 0, list[int](), list[Polynomial]()

    def add(
        self,
        ticks: int,
        place: Vector,
        heading: Pair | tuple[Polynomial, Polynomial],
        velocity: Vector = STILL,
        half: Vector = STILL,
    ) -> None:
        """Add a piece.

        Args:
            ticks: How long it lasts; nothing is added for 0.
            place: Where it begins, metres.
            heading: x and y if constant, or their polynomials.
            velocity: When it begins, metres a second.
            half: Half of the acceleration, m/s².
        """
        if ticks == 0:
            return
        self.begins.append(self.ticks)
        self.channels += [(x, u, a, 0.0) for x, u, a in zip(place, velocity, half, strict=True)]
        # a product, for the sign of zero
        for c in heading:
            self.channels.append(c if isinstance(c, tuple) else (c, c * 0.0, c * 0.0, c * 0.0))
        self.ticks += ticks

    def course(self) -> MoverCourse:
        """The course so far."""
        pieces = np.array(self.channels).reshape(-1, CHANNELS, COEFFICIENTS)
        return MoverCourse(np.array(self.begins) * TICK_S, pieces)


def _ticks(seconds: float) -> int:
    """Seconds as a whole number of ticks, rounded up: slower, never faster than asked."""
    return max(math.ceil(seconds / TICK_S), 1)


def _moved(place: Vector, velocity: Vector, seconds: float) -> Vector:
    (x, y, z), (u, v, w) = place, velocity
    return x + u * seconds, y + v * seconds, z + w * seconds


def _smooth(start: Pair, chord: Pair, seconds: float) -> tuple[Polynomial, Polynomial]:
    """Polynomials of a heading that runs along a chord by 3 s² - 2 s³."""
    square, cube = 3.0 / (seconds * seconds), -2.0 / (seconds * seconds * seconds)
    (x, y), (u, v) = start, chord
    return (x, u * 0.0, u * square, u * cube), (y, v * 0.0, v * square, v * cube)


def _turn(writer: _Writer, place: Vector, start: Pair, end: Pair, rate: float) -> None:
    """Turn on the spot from one heading to another, in parts of a right angle at most.

    The heading runs along the chord between two unit vectors."""
    if _dot(start, end) < -1e-9:
        # by way of the left, so that no part exceeds a right angle
        middle = -start[1], start[0]
        if _dot(middle, end) < 0:
            middle = start[1], -start[0]
        _turn(writer, place, start, middle, rate)
        start = middle
    chord = end[0] - start[0], end[1] - start[1]
    length = math.sqrt(_dot(chord, chord))
    if length < 1e-9:
        return
    # an arc is at most π/(2√2) = 1.12 times as long as its chord
    ticks = max(_ticks(1.12 * length / rate), LEAST_TURN)
    writer.add(ticks, place, _smooth(start, chord, ticks * TICK_S))


def _unit(x: float, y: float) -> Pair:
    length = math.sqrt(x * x + y * y)
    return x / length, y / length


def _dot(first: Pair, second: Pair) -> float:
    return first[0] * second[0] + first[1] * second[1]


def from_stop_to_stop(
    points: Floats,
    speed: float,
    acceleration: float,
    rate: float,
    waits_s: Sequence[float],
    *,
    backs_up: bool = False,
) -> MoverCourse | None:
    """Make a course that stops, waits and turns at every point, and repeats.

    Args:
        points: (n, 3): corners of a closed tour at one height, metres.
        speed: Greatest speed, metres a second.
        acceleration: Greatest acceleration, m/s².
        rate: See `Traffic.turn_rad_s`.
        waits_s: (n,): how long it stands at each point, seconds.
        backs_up: Whether it goes backwards instead of turning by more than a right angle.

    Returns:
        The course; None if the tour takes longer than `PERIOD_S`.
    """
    places: list[Vector] = points.tolist()
    legs: list[Vector] = [
        (b[0] - a[0], b[1] - a[1], b[2] - a[2])
        for a, b in zip(places, [*places[1:], places[0]], strict=True)
    ]
    lengths = [math.sqrt(x * x + y * y + z * z) for x, y, z in legs]
    headings = [
        _unit(leg[0] / length, leg[1] / length) for leg, length in zip(legs, lengths, strict=True)
    ]
    for n in range(1, len(points) if backs_up else 0):
        if _dot(headings[n], headings[n - 1]) < 0:
            headings[n] = -headings[n][0], -headings[n][1]
    writer = _Writer()
    for n, (leg, length) in enumerate(zip(legs, lengths, strict=True)):
        # at the first point, it looks as it arrives from the last: tours close
        writer.add(_ticks(waits_s[n]), places[n], headings[n - 1])
        _turn(writer, places[n], headings[n - 1], headings[n], rate)
        # rising and falling speed, with constant speed between them where the leg is long enough
        peak = min(speed, math.sqrt(acceleration * length))
        rise = _ticks(peak / acceleration)
        cruise = max(math.ceil((length / peak - rise * TICK_S) / TICK_S), 0)
        rise_s, cruise_s = rise * TICK_S, cruise * TICK_S
        # a little slower than asked, so that a leg of whole ticks ends at its end
        u, v, w = (way / (rise_s + cruise_s) for way in leg)
        half = u / (2 * rise_s), v / (2 * rise_s), w / (2 * rise_s)
        begun = _moved(places[n], (u, v, w), rise_s / 2)
        writer.add(rise, places[n], headings[n], half=half)
        writer.add(cruise, begun, headings[n], (u, v, w))
        slowing = _moved(begun, (u, v, w), cruise_s)
        writer.add(rise, slowing, headings[n], (u, v, w), (-half[0], -half[1], -half[2]))
    return _repeated(writer, places[0], headings[-1])


def without_stop(
    points: Floats, speed: float, acceleration: float, rate: float
) -> MoverCourse | None:
    """Make a course round a loop at nearly constant speed, whose corners are parabolas.

    Args:
        points: (n, 3): corners of the loop at one height, metres.
        speed: Greatest speed, metres a second.
        acceleration: Greatest acceleration, m/s².
        rate: See `Traffic.turn_rad_s`.

    Returns:
        The course; None if no whole number of rounds takes `PERIOD_S`, or corners are too sharp.
    """
    legs = np.roll(points, -1, axis=0) - points
    lengths = np.sqrt((legs * legs).sum(axis=1))
    rounds = math.floor(PERIOD_S * speed / lengths.sum())
    if rounds < 1:
        return None
    # only powers of two divide the period into whole ticks
    rounds = 2 ** math.floor(math.log2(rounds))
    total = round(PERIOD_S / rounds / TICK_S)
    ticks = np.floor(lengths / lengths.sum() * total).astype(int)
    # the last leg takes up the rounding of all: a round fits into the period exactly
    ticks[-1] = total - ticks[:-1].sum()
    velocity = legs / (ticks * TICK_S)[:, None]
    change = velocity - np.roll(velocity, 1, axis=0)
    headings = velocity[:, :2] / np.sqrt((velocity[:, :2] ** 2).sum(axis=1))[:, None]
    chord = headings - np.roll(headings, 1, axis=0)
    # time to change the velocity, and to turn: see `_turn`
    seconds = np.maximum(
        np.sqrt((change * change).sum(axis=1)) / acceleration,
        1.12 * np.sqrt((chord * chord).sum(axis=1)) / rate,
    )
    # even, so that half of a corner is a whole number of ticks
    corner = 2 * np.ceil(seconds / TICK_S / 2).astype(int)
    corner = np.maximum(corner, LEAST_TURN)
    if (corner / 2 + np.roll(corner, -1) / 2 > ticks).any():
        return None
    # a corner of more than a right angle would need two pieces
    if ((headings * np.roll(headings, 1, axis=0)).sum(axis=1) < 0).any():
        return None
    writer = _Writer()
    places, speeds = points.tolist(), velocity.tolist()
    for n, place in enumerate(places):
        half, after = int(corner[n]) // 2, int(corner[(n + 1) % len(places)]) // 2
        # from the middle of the corner before to the middle of this leg's end
        lasting = 2 * half * TICK_S
        first = _moved(place, speeds[n - 1], -half * TICK_S)
        turn = _smooth(headings[n - 1].tolist(), chord[n].tolist(), lasting)
        change_by = (change[n] / (2.0 * lasting)).tolist()
        writer.add(2 * half, first, turn, speeds[n - 1], change_by)
        straight = int(ticks[n]) - half - after
        begun = _moved(place, speeds[n], half * TICK_S)
        writer.add(straight, begun, headings[n].tolist(), speeds[n])
    return _repeated(writer, places[0], headings[-1].tolist())


def _repeated(writer: _Writer, place: Vector, heading: Pair) -> MoverCourse | None:
    """Repeat a tour while it fits into the period, and stand for the rest of it."""
    if writer.ticks > PERIOD_TICKS:
        return None
    # tables hold no rounds: pieces are written again for each
    rounds, tour, still = PERIOD_TICKS // writer.ticks, writer.course(), _Writer()
    still.add(PERIOD_TICKS - rounds * writer.ticks, place, heading)
    parts, round_s = [*[tour] * rounds, still.course()], writer.ticks * TICK_S
    begin_s = np.concatenate([part.begin_s + n * round_s for n, part in enumerate(parts)])
    return MoverCourse(begin_s, np.concatenate([part.pieces for part in parts]), round_s)
