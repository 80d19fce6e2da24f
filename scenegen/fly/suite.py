"""The suite `aerial-1`: courses that never change, graded, drawn on the user's machine."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, product
from pathlib import Path

import numpy as np

from scenegen.errors import GenerationError
from scenegen.fly import Rules, Vehicle
from scenegen.fly.course import Course
from scenegen.recipes import kind_names

SUITES = ("aerial-1",)
DIFFICULTIES = ("easy", "medium", "hard")
WORLDS = 10
"""Worlds of each kind and difficulty."""
FLIGHTS = 5
"""Missions through each world."""
APART_M = 10.0
"""Least distance from start to goal, metres: rooms have no longer ways between all of them."""
RADIUS_M = 0.2
"""The vehicle's, metres: it passes through the doors of hard rooms."""
HIDDEN = 50
"""Worlds of a hidden track."""
DIGITS = 16
"""Hexadecimal digits of a world's SHA-256 that the suite's file holds."""


@dataclass(frozen=True, kw_only=True)
class Entered:
    """A course of a suite."""

    course: Course
    world: str
    """The first digits of its world's SHA-256."""

    def check(self) -> None:
        """Raise GenerationError where this version draws another world."""
        if not self.course.sha256.startswith(self.world):
            raise GenerationError(
                f"{self.course.world}, {self.course.difficulty}, seed {self.course.seed}: this "
                "version of scenegen draws another world than the suite's; use the suite of its own"
            )


def courses_of(suite: str) -> list[Entered]:
    """The courses of a suite, by kind and difficulty."""
    seeds = json.loads((Path(__file__).parent / f"{suite}.json").read_text(encoding="utf-8"))
    return [
        Entered(course=_course(kind, difficulty, seed), world=world)
        for kind, graded in seeds.items()
        for difficulty, chosen in graded.items()
        for seed, world in chosen
    ]


def hidden_courses(seed: int) -> list[Entered]:
    """Courses that nobody has seen before the `seed` is told: of all kinds and difficulties in
    turn."""
    digest = hashlib.sha256(f"aerial hidden {seed}".encode()).digest()
    rng = np.random.default_rng(np.frombuffer(digest, np.uint32))
    turns = list(product(DIFFICULTIES, kind_names()))
    drawn = (
        next(flyable(*turns[n % len(turns)][::-1], int(rng.integers(1 << 31))))
        for n in range(HIDDEN)
    )
    return list(drawn)


def flyable(kind: str, difficulty: str, first: int) -> Iterator[Entered]:
    """Courses of a kind and difficulty that have room for their missions, by seeds from `first`
    on."""
    for seed in count(first):
        course = _course(kind, difficulty, seed)
        try:
            _ = course.missions
        except GenerationError:  # too narrow
            continue
        yield Entered(course=course, world=course.sha256[:DIGITS])


def _course(kind: str, difficulty: str, seed: int) -> Course:
    return Course(
        world=kind,
        seed=seed,
        difficulty=difficulty,
        vehicle=Vehicle(radius_m=RADIUS_M),
        rules=Rules(apart_m=APART_M),
        flights=FLIGHTS,
    )
