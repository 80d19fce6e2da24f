"""Robots by name, those that map, complete and plan, and one without a map; and their flights
through many courses: flown, kept in a file, and flown again."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scenegen.errors import DatasetError, ScenegenError, raised_as
from scenegen.files import Json, check_ours, write_result, write_whole
from scenegen.fly.course import (
    Course,
    Flights,
    FlownCourse,
    Recording,
    read_recording,
    replay,
)
from scenegen.fly.loop import Flown, RobotError
from scenegen.fly.loop import fly as fly_mission
from scenegen.fly.pipe import own_robot
from scenegen.fly.suite import (
    QUICK,
    frozen_courses,
    hidden_course,
    is_whole,
    named,
    part_of,
    track_name,
    track_of,
)
from scenegen.model.completion.unlearned import Conservative, Extrude, Returns
from scenegen.model.robots import FORGETFUL, NAMES, REACTIVE
from scenegen.model.robots.mapping import MappingRobot, TruthRobot
from scenegen.model.robots.steering import ReactiveRobot
from scenegen.run import Executor, Function, counted, undone_if_stopped

RATIOS = ("score", "spl", "ratio", "speed_mps", "mean_clearance_m", "jerk_mps3", "step_s")
"""Figures of a flight of which a summary has the mean."""
COUNTS = ("late", "invalid", "speeding")
"""Figures of a flight of which a summary has the sum."""


def robot_maker(name: str, weights: str | None) -> Callable[[Course], Any]:
    """What makes the robot for a course: one of `NAMES`; one that maps and has the network called
    `weights` complete, from the last scan alone where its name is "returns"; or one's own, which
    runs in a process of its own."""
    if weights is not None:
        from scenegen.model.completion.completer import opened_once

        network = opened_once(weights, "cpu", 1)
        if set(network.inputs) - {"observed", "free"}:
            raise ScenegenError(
                f"{weights}: takes {', '.join(network.inputs)}; robots give "
                "observed and free voxels alone"
            )
        memory = name != FORGETFUL
        return lambda course: MappingRobot(network, memory=memory, doubts=True)
    known = {
        # what the last scan says, and what all scans say; of unknown voxels, that they are free
        FORGETFUL: lambda course: MappingRobot(Returns(), memory=False),
        "optimistic": lambda course: MappingRobot(Returns()),
        # unknown voxels are occupied
        "pessimistic": lambda course: MappingRobot(Conservative(), frontier=True),
        "extrude": lambda course: MappingRobot(Extrude(), doubts=True),
        # which nobody else is told
        "truth": lambda course: TruthRobot(course.simulated),
        REACTIVE: lambda course: ReactiveRobot(),
    }
    return known.get(name) or (lambda course: own_robot(name))


def real_course(course: Course, hidden: int | None) -> Course:
    """The course to fly: of a hidden track, the one that the number `hidden` draws."""
    return course if hidden is None else hidden_course(course, hidden)


def fly_course(
    course: Course, *, robot: str, weights: str | None, hidden: int | None = None
) -> FlownCourse:
    """All flights of a course, one after the other, by the same robot; with the course, which then
    has its world's hash. For `hidden` see `real_course`."""
    real = real_course(course, hidden)
    made = robot_maker(robot, weights)(real)
    try:
        flown = [fly_mission(real.simulation(n), made) for n in range(real.flights)]
    finally:
        getattr(made, "close", lambda: None)()
    return replace(course, document=real.sha256), flown


Crew = Callable[[Function, Sequence[Any], int], Iterator[Any]]
"""Works through courses of so many flights in all, and gives each course with what was made of each
of its flights."""


def crew_of(execute: Executor, **progress: Any) -> Crew:
    """A crew that works where `execute` says; for `progress`, counted in flights, see
    `scenegen.run.counted`."""

    def crew(function: Function, courses: Sequence[Any], flights: int) -> Iterator[Any]:
        return counted(
            execute, function, courses, total=flights, size=lambda pair: len(pair[1]), **progress
        )

    return crew


