"""How hard the suite is, and its file: docs/fly.md.

    python benchmarks/suite.py FOLDER                                 # the calibration's table
    python benchmarks/suite.py FOLDER --kinds maze rooms --worlds 6   # some kinds, more worlds
    python benchmarks/suite.py --freeze drawn movers                  # frozen into aerial-2.json
    python benchmarks/suite.py --freeze unseen --kinds rubble         # a kind of them
    python benchmarks/suite.py --freeze places --maps MAPS

Worlds of the calibration have seeds that no frozen world has. FOLDER holds an entry for each kind,
level and robot; one that is there is not flown again. What is frozen replaces its part of the
suite's file.
"""

import json
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import islice, product
from pathlib import Path
from typing import Any, NamedTuple

import measuring
import numpy as np
from scoring import RESULTS, publish, titled, told
from tyro.conf import Positional

from scenegen.base.workers import ALONE
from scenegen.fly import suite
from scenegen.fly.course import Course, read_recording
from scenegen.fly.loop import Flown
from scenegen.model.robots import split_robot_name
from scenegen.model.robots.flights import crew_of, fly_course, fly_courses

ROBOTS = ("optimistic, brakes", "truth")
"""The first says how hard a level is; the second, that its flights are possible."""


class Options(measuring.Options):
    """Which worlds."""

    folder: Positional[Path | None] = None
    """of the calibration's flights"""
    kinds: Sequence[str] = ()
    """without these, all of the track"""
    worlds: int = 5
    """of each kind and level"""
    flights: int = 2
    """through each world"""
    seed: int = suite.CALIBRATION_SEED
    """the first"""
    freeze: Sequence[str] = ()
    """tracks to freeze, instead"""
    maps: Path | None = None
    """folder of the maps of places, to freeze these"""
    figures: Path = RESULTS / "suite.csv"


def main() -> None:
    """Calibrate, or freeze."""
    given = measuring.parse(Options, kinds=["pillar"], worlds=1, flights=1)
    if given.freeze:
        for track in given.freeze:
            freeze(track, given.kinds, given.maps)
        return
    with tempfile.TemporaryDirectory() as spare:
        folder, groups = given.folder or Path(spare), dict[str, list[Pair]]()
        for kind, level in product(given.kinds or suite.KINDS, suite.LEVELS):
            course = replace(suite.course_of("drawn", kind, level), flights=given.flights)
            groups[f"`{kind}`, {level}"] = pairs(course, given, folder)
    for level in suite.LEVELS:
        groups[f"all, {level}"] = [
            pair for title, flown in groups.items() if title.endswith(level) for pair in flown
        ]
    heads = [f"{robot}: {what}" for robot in ROBOTS for what in ("success", "score")]
    heads += ["score of `truth` less this", "line free", "flights"]
    rows = [(title, cells(flown)) for title, flown in groups.items()]
    publish(given, titled("## Calibration", heads, rows))


class Pair(NamedTuple):
    """Flights of both robots through a mission."""

    world: str
    flights: Sequence[Flown]


def pairs(course: Course, given: Options, folder: Path) -> list[Pair]:
    """Fly the robots through worlds for calibration that have room for the course's missions."""
    courses: Sequence[Course] = ()
    flown = []
    for robot in ROBOTS:
        entry = folder / f"{course.world}-{course.level}-{robot.partition(',')[0]}.json"
        if entry.exists():
            done = read_recording(entry).courses
        else:
            courses = courses or [*islice(suite.fitting(course, given.seed), given.worlds)]
            name, brakes = split_robot_name(robot)
            work: Any = partial(fly_course, robot=name, weights=None, brakes=brakes)
            done = fly_courses(courses, work, robot, None, entry, crew_of(ALONE))
        flown.append([flight for _, flights in done for flight in flights])
    seeds = [f"{one.world} {one.seed}" for one, flights in done for _ in flights]
    print(course.world, course.level, flush=True)
    return [Pair(*pair) for pair in zip(seeds, zip(*flown, strict=True), strict=True)]


def cells(flown: Sequence[Pair]) -> list[str]:
    """Figures of both robots, with intervals over worlds."""
    worlds, texts, scores = [pair.world for pair in flown], list[str](), list[Any]()
    for robot in range(len(ROBOTS)):
        flights = [pair.flights[robot] for pair in flown]
        success = [flight.outcome == "success" for flight in flights]
        scores.append(np.array([flight.score for flight in flights]))
        texts += [told(success, worlds, ".2f", "outcome"), told(scores[-1], worlds, ".2f")]
    free = np.mean([not pair.flights[0].blocked for pair in flown])
    less = told(scores[1] - scores[0], worlds, "+.2f")
    return [*texts, less, f"{free:.2f}", str(len(flown))]


def freeze(track: str, kinds: Sequence[str], maps: Path | None) -> None:
    """Write the courses of a track, or of some of its kinds, into the suite's file."""
    order: Sequence[str] = suite.UNSEEN if track == "unseen" else suite.KINDS
    if track == "places":
        assert maps is not None, "--freeze places needs --maps"
        places = tomllib.loads(Path(__file__).with_name("places.toml").read_text())
        real = [name for name, about in places.items() if "place" in about and "scans" not in about]
        files = [next(maps.glob(f"{name}.*")) for name in real]
        order = [file.name for file in files]
        part: Any = {file.name: digits(suite.course_of(track, str(file), "")) for file in files}
    else:
        part = {kind: dict(chosen(track, kind)) for kind in kinds or order}
    suite.frozen.cache_clear()  # others may have been frozen meanwhile
    part = suite.frozen()[track] | part
    part = {name: part[name] for name in order if name in part}
    text = {**suite.frozen(), track: part}
    lines = json.dumps(text, indent=1).replace("\n     ", "").replace("\n    ]", "]")
    file = Path(suite.__file__).with_name(f"{suite.SUITE}.json")
    file.write_text(f"{lines}\n")


def chosen(track: str, kind: str) -> Any:
    """The levels of a kind, or numbers of movers, and the courses of each."""
    levels = suite.TRAFFIC if track == "movers" else suite.LEVELS
    worlds, parts = suite.WORLDS[track], len(levels)
    for n, level in enumerate(levels):
        many = worlds if track == "drawn" else len(range(n, worlds, parts))
        # levels of a kind have worlds of their own: the same seed could make like ones
        first = suite.FIRST_SEED + 100_000 * n
        course = suite.course_of(track, kind, level)
        drawn = islice(suite.fitting(course, first), many)
        yield level, [[one.seed, digits(one)] for one in drawn]
        print(track, kind, level, flush=True)


def digits(course: Course) -> str:
    """The first digits of the SHA-256 of a course's world."""
    return course.sha256[: suite.DIGITS]


if __name__ == "__main__":
    main()
