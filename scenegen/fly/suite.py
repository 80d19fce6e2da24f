"""The suite `aerial-2`: courses in five tracks that never change. Drawn worlds are made on the
user's machine and checked by hash."""

import functools
import hashlib
import json
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count, product
from pathlib import Path
from typing import Any

import numpy as np

from scenegen.base.errors import DatasetError, GenerationError
from scenegen.base.files import Json
from scenegen.fly import SUITES, TRACKS, Rules, Vehicle
from scenegen.fly.course import Course, Recording, check_document

SUITE = SUITES[0]
LEVELS = ("easy", "medium", "hard")
"""How hard courses are. The file aerial-2.toml says what that means for each kind of worlds."""
KINDS = (
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
"""Kinds of the tracks `drawn`, `movers` and `hidden`. They stay these, even if kinds are added."""
UNSEEN = ("parking", "orchard", "scaffold", "rubble")
"""Kinds of the track `unseen`."""
TRAFFIC = ("light", "medium", "dense")
"""How many movers the worlds of the track `movers` have, in turn."""
WORLDS = {"drawn": 10, "unseen": 20, "movers": 5}
"""Frozen worlds: `drawn`, of each kind and level; of others, of each kind, in turn of levels."""
FIRST_SEED = 2_000
"""Frozen worlds have the first seeds from here on that have room for their missions."""
CALIBRATION_SEED = 1_000_000
"""Seeds from here on are for calibration, and never frozen."""
FLIGHTS = 5
"""Missions through each world."""
VEHICLE = Vehicle(radius_m=0.2, speed_mps=4, acceleration_mps2=6, tilt_deg=45)
"""Small enough for narrow doors."""
RULES = Rules(apart_m=10.0, berth_m=0.1, patience=20.0)
"""Rules of all courses, where aerial-2.toml does not differ."""
HIDDEN = 50
"""Number of courses of a hidden track."""
PLACE_COURSES = 4
"""Courses through each map of a place."""
QUICK = 16
"""With --quick, one of so many courses is flown."""
DIGITS = 16
"""Hexadecimal digits of a world's SHA-256 that the suite's file holds."""


@functools.cache
def frozen() -> Json:
    """Read the suite's file.

    Returns:
        By track: the seed and the first digits of the world's SHA-256 of each course, by kind and
        by level or number of movers; of `places`, these digits by the map's name.
    """
    text = Path(__file__).with_name(f"{SUITE}.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


@functools.cache
def hardness() -> Json:
    """Read what the levels mean, by kind and level: `preset`, a difficulty; fields of `Rules`; and
    tables of a recipe."""
    return tomllib.loads(Path(__file__).with_name(f"{SUITE}.toml").read_text(encoding="utf-8"))


def track_name(track: str, hidden: int | None, maps: Path | None) -> str:
    """Return the name of a track as entries have it.

    Args:
        track: One of `TRACKS`; `hidden` and `maps` stand for a track of their own.
        hidden: Number that draws the worlds of a hidden track, or None.
        maps: Folder of maps, or None.

    Returns:
        The name; of a hidden track, "hidden" with a hash of the number, which does not reveal the
        number.
    """
    if hidden is None:
        return track if maps is None else "places"
    # another hash than the one that `hidden_course` draws by, or the name would reveal the worlds
    return f"hidden {hashlib.sha256(f'name of {hidden}'.encode()).hexdigest()}"


def chosen_courses(track: str, maps: Path | None = None, *, quick: bool) -> list[Course]:
    """Return the courses of a track.

    Args:
        track: Name of the track, see `track_name`.
        maps: Folder of the maps of places, or None.
        quick: Whether one of `QUICK` courses is enough.

    Raises:
        GenerationError: The folder lacks a map, or the track has no courses yet.
    """
    courses = frozen_courses(track, maps)
    if not courses:
        raise GenerationError(f"{SUITE} has no courses in its track {track} in this version")
    return courses[:: QUICK if quick else 1]


@dataclass(frozen=True)
class SuiteCoverage:
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
        # of a hidden track's hash, seven digits are enough for people
        text = f"{self.track[:14]}{', quick' * self.quick}: {self.there} of {self.of} courses"
        return text if self.there == self.of else f"{text}, incomplete"


def coverage_of(entry: Recording) -> SuiteCoverage:
    """Count the courses of an entry, and check that each belongs to the entry's suite.

    Vehicle, rules (but for one latency) and sensor must be those of the suite, and the world's hash
    as far as the suite has it; worlds are not drawn.

    Args:
        entry: The entry.

    Returns:
        The part of its track that the entry has.

    Raises:
        DatasetError: The recording is of no suite, or a course is not one of the suite's.
    """
    if entry.suite is None:
        raise DatasetError("is not an entry; expected a recording of `fly suite`")
    if entry.suite not in SUITES:
        raise DatasetError(
            f"is an entry to {entry.suite}, which this version does not have; fly {SUITE}"
        )
    latency_of(entry)
    courses = {entry_course(course): course.document for course in frozen_courses(entry.track)}
    left = courses.copy()  # each course counts once
    for course, _ in entry.courses:
        document = left.pop(entry_course(course), None)
        if document is None or not course.document.startswith(document):
            raise DatasetError(
                f"{course.world}, {course.level}, seed {course.seed}, is no course of "
                f"{entry.suite}'s track {entry.track[:14]}, or is there twice, or has another "
                "world, vehicle, sensor or rules"
            )
    some = list(courses)[::QUICK]
    quick = {entry_course(course) for course, _ in entry.courses} <= {*some}
    return SuiteCoverage(
        entry.track, quick, len(entry.courses), len(some) if quick else len(courses)
    )


def is_whole(entry: Recording) -> bool:
    """Whether an entry has all courses of its track, or all that `--quick` takes."""
    try:
        part = coverage_of(entry)
    except DatasetError:
        return False
    return part.there == part.of


def entry_course(course: Course) -> Course:
    """Return a course as entries name it: a map without its folder, no hash of the world, and no
    latency, which belongs to the robot."""
    return replace(late(course, 0.0), world=Path(course.world).name, document="")


def late(course: Course, latency_s: float) -> Course:
    """Return a course on which decisions come late.

    Args:
        course: The course.
        latency_s: How late, seconds.

    Returns:
        The course, else the same.
    """
    return replace(course, rules=replace(course.rules, latency_s=latency_s))


def latency_of(entry: Recording) -> float:
    """Return the latency of an entry's robot, seconds.

    Args:
        entry: The entry.

    Raises:
        DatasetError: Its courses have several.
    """
    found = {course.rules.latency_s for course, _ in entry.courses}
    if len(found) > 1:
        raise DatasetError(f"has flights of {len(found)} latencies; expected one")
    return found.pop() if found else 0.0


def frozen_courses(track: str, maps: Path | None = None) -> list[Course]:
    """Return all courses of a track.

    Args:
        track: Name of the track, see `track_name`.
        maps: Folder of the maps; None: courses have only their names.

    Raises:
        DatasetError: There is no such track.
        GenerationError: The folder lacks a map.
    """
    if track == "places":
        return place_courses(maps)
    if track.startswith("hidden "):
        return hidden_courses()
    if track not in TRACKS:
        raise DatasetError(
            f"{SUITE} has no track {track[:14]!a}; expected {', '.join(TRACKS)}, places or hidden"
        )
    return [
        replace(course_of(track, kind, level), seed=seed, document=document)
        for kind, levels in frozen().get(track, {}).items()
        for level, chosen in levels.items()
        for seed, document in chosen
    ]


def place_courses(folder: Path | None) -> list[Course]:
    """Return the courses through maps of places.

    Args:
        folder: The folder of the maps, which may be in folders below it. None: courses have only
            the maps' names.

    Raises:
        GenerationError: A map is missing. (A map with other content is refused by `Course.drawn`.)
    """
    courses, places = [], frozen().get("places", {})
    for (name, document), seed in product(places.items(), range(PLACE_COURSES)):
        # of several copies, the same one in every run
        file = Path(name) if folder is None else min(folder.rglob(name), default=None)
        if file is None:
            raise GenerationError(
                f"{folder}: {name} is not there; expected {', '.join(places)}, which "
                "benchmarks/places.py makes"
            )
        course = course_of("places", str(file), "")
        courses.append(replace(course, seed=seed, document=document))
    return courses


def hidden_courses() -> list[Course]:
    """Return the courses of a hidden track as entries name them, of all `KINDS` and levels in turn.
    Their seeds are numbers from 0 on, for which `hidden_course` draws the true ones."""
    # kinds change from course to course, so that --quick has many of them
    turns = list(product(LEVELS, KINDS))
    chosen = (turns[n % len(turns)] for n in range(HIDDEN))
    return [
        replace(course_of("hidden", kind, level), seed=n) for n, (level, kind) in enumerate(chosen)
    ]


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
    # without its hash: `fitting` would take the wrong world for one that is too narrow
    drawn = next(fitting(replace(course, document=""), firsts[-1]))
    check_document(drawn.sha256, course)
    return drawn


def fitting(course: Course, first: int) -> Iterator[Course]:
    """Draw courses whose worlds have room for all missions, as far apart as the rules say.

    Args:
        course: The course, whose seed changes.
        first: First seed.

    Yields:
        The course by each such seed.
    """
    for seed in count(first):
        drawn = replace(course, seed=seed)
        try:
            missions = drawn.missions
        except GenerationError:  # too narrow
            continue
        # `draw_missions` may have taken pairs half or a quarter as far apart
        if all(mission.straight_m >= course.rules.apart_m for mission in missions):
            yield drawn


def course_of(track: str, world: str, level: str) -> Course:
    """Return a course of the suite without its seed.

    Args:
        track: Name of the track.
        world: A kind of worlds, or the file of a map.
        level: One of `LEVELS`; one of `TRAFFIC` for the track `movers`; "" for a map.
    """
    common: Any = {"world": world, "level": level, "vehicle": VEHICLE, "flights": FLIGHTS}
    if track == "movers":
        return Course(**common, movers=level, rules=RULES)  # type: ignore[arg-type]
    if track in ("unseen", "places"):
        return Course(difficulty=level or None, rules=RULES, **common)
    changes = dict(hardness()[world][level])
    tables = {name: changes.pop(name) for name in ("world", "flight") if name in changes}
    return Course(
        difficulty=changes.pop("preset", level),
        recipe=json.dumps(tables) if tables else "",
        rules=replace(RULES, **changes),
        **common,
    )
