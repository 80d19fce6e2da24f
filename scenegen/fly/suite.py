"""The suite `aerial-1`: courses that never change, graded, drawn on the user's machine."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, product
from pathlib import Path

import numpy as np

from scenegen.errors import GenerationError
from scenegen.fly import Rules, Vehicle
from scenegen.fly.course import Course
from scenegen.recipes import kind_names

DIFFICULTIES = ("easy", "medium", "hard")
WORLDS = 10
"""Worlds of each kind and difficulty."""
FLIGHTS = 5
"""Missions through each world."""
APART_M = 10.0
"""Distance from start to goal at least, metres, where a pair so far apart is connected."""
VEHICLE = Vehicle(radius_m=0.2, speed_mps=6, acceleration_mps2=6, tilt_deg=45)
"""So small that it passes through the doors of hard rooms; so fast that what is seen late tells."""
PATIENCE = 20.0
"""A flight ends after so many times the shortest way at full speed."""
HIDDEN = 50
"""Worlds of a hidden track."""
MAPS = {
    "geb079.bt": "95a21e00319a7773",
    "fr_campus.bt": "241bc88f1bc5169f",
    "forest_big.bt": "ad1194d4eafac11d",
    "forest0.bt": "d2c2658cb9ee48fd",
    "forest1.bt": "4aa306adaf3d7dbb",
    "forest2.bt": "804aca1b8ed88b3f",
}
"""The maps of the real track, and the first `DIGITS` of their documents' SHA-256."""
MAP_COURSES = 4
"""Courses through each map."""
QUICK = 16
"""Of so many courses, one is flown where it has to be quick."""
DIGITS = 16
"""Hexadecimal digits of a world's SHA-256 that the suite's file holds."""


def chosen_courses(
    suite: str, hidden: int | None, maps: Path | None, *, quick: bool
) -> list[Course]:
    """The courses of a suite, those that the number `hidden` draws, or those through the `maps` in
    a folder; some of them if `quick`."""
    if maps is not None:
        found = map_courses(maps)
    else:
        found = courses_of(suite) if hidden is None else hidden_courses(hidden)
    return found[::QUICK] if quick else found


def map_courses(folder: Path) -> list[Course]:
    """Courses through the maps of real places in a folder or below it. Raises GenerationError for
    one that is missing; for another map than was meant, `Course` does."""
    found = []
    for (name, document), seed in product(MAPS.items(), range(MAP_COURSES)):
        file = min(folder.rglob(name), default=None)
        if file is None:
            raise GenerationError(
                f"{folder}: {name} is not there; expected {', '.join(MAPS)}, whose sources the "
                "page on flights names"
            )
        found.append(_course(str(file), None, seed, document))
    return found


def courses_of(suite: str) -> list[Course]:
    """The courses of a suite, by kind and difficulty."""
    text = (Path(__file__).parent / f"{suite}.json").read_text(encoding="utf-8")
    return [
        _course(kind, difficulty, seed, document)
        for kind, graded in json.loads(text).items()
        for difficulty, chosen in graded.items()
        for seed, document in chosen
    ]


def hidden_courses(seed: int) -> list[Course]:
    """Courses that nobody has seen before the `seed` is told: of all kinds and difficulties in
    turn."""
    digest = hashlib.sha256(f"aerial hidden {seed}".encode()).digest()
    rng = np.random.default_rng(np.frombuffer(digest, np.uint32))
    turns = list(product(DIFFICULTIES, kind_names()))
    found = []
    for n in range(HIDDEN):
        difficulty, kind = turns[n % len(turns)]
        found.append(next(flyable(kind, difficulty, int(rng.integers(1 << 31)))))
    return found


def flyable(kind: str, difficulty: str, first: int) -> Iterator[Course]:
    """Courses of a kind and difficulty that have room for their missions, by seeds from `first`
    on."""
    for seed in count(first):
        course = _course(kind, difficulty, seed, "")
        try:
            _ = course.missions
        except GenerationError:  # too narrow
            continue
        yield replace(course, document=course.sha256[:DIGITS])


def _course(kind: str, difficulty: str | None, seed: int, document: str) -> Course:
    return Course(
        world=kind,
        seed=seed,
        difficulty=difficulty,
        vehicle=VEHICLE,
        rules=Rules(apart_m=APART_M, patience=PATIENCE),
        flights=FLIGHTS,
        document=document,
    )
