"""The suite `aerial-1`: courses of three difficulties that never change. Their worlds are drawn on
the user's machine and checked by hash."""

import hashlib
import json
from dataclasses import dataclass, replace
from itertools import count, product
from pathlib import Path

import numpy as np

from scenegen.base.errors import DatasetError, GenerationError
from scenegen.fly import SUITES, Rules, Vehicle
from scenegen.fly.course import Course, Recording, check_document

DIFFICULTIES = ("easy", "medium", "hard")
FLIGHTS = 5
"""Missions through each world."""
APART_M = 10.0
"""Minimum distance from start to goal, metres; less where no pair so far apart is connected."""
VEHICLE = Vehicle(radius_m=0.2, speed_mps=6, acceleration_mps2=6, tilt_deg=45)
"""Small enough for the doors of hard rooms, and so fast that obstacles seen late matter."""
PATIENCE = 20.0
"""Time limit of a flight, as a multiple of the shortest way at full speed."""
HIDDEN = 50
"""Number of courses of a hidden track."""
HIDDEN_KINDS = (
    "cave",
    "clutter",
    "forest",
    "geometric",
    "industrial",
    "maze",
    "pillar",
    "rooms",
    "street",
    "warehouse",
)
"""Kinds of a hidden track, in turn. They stay these, even if kinds are added."""
MAPS = {
    "geb079.bt": "95a21e00319a7773",
    "fr_campus.bt": "241bc88f1bc5169f",
    "forest_big.bt": "ad1194d4eafac11d",
    "forest0.bt": "d2c2658cb9ee48fd",
    "forest1.bt": "4aa306adaf3d7dbb",
    "forest2.bt": "804aca1b8ed88b3f",
}
"""Maps of the track of real places, and the first `DIGITS` of their documents' SHA-256."""
MAP_COURSES = 4
"""Courses through each map."""
QUICK = 16
"""With --quick, one of so many courses is flown."""
DIGITS = 16
"""Hexadecimal digits of a world's SHA-256 that the suite's file holds."""


def track_name(hidden: int | None, maps: Path | None) -> str:
    """Return the name of a track.

    Args:
        hidden: Number that draws the worlds of a hidden track, or None.
        maps: Folder of maps, or None.

    Returns:
        "own" for the suite's courses, "maps", or "hidden" with a hash of the number, which does not
        reveal the number.
    """
    if hidden is None:
        return "own" if maps is None else "maps"
    # another hash than the one that `hidden_course` draws by, or the name would reveal the worlds
    return f"hidden {hashlib.sha256(f'name of {hidden}'.encode()).hexdigest()}"


def chosen_courses(
    suite: str, hidden: int | None, maps: Path | None, *, quick: bool
) -> list[Course]:
    """Return the courses of a track.

    Args:
        suite: Name of the suite.
        hidden: Number of a hidden track, see `hidden_courses`, or None.
        maps: Folder of the maps of real places, or None.
        quick: Whether one of `QUICK` courses is enough.

    Raises:
        GenerationError: The folder lacks a map.
    """
    return frozen_courses(suite, track_name(hidden, maps), maps)[:: QUICK if quick else 1]


@dataclass(frozen=True)
class Part:
    """How many courses of a suite an entry has."""

    track: str
    """Name of the track, see `track_name`."""
    quick: bool
    """Whether all its courses are among those of `--quick`."""
    there: int
    """Number of courses that the entry has."""
    of: int
    """Number of courses of the track; with `quick`, of the part that `--quick` takes."""

    def __str__(self) -> str:
        text = f"{self.track[:14]}{', quick' * self.quick}: {self.there} of {self.of} courses"
        return text if self.there == self.of else f"{text}, incomplete"


def part_of(entry: Recording) -> Part:
    """Count the courses of an entry, and check that each belongs to the entry's suite.

    Vehicle, rules and sensor must be those of the suite, and the world's hash as far as the suite
    has it; worlds are not drawn.

    Args:
        entry: The entry.

    Returns:
        The part of its track that the entry has.

    Raises:
        DatasetError: The recording is of no suite, or a course is not one of the suite's.
    """
    if entry.suite not in SUITES:
        raise DatasetError("is not an entry; expected a recording of `fly suite`")
    track = track_of(entry)
    courses = {named(course): course.document for course in frozen_courses(entry.suite, track)}
    left = courses.copy()  # each course counts once
    for course, _ in entry.courses:
        document = left.pop(named(course), None)
        if document is None or not course.document.startswith(document):
            raise DatasetError(
                f"{course.world}, {course.difficulty}, seed {course.seed}, is no course of "
                f"{entry.suite}'s track {track[:14]}, or is there twice, or has another world, "
                "vehicle, sensor or rules"
            )
    some = list(courses)[::QUICK]
    quick = {named(course) for course, _ in entry.courses} <= {*some}
    return Part(track, quick, len(entry.courses), len(some) if quick else len(courses))


