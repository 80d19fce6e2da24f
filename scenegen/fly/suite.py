"""The suite `aerial-1`: courses that never change, graded, drawn on the user's machine."""

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
"""Distance from start to goal at least, metres, where a pair so far apart is connected."""
VEHICLE = Vehicle(radius_m=0.2, speed_mps=6, acceleration_mps2=6, tilt_deg=45)
"""So small that it passes through the doors of hard rooms; so fast that what is seen late tells."""
PATIENCE = 20.0
"""A flight ends after so many times the shortest way at full speed."""
HIDDEN = 50
"""Worlds of a hidden track."""
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
"""Their kinds, in turn: those of the suite, whatever kinds there are later."""
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


def track_name(hidden: int | None, maps: Path | None) -> str:
    """What an entry calls its track: "own", the suite's courses; "maps"; or "hidden" and a hash of
    the number that draws its worlds, from which these cannot be drawn."""
    if hidden is None:
        return "own" if maps is None else "maps"
    # not the hash that `hidden_course` draws by
    return f"hidden {hashlib.sha256(f'name of {hidden}'.encode()).hexdigest()}"


def chosen_courses(
    suite: str, hidden: int | None, maps: Path | None, *, quick: bool
) -> list[Course]:
    """The courses of a suite, those through the `maps` in a folder, or those that the number
    `hidden` draws, see `hidden_courses`; some of them if `quick`."""
    return frozen_courses(suite, track_name(hidden, maps), maps)[:: QUICK if quick else 1]


@dataclass(frozen=True)
class Part:
    """How much of a suite an entry holds."""

    track: str
    """See `track_name`."""
    quick: bool
    """Whether its courses are among those that `--quick` takes."""
    there: int
    """Courses that it has."""
    of: int
    """Courses that there are; with `quick`, that `--quick` takes."""

    def __str__(self) -> str:
        said = f"{self.track[:14]}{', quick' * self.quick}: {self.there} of {self.of} courses"
        return said if self.there == self.of else f"{said}, incomplete"


def part_of(entry: Recording) -> Part:
    """What an entry holds, once each course is found to be one of its suite's, with its vehicle,
    rules and sensor, and the same world as far as that is known without drawing it.

    Raises DatasetError where one is not.
    """
    if entry.suite not in SUITES:
        raise DatasetError("is no entry: expected flights of `fly suite`")
    track = track_of(entry)
    courses = {named(one): one.document for one in frozen_courses(entry.suite, track)}
    left = courses.copy()
    for course, _ in entry.courses:
        document = left.pop(named(course), None)
        if document is None or not course.document.startswith(document):
            raise DatasetError(
                f"{course.world}, {course.difficulty}, seed {course.seed}, is no course of "
                f"{entry.suite}'s track {track[:14]}, or it is there twice, or it has another "
                "world, vehicle, sensor or rules"
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
    """A course as entries name it: a map without its folder, and no hash of the world."""
    return replace(course, world=Path(course.world).name, document="")


def track_of(entry: Recording) -> str:
    """The track of an entry; where it does not say, by whether it flew maps."""
    maps = any(Path(course.world).name in MAPS for course, _ in entry.courses)
    return entry.track.strip() or ("maps" if maps else "own")


def frozen_courses(suite: str, track: str, maps: Path | None = None) -> list[Course]:
    """All courses of a track, as entries name them, or through the `maps` in a folder. Raises
    DatasetError where it is none."""
    match track.split()[0]:
        case "own":
            return courses_of(suite)
        case "maps":
            return map_courses(maps)
        case "hidden":
            return hidden_courses()
    raise DatasetError(f"{suite} has no track {track[:14]}; expected own, maps or hidden")


def map_courses(folder: Path | None) -> list[Course]:
    """Courses through the maps of real places in a folder or below it; without one, as entries name
    them. Raises GenerationError for one that is missing; for another map than was meant, `Course`
    does."""
    found = []
    for (name, document), seed in product(MAPS.items(), range(MAP_COURSES)):
        file = Path(name) if folder is None else min(folder.rglob(name), default=None)
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


def hidden_courses() -> list[Course]:
    """The courses of a hidden track, of all `HIDDEN_KINDS` and difficulties in turn, as entries
    name them: numbers from 0 on stand for their seeds, which `hidden_course` draws."""
    turns = list(product(DIFFICULTIES, HIDDEN_KINDS))
    chosen = (turns[n % len(turns)] for n in range(HIDDEN))
    return [_course(kind, level, n, "") for n, (level, kind) in enumerate(chosen)]


def hidden_course(course: Course, hidden: int) -> Course:
    """The course of `hidden_courses` that the number `hidden` draws: by the first seed, from one
    that nobody knows without that number, whose world has room for the missions.

    Raises GenerationError where it is another world than the course names.
    """
    # of so many seeds that none can be found by trying which world an entry's flights are through
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
