"""Robots by name, and their flights through many courses: flown, recorded, and flown again."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scenegen.base.errors import DatasetError, ScenegenError, reraise_as
from scenegen.base.executors import Executor, Function, counted, undone_if_stopped
from scenegen.base.files import Json, check_ours, write_atomic, write_result
from scenegen.fly import TRACKS
from scenegen.fly.course import Course, Flights, FlownCourse, Recording, read_recording, replay
from scenegen.fly.loop import Flown, RobotError
from scenegen.fly.loop import fly as fly_mission
from scenegen.fly.pipe import own_robot
from scenegen.fly.suite import (
    QUICK,
    coverage_of,
    entry_course,
    frozen_courses,
    hidden_course,
    is_whole,
    late,
    latency_of,
    track_name,
)
from scenegen.model.completion.protocol import Conservative, Extrude, ReturnsCompleter
from scenegen.model.robots import COMPLETES_EVERY, FORESEEING, FORGETFUL, NAMES, REACTIVE, SAMPLING
from scenegen.model.robots.avoiding import TrackingRobot, TruthAmongMovers
from scenegen.model.robots.mapping import MappingRobot, TruthRobot
from scenegen.model.robots.sampling import SamplingRobot
from scenegen.model.robots.steering import ReactiveRobot
from scenegen.worlds.world import AnyWorld, World

RATIOS = ("score", "spl", "ratio", "speed_mps", "mean_clearance_m", "jerk_mps3", "step_s")
"""Figures of a flight of which a summary has the mean."""
COUNTS = ("late", "invalid", "speeding")
"""Figures of a flight of which a summary has the sum."""


def robot_maker(
    name: str, weights: str | None, brakes: float | None = None
) -> Callable[[Course], Any]:
    """Return a function that makes the robot for a course.

    Args:
        name: One of `NAMES`, or a user's own robot, which runs in a process of its own.
        weights: A network by which a robot that maps completes: the map of all scans, or of the
            last scan if `name` is "returns". It plans by RRT* if `name` is "sampling".
        brakes: If given, a robot that maps brakes for what it has not seen, see `MappingRobot`.

    Returns:
        The function.
    """
    if weights is not None:
        from scenegen.model.completion.completer import opened_once

        network = opened_once(weights, "cpu", 1)
        kind = SamplingRobot if name == SAMPLING else MappingRobot
        return lambda course: kind(
            network,
            memory=name != FORGETFUL,
            doubts=True,
            brakes=brakes,
            every=COMPLETES_EVERY,
        )
    known = {
        # occupied where the last scan, or any scan, returned; unknown voxels are free
        FORGETFUL: lambda course: MappingRobot(ReturnsCompleter(), memory=False, brakes=brakes),
        "optimistic": lambda course: MappingRobot(ReturnsCompleter(), brakes=brakes),
        # unknown voxels are occupied
        "pessimistic": lambda course: MappingRobot(Conservative(), frontier=True, brakes=brakes),
        SAMPLING: lambda course: SamplingRobot(ReturnsCompleter(), brakes=brakes),
        "extrude": lambda course: MappingRobot(Extrude(), doubts=True, brakes=brakes),
        # movers are expected to stay, or to go on
        "forgetting": lambda course: TrackingRobot(predicts=False, brakes=brakes),
        "predicting": lambda course: TrackingRobot(predicts=True, brakes=brakes),
        # no other robots are given the world
        "truth": lambda course: _knowing(course.simulated, predicts=False),
        FORESEEING: lambda course: _knowing(course.simulated, predicts=True),
        REACTIVE: lambda course: ReactiveRobot(),
    }
    return known.get(name) or (lambda course: own_robot(name))


def _knowing(world: AnyWorld, *, predicts: bool) -> MappingRobot:
    """The robot that knows a world, and its movers if it has some."""
    if isinstance(world, World) and world.movers is not None:
        return TruthAmongMovers(world, predicts=predicts)
    return TruthRobot(world)


def real_course(course: Course, hidden: int | None) -> Course:
    """Return the course to fly.

    Args:
        course: The course.
        hidden: Number that draws the courses of a hidden track; None: another track.

    Returns:
        The course, or that of the hidden track in its place.
    """
    return course if hidden is None else hidden_course(course, hidden)


def fly_course(
    course: Course,
    *,
    robot: str,
    weights: str | None,
    brakes: float | None = None,
    hidden: int | None = None,
) -> FlownCourse:
    """Fly all flights of a course, one after the other, by the same robot.

    Args:
        course: The course.
        robot: See `robot_maker`.
        weights: See `robot_maker`.
        brakes: See `robot_maker`.
        hidden: See `real_course`.

    Returns:
        The course, with the hash of its world, and the flights.
    """
    real = real_course(course, hidden)
    pilot = robot_maker(robot, weights, brakes)(real)
    if isinstance(pilot, MappingRobot):
        # kernels are compiled or loaded now, and not in a decision, which is timed
        pilot.reset(real.simulation(0).about())
        pilot.rehearse()
    try:
        flown = [fly_mission(real.simulation(n), pilot) for n in range(real.flights)]
    finally:
        # a robot of a user's own is a process, which must not outlive its flights
        getattr(pilot, "close", lambda: None)()
    return replace(course, document=real.sha256), flown


Crew = Callable[[Function, Sequence[Any], int], Iterator[Any]]
"""Function that works through courses of so many flights in all, and yields the results by
course."""


def crew_of(execute: Executor, **progress: Any) -> Crew:
    """Make a crew.

    Args:
        execute: Where it works.
        progress: Callbacks, counted in flights; see `scenegen.base.executors.counted`.

    Returns:
        The crew.
    """

    def crew(function: Function, courses: Sequence[Any], flights: int) -> Iterator[Any]:
        """Apply a function to courses.

        Args:
            function: From a course to itself and the results of its flights.
            courses: The courses.
            flights: Their flights in all.

        Yields:
            The results.
        """
        return counted(
            execute, function, courses, total=flights, size=lambda pair: len(pair[1]), **progress
        )

    return crew


def rows_of(flights: Flights, hidden: int | None, crew: Crew) -> list[Json]:
    """List the figures of each flight, and how hard its mission is.

    Args:
        flights: The flights.
        hidden: See `real_course`.
        crew: Works through the courses.

    Returns:
        A row for each flight.
    """
    courses = [course for course, _ in flights]
    total = sum(course.flights for course in courses)
    grades = dict(crew(partial(_graded, hidden=hidden), courses, total))
    return [
        flight.row() | {"seed": course.seed, "difficulty": difficulty._asdict()}
        for course, flown in flights
        for flight, difficulty in zip(flown, grades[course], strict=True)
    ]


def _graded(course: Course, *, hidden: int | None) -> tuple[Course, Sequence[Any]]:
    return course, real_course(course, hidden).graded()


def check_begins(robot: str, course: Course) -> None:
    """Check that a user's own robot starts, so that a typo is not flown 1500 times.

    Args:
        robot: See `robot_maker`.
        course: The first course.

    Raises:
        ScenegenError: It ends before it is ready for its first flight.
    """
    if robot in NAMES:
        return

    pilot = own_robot(robot)
    try:
        pilot.reset(course.simulation(0).about())
    except RobotError as error:
        # one that is slow to start may still fly; that is counted as "hung", flight by flight
        if error.outcome == "crashed":
            raise ScenegenError(f"--robot {robot}: never begins: {error}") from None
    finally:
        pilot.close()


def summary(name: str, flown: Sequence[Flown]) -> Json:
    """Summarise flights.

    Args:
        name: Name of the robot.
        flown: The flights.

    Returns:
        Shares of outcomes, means, extremes and sums, by name.
    """
    ends = Counter(flight.outcome for flight in flown)
    row = {"robot": name, "flights": len(flown)}
    row |= {end: f"{100 * count / len(flown):.0f} %" for end, count in ends.most_common()}
    row |= {
        part: round(float(np.mean([getattr(flight, part) for flight in flown])), 4)
        for part in RATIOS
    }
    row["progress"] = round(float(np.mean([flight.progress for flight in flown])), 4)
    if blocked := [flight.outcome == "success" for flight in flown if flight.blocked]:
        row["success, blocked line"] = f"{100 * np.mean(blocked):.0f} % of {len(blocked)}"
    # the least of all flights: a mean would hide the one that came too near
    row["min_clearance_m"] = round(min(flight.min_clearance_m for flight in flown), 4)
    row["most_step_s"] = round(max(flight.most_step_s for flight in flown), 4)
    return row | {part: sum(getattr(flight, part) for flight in flown) for part in COUNTS}


ANEW = "flown anew, the same"
"""The note that says how many flights a robot flew as they were recorded."""
Work = Callable[[Course], FlownCourse]
"""Function that flies a course."""
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
    """Fly through all courses, and record the flights.

    Courses that `out` already holds of a suite's entry are not flown again. The entry is written
    every `SAVED_S` seconds and when the run is stopped; of other flights, all are kept or none.

    Args:
        courses: The courses.
        work: Flies one.
        name: The robot's name.
        suite: The suite that the courses are of, if any.
        out: Where to record.
        crew: Works through the courses.
        track: Which of the suite's courses these are.
        network: SHA-256 of the robot's network.

    Returns:
        The flights, in the order of the courses.
    """
    entry = Recording(robot=name, suite=suite, track=track, network=network, courses=())
    keys = [entry_course(course) for course in courses]
    # a run has one latency, for all of its courses
    flown = _recorded(out, entry, keys, courses[0].rules.latency_s)
    missing = [course for course, key in zip(courses, keys, strict=True) if key not in flown]

    def save() -> str:
        """Write the entry; return a message for the case that the run is stopped."""
        if out is None:
            return NOTHING_KEPT
        held = replace(entry, courses=[flown[key] for key in keys if key in flown])
        # an entry that is there was read, wherever it was copied from
        write = write_atomic if suite and out.exists() else write_result
        write(out, replace(held, complete=is_whole(held)).encoded())
        count = f"{len(held.courses)} of {len(keys)} courses"
        return f"stopped; {out} holds {count}: give the same command again to go on"

    # a suite takes hours: it is written every `SAVED_S`, so that even a kill loses little
    saved_s, total = time.monotonic(), sum(course.flights for course in missing)
    with undone_if_stopped(save if suite else lambda: NOTHING_KEPT):
        try:
            for course, flights in crew(work, missing, total):
                flown[entry_course(course)] = course, flights
                if suite and time.monotonic() - saved_s > SAVED_S:
                    save()
                    saved_s = time.monotonic()
        finally:
            if missing and len(flown) >= (1 if suite else len(keys)):
                save()
    return [(course, flown[key][1]) for course, key in zip(courses, keys, strict=True)]


def _recorded(
    out: Path | None, entry: Recording, keys: Sequence[Course], latency_s: float
) -> dict[Course, FlownCourse]:
    """Read the flights of an entry that `out` already holds, by their courses' names.

    Raises:
        ScenegenError: Flights would be lost.
    """
    if out is None:
        return {}
    if entry.suite is None or not out.exists():
        with suppress(DatasetError):  # another file, or none
            if read_recording(out).suite:
                raise ScenegenError(f"{out}: is an entry to a suite; give another name")
        check_ours(out)
        return {}
    earlier = read_recording(out)
    if (earlier.robot, earlier.suite, earlier.track) != (entry.robot, entry.suite, entry.track):
        raise ScenegenError(
            f"{out}: is of robot {earlier.robot}, suite {earlier.suite} and track "
            f"{earlier.track[:14]}; give another name"
        )
    if earlier.network and entry.network and earlier.network != entry.network:
        raise ScenegenError(f"{out}: is of another network called {entry.robot}; remove it")
    with reraise_as(ScenegenError, f"{out}: ", of=DatasetError):
        was_late = latency_of(earlier)
    if was_late != latency_s:
        raise ScenegenError(
            f"{out}: is of flights with a latency of {was_late} s; give --latency {was_late}, "
            "or another name"
        )
    # writing the entry would lose flights of courses that are not among these
    flown = {entry_course(course): (course, flights) for course, flights in earlier.courses}
    if not flown.keys() <= {*keys}:
        raise ScenegenError(f"{out}: is an entry with other courses, too; give another name")
    return flown


def open_recording(
    path: Path, hidden: int | None, maps: Path | None
) -> tuple[Recording, dict[str, str]]:
    """Read a recording to fly it again.

    Args:
        path: The recording.
        hidden: Number of an entry's hidden track, or None.
        maps: The folder of its maps, if it is an entry to their track.

    Returns:
        The recording, an entry's with the courses of its suite; and notes for the summary.

    Raises:
        DatasetError: A course is not one of its suite's.
        ScenegenError: It is to another track than `hidden` and `maps` say.
    """
    recording = read_recording(path)
    if recording.suite is None:
        if hidden is not None or maps:
            raise ScenegenError(f"{path}: is no entry to a suite; leave out --hidden and --maps")
        return recording, {}
    with reraise_as(DatasetError, f"{path}: ", of=DatasetError):
        part = coverage_of(recording)
    public = recording.track if recording.track in TRACKS else TRACKS[0]
    if recording.track != (track := track_name(public, hidden, maps)):
        raise ScenegenError(
            f"{path}: is an entry to the track {part.track[:14]}, not {track[:14]}; fly "
            "replay takes --hidden and its number, --maps and their folder, or neither"
        )
    # the suite's own courses: a stranger's file could lead to other worlds by the same names
    frozen = {entry_course(course): course for course in frozen_courses(track, maps)}
    courses = [
        (
            replace(
                late(frozen[entry_course(course)], course.rules.latency_s), document=course.document
            ),
            flights,
        )
        for course, flights in recording.courses
    ]
    return replace(recording, courses=courses), {"courses": str(part)}


def fly_again(path: Path, recording: Recording, hidden: int | None, crew: Crew) -> Flights:
    """Replay the recorded flights.

    Args:
        path: The recording's file, for errors.
        recording: The recording.
        hidden: See `real_course`.
        crew: Works through the courses.

    Returns:
        The flights, in the order of the recording.

    Raises:
        DatasetError: A flight is not as it was recorded.
    """
    count = sum(len(flights) for _, flights in recording.courses)
    with reraise_as(DatasetError, f"{path}: ", of=DatasetError):
        again = dict(crew(partial(_replayed, hidden=hidden), recording.courses, count))
    return [(course, again[course]) for course, _ in recording.courses]


def fly_anew(recording: Recording, work: Work, crew: Crew) -> tuple[int, list[Flown]]:
    """Let a robot fly every sixteenth course of a recording.

    Args:
        recording: The recording.
        work: Flies a course.
        crew: Works through the courses.

    Returns:
        How many flights that are, and those that differ from the recording in a bit.
    """
    before = {entry_course(course): flights for course, flights in recording.courses[::QUICK]}
    count, unlike = sum(map(len, before.values())), list[Flown]()
    courses = [course for course, _ in recording.courses[::QUICK]]
    for course, flown in crew(work, courses, count):
        pairs = zip(flown, before[entry_course(course)], strict=True)
        unlike += [again for again, recorded in pairs if again.digest != recorded.digest]
    return count, unlike


def _replayed(recorded: FlownCourse, *, hidden: int | None) -> FlownCourse:
    """Fly the recorded flights of a course again, see `scenegen.fly.course.replay`."""
    course, flights = recorded
    return course, replay(real_course(course, hidden), flights)