def rows_of(found: Flights, hidden: int | None, crew: Crew) -> list[Json]:
    """What is told of each flight, and how hard its mission is."""
    courses = [course for course, _ in found]
    total = sum(course.flights for course in courses)
    grades = dict(crew(partial(_graded, hidden=hidden), courses, total))
    return [
        one.row() | {"seed": course.seed, "difficulty": difficulty._asdict()}
        for course, flown in found
        for one, difficulty in zip(flown, grades[course], strict=True)
    ]


def _graded(course: Course, *, hidden: int | None) -> tuple[Course, Sequence[Any]]:
    return course, real_course(course, hidden).graded()


def check_begins(robot: str, course: Course) -> None:
    """Raise ScenegenError where a robot of one's own ends before it is ready for its first flight,
    so that a word mistyped is not flown 1500 times."""
    if robot in NAMES:
        return

    made = own_robot(robot)
    try:
        made.reset(course.simulation(0).about())
    except RobotError as error:
        if error.outcome == "crashed":
            raise ScenegenError(f"--robot {robot}: never begins: {error}") from None
    finally:
        made.close()


def summary(name: str, flown: Sequence[Flown]) -> Json:
    """What is told of flights, together."""
    ends = Counter(one.outcome for one in flown)
    row = {"robot": name, "flights": len(flown)}
    row |= {end: f"{100 * count / len(flown):.0f} %" for end, count in ends.most_common()}
    row |= {
        part: round(float(np.mean([getattr(one, part) for one in flown])), 4) for part in RATIOS
    }
    row["min_clearance_m"] = round(min(one.min_clearance_m for one in flown), 4)
    row["most_step_s"] = round(max(one.most_step_s for one in flown), 4)
    return row | {part: sum(getattr(one, part) for one in flown) for part in COUNTS}


ANEW = "flown anew, the same"
"""The note that says how many flights a robot flew as they were recorded."""
Work = Callable[[Course], FlownCourse]
"""What flies a course."""
SAVED_S = 20.0
"""How often the entry to a suite is written, seconds."""
NOTHING_KEPT = "stopped; no flight is kept"


def fly_courses(
    courses: Sequence[Course],
    work: Work,
    name: str,
    suite: str | None,
    out: Path | None,
    crew: Crew,
    *,
    track: str = "",
    network: str = "",
) -> Flights:
    """The flights through all courses, in their order. What `out` holds of a suite's entry is not
    flown again; the entry is written every `SAVED_S` seconds, and when the run is stopped."""
    entry = Recording(robot=name, suite=suite, track=track, network=network, courses=())
    keys = [named(course) for course in courses]
    by_name = _kept(out, entry, keys)
    todo = [course for course, key in zip(courses, keys, strict=True) if key not in by_name]

    def save() -> str:
        """Writes what there is; returns what to say of it if the run is stopped."""
        if out is None:
            return NOTHING_KEPT
        merged = _kept(out, entry, keys) | by_name  # another run may have written, too
        held = replace(entry, courses=[merged[key] for key in keys if key in merged])
        # an entry that is there was read, wherever it was copied from
        write = write_whole if suite and out.exists() else write_result
        write(out, replace(held, complete=is_whole(held)).encoded())
        there = f"{len(held.courses)} of {len(keys)} courses"
        return f"stopped; {out} holds {there}: give the same command again to go on"

    saved_s, total = time.monotonic(), sum(course.flights for course in todo)
    # only an entry is gone on with: of other flights, all are kept or none
    with undone_if_stopped(save if suite else lambda: NOTHING_KEPT):
        try:
            for course, flown in crew(work, todo, total):
                by_name[named(course)] = course, flown
                if suite and time.monotonic() - saved_s > SAVED_S:
                    save()
                    saved_s = time.monotonic()
        finally:
            if todo and len(by_name) >= (1 if suite else len(keys)):
                save()
    return [(course, by_name[key][1]) for course, key in zip(courses, keys, strict=True)]


