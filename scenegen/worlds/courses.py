"""Courses of movers: motion profiles that are polynomials of time, see `lidarsim.movers`.

Courses are made of straight legs and, at the corners of loops, of parabolas: pieces of at most
second degree in time. Times of pieces are whole multiples of `TICK_S`, so that sums of them are
exact."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarsim.grid import Floats
from lidarsim.movers import CHANNELS, COEFFICIENTS
from scenegen.worlds.traffic import PERIOD_S

TICK_S = 2.0**-10
"""Resolution of the times at which pieces begin, seconds."""


@dataclass(frozen=True)
class Course:
    """One mover's course over a period."""

    begin_s: Floats
    """(P,)."""
    pieces: Floats
    """(P, CHANNELS, COEFFICIENTS)."""
    round_s: float = PERIOD_S
    """How long it takes to go once; then it goes the same way again, or stands, seconds."""


class _Writer:
    """Writes a course piece by piece, each for a whole number of ticks."""

    def __init__(self) -> None:
        self.ticks, self.begins, self.pieces = 0, list[int](), list[Floats]()

    def add(self, ticks: int, place: Any, heading: Any, *further: Any) -> None:
        """Add a piece.

        Args:
            ticks: How long it lasts; nothing is added for 0.
            place: (3,): where it begins, metres.
            heading: (2,) if constant, or (2, COEFFICIENTS).
            further: Velocity, then half the acceleration, (3,) each; 0 if left out.
        """
        if ticks == 0:
            return
        piece = np.zeros((CHANNELS, COEFFICIENTS))
        for power, values in enumerate((place, *further)):
            piece[:3, power] = values
        heading = np.asarray(heading, float)
        piece[3:] = heading if heading.ndim == 2 else heading[:, None] * (1.0, 0.0, 0.0, 0.0)
        self.begins.append(self.ticks)
        self.pieces.append(piece)
        self.ticks += ticks

    def course(self) -> Course:
        """The course so far."""
        return Course(np.array(self.begins) * TICK_S, np.array(self.pieces))


def _ticks(seconds: float) -> int:
    """Seconds as a whole number of ticks, rounded up: slower, never faster than asked."""
    return max(math.ceil(seconds / TICK_S), 1)


def _turn(writer: _Writer, place: Floats, start: Floats, end: Floats, rate: float) -> None:
    """Turn on the spot from one heading (2,) to another, in parts of a right angle at most.

    The heading runs along the chord between two unit vectors by 3 s² - 2 s³."""
    if start @ end < -1e-9:
        # by way of the left, so that no part exceeds a right angle
        middle = np.array([-start[1], start[0]])
        if middle @ end < 0:
            middle = -middle
        _turn(writer, place, start, middle, rate)
        start = middle
    chord = end - start
    length = math.sqrt(float(chord @ chord))
    if length < 1e-9:
        return
    # an arc is at most π/(2√2) = 1.12 times as long as its chord
    ticks = _ticks(1.12 * length / rate)
    seconds = ticks * TICK_S
    smooth = np.array([0.0, 0.0, 3.0 / (seconds * seconds), -2.0 / (seconds * seconds * seconds)])
    heading = chord[:, None] * smooth
    heading[:, 0] = start
    writer.add(ticks, place, heading)


def from_stop_to_stop(
    points: Floats,
    speed: float,
    acceleration: float,
    rate: float,
    waits_s: Sequence[float],
    *,
    backs_up: bool = False,
) -> Course | None:
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
    legs = np.roll(points, -1, axis=0) - points
    lengths = np.sqrt((legs * legs).sum(axis=1))
    headings = (legs / lengths[:, None])[:, :2]
    headings = headings / np.sqrt((headings * headings).sum(axis=1))[:, None]
    for n in range(1, len(points) if backs_up else 0):
        headings[n] *= 1.0 if headings[n] @ headings[n - 1] >= 0 else -1.0
    writer = _Writer()
    for n in range(len(points)):
        writer.add(_ticks(waits_s[n]), points[n], headings[n - 1])
        _turn(writer, points[n], headings[n - 1], headings[n], rate)
        # rising and falling speed, with constant speed between them where the leg is long enough
        peak = min(speed, math.sqrt(acceleration * lengths[n]))
        rise = _ticks(peak / acceleration)
        cruise = math.ceil((lengths[n] / peak - rise * TICK_S) / TICK_S)
        cruise = max(cruise, 0)
        velocity = legs[n] / ((rise + cruise) * TICK_S)
        half = velocity / (2 * rise * TICK_S)
        begun = points[n] + velocity * (rise * TICK_S / 2)
        writer.add(rise, points[n], headings[n], (0, 0, 0), half)
        writer.add(cruise, begun, headings[n], velocity)
        slowing = begun + velocity * (cruise * TICK_S)
        writer.add(rise, slowing, headings[n], velocity, -half)
    return _repeated(writer, points[0], headings[-1])


def without_stop(points: Floats, speed: float, acceleration: float, rate: float) -> Course | None:
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
    corner = np.maximum(corner, 2)
    if (corner / 2 + np.roll(corner, -1) / 2 > ticks).any():
        return None
    # a corner of more than a right angle would need two pieces
    if ((headings * np.roll(headings, 1, axis=0)).sum(axis=1) < 0).any():
        return None
    writer = _Writer()
    for _ in range(rounds):
        for n in range(len(points)):
            after = n + 1 if n + 1 < len(points) else 0
            half = corner[n] // 2
            # from the middle of the corner before to the middle of this leg's end
            lasting, first = corner[n] * TICK_S, points[n] - velocity[n - 1] * (half * TICK_S)
            smooth = np.array([0.0, 0.0, 3.0 / lasting**2, -2.0 / lasting**3])
            heading = chord[n][:, None] * smooth
            heading[:, 0] = headings[n - 1]
            writer.add(int(corner[n]), first, heading, velocity[n - 1], change[n] / (2.0 * lasting))
            straight = int(ticks[n] - half - corner[after] // 2)
            writer.add(
                straight, points[n] + velocity[n] * (half * TICK_S), headings[n], velocity[n]
            )
    return replace(writer.course(), round_s=PERIOD_S / rounds)


def _repeated(writer: _Writer, place: Floats, heading: Floats) -> Course | None:
    """Repeat a tour while it fits into the period, and stand for the rest of it."""
    period = round(PERIOD_S / TICK_S)
    if writer.ticks > period:
        return None
    rounds, tour = period // writer.ticks, writer.course()
    begin = np.concatenate([tour.begin_s + n * writer.ticks * TICK_S for n in range(rounds)])
    pieces = np.tile(tour.pieces, (rounds, 1, 1))
    if rest := period - rounds * writer.ticks:
        still = _Writer()
        still.add(rest, place, heading)
        begin = np.append(begin, rounds * writer.ticks * TICK_S)
        pieces = np.concatenate([pieces, still.course().pieces])
    return Course(begin, pieces, writer.ticks * TICK_S)