def is_whole(entry: Recording) -> bool:
    """Whether an entry has all courses of its track, or all that `--quick` takes."""
    try:
        part = part_of(entry)
    except DatasetError:
        return False
    return part.there == part.of


def named(course: Course) -> Course:
    """Return a course as entries name it: a map without its folder, and no hash of the world."""
    return replace(course, world=Path(course.world).name, document="")


def track_of(entry: Recording) -> str:
    """Return the track of an entry; older entries lack it, and their worlds tell."""
    maps = any(Path(course.world).name in MAPS for course, _ in entry.courses)
    return entry.track.strip() or ("maps" if maps else "own")


def frozen_courses(suite: str, track: str, maps: Path | None = None) -> list[Course]:
    """Return all courses of a track.

    Args:
        suite: Name of the suite.
        track: Name of the track, see `track_name`.
        maps: Folder of the maps; None: courses have only their names.

    Raises:
        DatasetError: There is no such track.
        GenerationError: The folder lacks a map.
    """
    match track.split()[0]:
        case "own":
            return courses_of(suite)
        case "maps":
            return map_courses(maps)
        case "hidden":
            return hidden_courses()
    raise DatasetError(f"{suite} has no track {track[:14]}; expected own, maps or hidden")


def map_courses(folder: Path | None) -> list[Course]:
    """Return the courses through maps of real places.

    Args:
        folder: The folder of the maps, which may be in folders below it. None: courses have only
            the maps' names.

    Raises:
        GenerationError: A map is missing. (A map with other content is refused by `Course.drawn`.)
    """
    courses = []
    for (name, document), seed in product(MAPS.items(), range(MAP_COURSES)):
        file = Path(name) if folder is None else min(folder.rglob(name), default=None)
        if file is None:
            raise GenerationError(
                f"{folder}: {name} is not there; expected {', '.join(MAPS)}, whose sources the "
                "page on flights names"
            )
        courses.append(_course(str(file), None, seed, document))
    return courses


def courses_of(suite: str) -> list[Course]:
    """Return the courses of a suite, by kind and difficulty."""
    text = (Path(__file__).parent / f"{suite}.json").read_text(encoding="utf-8")
    return [
        _course(kind, difficulty, seed, document)
        for kind, graded in json.loads(text).items()
        for difficulty, chosen in graded.items()
        for seed, document in chosen
    ]


def hidden_courses() -> list[Course]:
    """Return the courses of a hidden track as entries name them, of all `HIDDEN_KINDS` and
    difficulties in turn. Their seeds are numbers from 0 on, for which `hidden_course` draws the
    true ones."""
    # kinds change from course to course, so that --quick has many of them
    turns = list(product(DIFFICULTIES, HIDDEN_KINDS))
    chosen = (turns[n % len(turns)] for n in range(HIDDEN))
    return [_course(kind, level, n, "") for n, (level, kind) in enumerate(chosen)]


def hidden_course(course: Course, hidden: int) -> Course:
    """Draw a course of a hidden track: by the first seed whose world has room for the missions.

    Args:
        course: A course of `hidden_courses`.
        hidden: Number of the track, which only its owner knows.

    Raises:
        GenerationError: The world is not the one whose hash the course has.
    """
    # from 2⁶³ seeds: nobody can find one by trying which world an entry flew through
    digest = hashlib.sha256(f"aerial hidden {hidden}".encode()).digest()
    rng = np.random.default_rng(np.frombuffer(digest, np.uint32))
    firsts = [int(rng.integers(1 << 63)) for _ in range(course.seed + 1)]
    for seed in count(firsts[-1]):
        drawn = replace(course, seed=seed, document="")
        try:
            _ = drawn.missions
        except GenerationError:  # too narrow
            continue
        check_document(drawn.sha256, course)
        return drawn
    raise AssertionError("numbers do not end")


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