def _kept(out: Path | None, entry: Recording, keys: Sequence[Course]) -> dict[Course, FlownCourse]:
    """The flights that `out` holds of an entry, by their courses' names. Raises ScenegenError where
    anything would be lost."""
    if out is None:
        return {}
    if entry.suite is None or not out.exists():
        with suppress(DatasetError):  # another file, or none
            if read_recording(out).suite:
                raise ScenegenError(f"{out}: is an entry to a suite; give another name")
        check_ours(out)
        return {}
    former = read_recording(out)
    entry = replace(entry, track=entry.track or track_of(former))
    if (former.robot, former.suite, track_of(former)) != (entry.robot, entry.suite, entry.track):
        raise ScenegenError(
            f"{out}: is of robot {former.robot}, suite {former.suite} and track "
            f"{track_of(former)[:14]}; give another name"
        )
    if former.network and entry.network and former.network != entry.network:
        raise ScenegenError(f"{out}: is of another network called {entry.robot}; remove it")
    found = {named(course): (course, flown) for course, flown in former.courses}
    if not found.keys() <= {*keys}:  # they would be lost
        raise ScenegenError(f"{out}: is an entry with other courses, too; give another name")
    return found


def flown_again(
    path: Path, hidden: int | None, maps: Path | None, anew: Work | None, crew: Crew
) -> tuple[str, Flights, dict[str, str], list[Flown]]:
    """Replay a recording.

    Args:
        path: The recording.
        hidden: The number of its hidden track, if it is an entry to one.
        maps: The folder of its maps, if it is an entry to their track.
        anew: Lets a robot fly a course. It then flies every sixteenth, too.
        crew: Works through the courses.

    Returns:
        The robot's name, the flights flown again, notes for the summary, and the flights of `anew`
        that are not, to the bit, as they were recorded.

    Raises:
        DatasetError: A flight is not as it was.
        ScenegenError: `hidden` or `maps` are not those of the entry, or a course is not one of its
            suite's.
    """
    recording, track, told = read_recording(path), track_name(hidden, maps), dict[str, str]()
    if recording.suite is not None:
        with raised_as(DatasetError, f"{path}: ", of=DatasetError):
            part = part_of(recording)
        if part.track != track:
            raise ScenegenError(
                f"{path}: is an entry to the track {part.track[:14]}, not {track[:14]}; give "
                "--hidden and its number, --maps and their folder, or neither"
            )
        # the suite's own, in place of worlds that a stranger's file leads to by another path
        frozen = {named(course): course for course in frozen_courses(recording.suite, track, maps)}
        courses = [
            (replace(frozen[named(course)], document=course.document), flights)
            for course, flights in recording.courses
        ]
        recording, told["courses"] = replace(recording, courses=courses), str(part)
    elif track != "own":
        raise ScenegenError(f"{path}: is no entry to a suite; leave out --hidden and --maps")
    count = sum(len(flights) for _, flights in recording.courses)
    with raised_as(DatasetError, f"{path}: ", of=DatasetError):
        again = dict(crew(partial(_replayed, hidden=hidden), recording.courses, count))
    told["as recorded, to the bit"], unlike = f"{count} flights", list[Flown]()
    if anew is not None:
        chosen = recording.courses[::QUICK]
        tried, unlike = sum(len(flights) for _, flights in chosen), _unlike(chosen, anew, crew)
        told[ANEW] = f"{tried - len(unlike)} of {tried} flights"
    flown = [(course, again[course]) for course, _ in recording.courses]
    return recording.robot, flown, told, unlike


def _unlike(recorded: Flights, work: Work, crew: Crew) -> list[Flown]:
    """The flights of a robot through these courses that are not, to the bit, as recorded."""
    before = {named(course): flights for course, flights in recorded}
    count, unlike = sum(map(len, before.values())), list[Flown]()
    for course, flown in crew(work, [course for course, _ in recorded], count):
        pairs = zip(flown, before[named(course)], strict=True)
        unlike += [again for again, former in pairs if again.digest != former.digest]
    return unlike


def _replayed(recorded: FlownCourse, *, hidden: int | None) -> FlownCourse:
    """The recorded flights of a course, flown again: see `scenegen.fly.course.replay`."""
    course, flights = recorded
    return course, replay(real_course(course, hidden), flights)
