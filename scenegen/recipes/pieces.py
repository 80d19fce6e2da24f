"""What stands in worlds of several kinds: furniture, plants, vehicles, goods, machines and stones,
each in a frame of its own."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.random import Generator

from lidarsim.solids.shapes import BOX
from scenegen.recipes.parts import Parts, Point, Rectangle

PIECES = ("table", "chair", "shelf", "cupboard", "sofa")
PALLET_M = (1.2, 0.8, 0.15)
"""A EUR pallet (EN 13698-1), metres."""


def furniture(parts: Parts, kind: str, *, rng: Generator) -> None:
    """A piece of furniture around the origin of a frame."""
    a, b, c = rng.random(3).tolist()
    if kind == "table":
        x, y, z = 0.6 + 0.4 * a, 0.35 + 0.2 * b, 0.72 + 0.06 * c
        parts.box("furniture", (-x, -y, z - 0.04), (x, y, z))
        _legs(parts, x, y, z - 0.04)
    elif kind == "chair":
        parts.box("furniture", (-0.22, -0.22, 0.41), (0.22, 0.22, 0.45))
        parts.box("furniture", (-0.22, 0.18, 0.45), (0.22, 0.22, 0.85 + 0.2 * a))
        _legs(parts, 0.22, 0.22, 0.41)
    elif kind == "shelf":
        x, y, z = 0.4 + 0.4 * a, 0.15 + 0.08 * b, 1.2 + 0.9 * c
        for side in (-x, x):
            parts.box("shelf", (side - 0.02, -y, 0), (side + 0.02, y, z))
        for level in np.linspace(0.1, z, 5).tolist():
            parts.box("shelf", (-x, -y, level - 0.03), (x, y, level))
    elif kind == "cupboard":
        parts.box("furniture", (-0.4 - 0.4 * a, -0.3, 0), (0.4 + 0.4 * a, 0.3, 0.8 + 1.3 * c))
    else:
        x = 0.7 + 0.5 * a
        parts.box("furniture", (-x, -0.45, 0), (x, 0.45, 0.42))
        parts.box("furniture", (-x, 0.25, 0.42), (x, 0.45, 0.85))
        for side in (-x, x - 0.15):
            parts.box("furniture", (side, -0.45, 0.42), (side + 0.15, 0.45, 0.62))


def _legs(parts: Parts, x: float, y: float, z: float) -> None:
    for dx, dy in ((-x, -y), (-x, y - 0.05), (x - 0.05, -y), (x - 0.05, y - 0.05)):
        parts.box("furniture", (dx, dy, 0), (dx + 0.05, dy + 0.05, z))


def furnish(
    parts: Parts,
    room: Rectangle,
    doors: Sequence[tuple[float, float]],
    density: float,
    *,
    rng: Generator,
) -> None:
    """Furniture in a room, so many pieces a square metre, and none before its doors."""
    x0, y0, x1, y1 = room
    pieces = round(density * (x1 - x0) * (y1 - y0) + rng.uniform(-0.5, 0.5))
    inside = ((x0 + 0.9, y0 + 0.9), (max(x1 - 0.9, x0 + 0.9), max(y1 - 0.9, y0 + 0.9)))
    for px, py in rng.uniform(*inside, (max(pieces, 0), 2)).tolist():
        kind, turn = rng.integers(0, len(PIECES)), rng.integers(0, 4)
        if all((px - x) ** 2 + (py - y) ** 2 > 1.7 for x, y in doors):
            furniture(parts.at(px, py, 0.0, turn * (np.pi / 2)), PIECES[kind], rng=rng)


def stairs(parts: Parts, low: Point, length: float, height: float) -> None:
    """Steps along x that rise from `low` until `length` or `height` ends them, metres."""
    x, y, z = low
    for n in range(min(int(height / 0.17), int(length / 0.28))):
        step = (x + 0.28 * n, y, z + max(0.17 * n - 0.2, 0.0))
        parts.box("stairs", step, (step[0] + 0.3, y + 1.1, z + 0.17 * (n + 1)))


def tree(parts: Parts, height: float, *, rng: Generator) -> None:
    """A tree of this height at the origin of a frame: a trunk under a crown of ellipsoids."""
    bole = height * rng.uniform(0.3, 0.5)
    parts.limb("trunk", (0, 0, 0), (0.02 * height, 0, bole + 0.2 * height), 0.025 * height)
    spread = 0.22 * height
    for _ in range(int(rng.integers(3, 7))):
        x, y, z, size, flat = rng.uniform(-1.0, 1.0, 5).tolist()
        radius = spread * (0.8 + 0.3 * size)
        middle = (spread * x, spread * y, (bole + height) / 2 + (height - bole) * 0.3 * z)
        parts.ball("vegetation", middle, (radius, radius, radius * (0.8 + 0.2 * flat)))


def balcony(parts: Parts, width: float, *, rng: Generator) -> None:
    """A balcony along x, in front of y = 0, with a wall or a railing."""
    out = rng.uniform(0.8, 1.4)
    parts.box("building", (0, -out, -0.15), (width, 0, 0.0))
    if rng.random() < 0.5:
        parts.box("fence", (0, -out, 0), (width, -out + 0.08, 1.0))
    else:
        parts.limb("fence", (0, -out, 1.0), (width, -out, 1.0), 0.03)
        for x in np.linspace(0.0, width, 5).tolist():
            parts.limb("fence", (x, -out, 0), (x, -out, 1.0), 0.02)


def colonnade(parts: Parts, size: Point, bays: int, pier: float, *, rng: Generator) -> None:
    """A ground floor of `size` that stands back behind a row of columns along x at y = 0."""
    width, deep, high = size
    parts.box("building", (0, rng.uniform(1.8, 2.8), 0), (width, deep, high))
    for n in range(bays + 1):
        x = min(max(n * (width / bays), pier / 2), width - pier / 2)
        parts.rod("column", (x, pier / 2, 0), (x, pier / 2, high), pier / 2)


def facade(
    parts: Parts,
    size: tuple[float, float],
    bays: int,
    pier: float,
    relief: float,
    span: tuple[float, float],
) -> None:
    """A block of `size` along x and y, from a height to another. Its front at y = 0 has piers
    between bays, which stand out by `relief`."""
    (width, deep), (bottom, top) = size, span
    parts.box("building", (0, relief, bottom), (width, deep, top))
    for n in range(bays + 1):
        low = min(max(n * (width / bays) - pier / 2, 0.0), width - pier)
        parts.box("building", (low, 0, bottom), (low + pier, relief, top))


def gable_roof(parts: Parts, width: float, deep: float, rise: float) -> None:
    """Two planes that rise by `rise` over a rectangle from the origin, with the ridge along x."""
    half = float(np.sqrt(1 + rise * rise)) * deep / 4
    cosine = float(np.sqrt((1 + 1 / np.sqrt(1 + rise * rise)) / 2))
    sine = float(np.sqrt(1 - cosine * cosine))
    for side, turn in ((0.25, sine), (0.75, -sine)):
        size, middle = (width / 2 + 0.2, half, 0.1), (width / 2, deep * side, rise * deep / 4)
        parts.solid("roof", BOX, size, middle, (cosine, turn, 0.0, 0.0))


def lamp_posts(
    parts: Parts, places: Sequence[float], kerb: float, height: float, *, wired: bool
) -> None:
    """Lamp posts along x behind a kerb, whose arms hang over the road, with wires between them if
    `wired`."""
    y = kerb + 0.4
    for x in places:
        parts.rod("pole", (x, y, 0), (x, y, height), 0.09)
        parts.limb("pole", (x, y, height), (x, kerb - 1.2, height + 0.2), 0.05)
    if wired:
        for one, other in pairwise(places):
            for z in (height - 0.1, height - 0.6):
                cable(parts, (one, y, z), (other, y, z))


def cable(parts: Parts, start: Point, end: Point) -> None:
    """A wire that hangs 0.3 m through between two points."""
    x, y, z = ((a + b) / 2 for a, b in zip(start, end, strict=True))
    parts.limb("cable", start, (x, y, z - 0.3), 0.025)
    parts.limb("cable", (x, y, z - 0.3), end, 0.025)


def car(parts: Parts, *, rng: Generator) -> None:
    """A car along x: body, cabin and wheels."""
    long, wide, high = rng.uniform((3.8, 1.65, 1.4), (4.8, 1.9, 1.9)).tolist()
    body, shift = 0.55 * high, rng.uniform(-0.3, 0.3)
    parts.box("vehicle", (-long / 2, -wide / 2, 0.22), (long / 2, wide / 2, body))
    cabin = (shift - 0.27 * long, -0.45 * wide, body), (shift + 0.27 * long, 0.45 * wide, high)
    parts.box("vehicle", *cabin)
    for x in (-0.32 * long, 0.32 * long):
        for y in (-wide / 2, wide / 2 - 0.2):
            parts.rod("tyre", (x, y, 0.31), (x, y + 0.2, 0.31), 0.31)


def pallet(parts: Parts, *, rng: Generator) -> None:
    """A pallet with a load, around the origin of a frame."""
    x, y, z = (PALLET_M[0] / 2, PALLET_M[1] / 2, PALLET_M[2])
    parts.box("goods", (-x, -y, 0), (x, y, z))
    a, b, c = rng.random(3).tolist()
    parts.box("goods", (-x * (0.6 + 0.4 * a), -y, z), (x, y * (0.6 + 0.4 * b), z + 0.3 + 1.4 * c))


def conveyor(parts: Parts, long: float, *, rng: Generator) -> None:
    """A belt along y on legs, with goods on it."""
    high = rng.uniform(0.7, 2.6)
    parts.box("machine", (-0.4, 0, high - 0.15), (0.4, long, high))
    for y in np.arange(0.5, long, 2.5).tolist():
        for x in (-0.4, 0.34):
            parts.box("machine", (x, y, 0), (x + 0.06, y + 0.06, high))
    for y, a, b in rng.uniform((0.5, 0.2, 0.2), (long - 1, 0.6, 0.6), (int(long / 3), 3)).tolist():
        parts.box("goods", (-a / 2, y, high), (a / 2, y + a, high + b))


def truss(parts: Parts, long: float) -> None:
    """Two chords along x with posts and diagonals between them."""
    for z in (0.0, 1.0):
        parts.box("beam", (0, -0.08, z), (long, 0.08, z + 0.16))
    for x in np.arange(0.0, long - 2.4, 2.5).tolist():
        parts.box("beam", (x, -0.05, 0.1), (x + 0.1, 0.05, 1.0))
        parts.limb("beam", (x, 0, 0.1), (x + 2.5, 0, 1.0), 0.05)


def machine(parts: Parts, *, rng: Generator) -> None:
    """Boxes and a drum on a base."""
    x, y, z = rng.uniform((0.6, 0.4, 0.6), (2.0, 1.2, 1.8)).tolist()
    parts.box("machine", (-x, -y, 0), (x, y, 0.25))
    parts.box("machine", (-0.9 * x, -0.8 * y, 0.25), (0.2 * x, 0.8 * y, z))
    parts.rod("machine", (0.2 * x, 0, 0.3 + 0.3 * z), (0.95 * x, 0, 0.3 + 0.3 * z), 0.3 * z)
    parts.rod("pipe", (-0.5 * x, 0, z), (-0.5 * x, 0, z + rng.uniform(0.3, 3.0)), 0.08)
    parts.box("machine", (0.9 * x, -y, 0), (0.9 * x + 0.3, -0.5 * y, 1.6))


def scaffold(parts: Parts, *, rng: Generator) -> None:
    """Bays of tubes and planks."""
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


def stone(parts: Parts, turn: Sequence[float], *, rng: Generator) -> None:
    """A box or an ellipsoid at the origin of a frame, at an attitude w x y z."""
    a, b, c, flat = rng.random(4).tolist()
    size = (0.15 + 0.6 * a, 0.15 + 0.5 * b, 0.1 + 0.4 * c)
    if flat < 0.5:
        parts.solid("rock", BOX, size, (0, 0, 0.1), turn)
    else:
        parts.ball("rock", (0, 0, 0.1), size, turn)
