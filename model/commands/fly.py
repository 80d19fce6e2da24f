"""`scenegen fly`: a robot flies to goals through a world, closed loop, and is scored."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.cli.options import (
    command,
    group,
    lidar_option,
    noise_option,
    on_option,
    options_of,
    out_option,
    printing,
    seed_option,
    taken,
    was_given,
    workers_option,
)
from scenegen.cli.show import Progress, announce_compilation, say, show_table
from scenegen.cli.types import FILE, Choice, OutputFile
from scenegen.errors import ScenegenError
from scenegen.files import check_free, write_result
from scenegen.fly import SUITES, Rules, Vehicle
from scenegen.model.commands.weights import Weights
from scenegen.model.robots import MAPPING, NAMES, REACTIVE, fly_course, leaderboard, summary
from scenegen.run import Executor, executor

if TYPE_CHECKING:
    from scenegen.fly.course import Course
    from scenegen.fly.loop import Flown

MOST_FLIGHTS = 10_000
SAVED = 10
"""Courses of a suite after which its entry is written."""


@command(
    "fly pillar --weights columns --flights 20",
    "fly room.xml --robot my_robot:Robot -o flights.json --picture flights.png",
    "fly --suite aerial-1 --robot my_robot:Robot -o entry.json",
    "fly --replay entry.json",
    "fly --leaderboard entries -o page.html",
)
@click.argument("world", required=False)
@click.option(
    "--robot",
    default="optimistic",
    help=f"{', '.join(MAPPING)}, which map and plan; {REACTIVE}; MODULE:CLASS, or a command in "
    "quotes, which run in a process of their own.",
)
@click.option("--weights", type=Weights(), help="The robot maps, and this network completes.")
@click.option(
    "--suite",
    type=Choice(SUITES),
    help="Fly all courses of a suite, in place of WORLD: 300 worlds, or with --quick 19. An entry "
    "that -o has already goes on where it was.",
)
@click.option(
    "--hidden",
    type=click.IntRange(0),
    metavar="SEED",
    help="With --suite: 50 courses that this number draws, in place of the suite's own.",
)
@click.option(
    "--maps",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="With --suite: 24 courses through the maps of real places in this folder, in place of the "
    "suite's own.",
)
@click.option("--quick", is_flag=True, help="With --suite: every sixteenth course.")
@click.option(
    "--flights",
    type=click.IntRange(1, MOST_FLIGHTS),
    default=10,
    help="Starts and goals.",
)
@click.option(
    "--worlds",
    type=click.IntRange(1, MOST_FLIGHTS),
    default=1,
    help="Worlds of a kind, drawn by the seed and those after it; each has its share of the "
    "flights.",
)
@click.option(
    "--difficulty",
    type=Choice(["easy", "medium", "hard"]),
    help="How hard a kind's worlds are.  [default: medium]",
)
@options_of(
    Vehicle,
    radius_m="Radius of the vehicle, metres.",
    speed_mps="Metres a second, at most.",
    acceleration_mps2="Metres a second squared, at most.",
    dynamics="How the vehicle moves: as its bounds say, or as a quadrotor of MuJoCo's that tracks "
    "that, with inertia, rotors and drag.",
)
@options_of(Rules, apart_m="Least distance from start to goal, metres.")
@lidar_option("raster")
@noise_option
@click.option("--moving", is_flag=True, help="Cast each ray from where the sensor is at its time.")
@seed_option("What the world, the goals and the noise are drawn by.")
@click.option(
    "--replay",
    "recorded",
    type=FILE,
    help="Fly what -o wrote again, in place of all else, and compare every bit. With --robot or "
    "--weights, that robot flies every sixteenth course anew, too.",
)
@click.option(
    "--leaderboard",
    "entries",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Write a page (-o, .html) of all entries in a folder, in place of all else.",
)
@out_option("Where to record the flights, .json.", file=True)
@click.option(
    "--picture",
    type=OutputFile(),
    help="A picture (.png) of the first world and the ways through it.",
)
@click.option(
    "--film",
    type=OutputFile(),
    help="A film of the first flight, and what the robot takes for occupied: .gif from above, or "
    ".html, a page that plays it in three dimensions.",
)
@click.option(
    "--log",
    type=click.Path(path_type=Path),
    help="What the sensor saw on the first flight, as `scan --sequence` writes logs: a folder, or "
    ".mcap.",
)
@workers_option
@on_option
@printing
@group("Robot", "robot weights radius speed acceleration dynamics")
@group("Courses", "suite hidden maps quick flights worlds difficulty apart moving replay")
def fly(
    world: str | None,
    robot: str,
    weights: str | None,
    suite: str | None,
    hidden: int | None,
    maps: Path | None,
    quick: bool,
    flights: int,
    worlds: int,
    recorded: Path | None,
    entries: Path | None,
    out: Path | None,
    picture: Path | None,
    film: Path | None,
    log: Path | None,
    workers: int,
    on: str,
    as_json: bool,
    talk: bool,
    **options: Any,
) -> None:
    """Fly a robot to goals through a world, by what its LiDAR sees: ten times a second it decides.

    The world is a kind's name, an MJCF file, or a map of a real place.
    """
    if sum(one is not None for one in (world, recorded, suite, entries)) != 1:
        raise click.UsageError("give a WORLD, --suite, --replay FILE, or --leaderboard FOLDER")
    if entries is not None:
        _write_board(entries, out, talk)
        return
    if suite is None and (quick or hidden is not None or maps):
        raise click.UsageError(
            "--quick, --hidden and --maps choose courses of a suite; give --suite, too"
        )
    if hidden is not None and maps:
        raise click.UsageError("--hidden and --maps choose other courses; give one of them")
    _check_results(film, log, recorded)
    from scenegen.fly.suite import chosen_courses

    if recorded is not None:
        name, found, more = _fly_again(recorded, robot, weights)
    else:
        if talk:
            announce_compilation()
        name, more = weights or robot, {}
        _check(robot, weights)
        courses = (
            _courses(str(world), flights, worlds, options)
            if suite is None
            else chosen_courses(suite, hidden, maps, quick=quick)
        )
        work = partial(fly_course, robot=robot, weights=weights)
        with Progress("fly", shown=talk) as progress:
            found = fly_courses(courses, work, name, suite, out, executor(on, workers), progress)
    if picture is not None:
        _draw(picture, *found[0], name)
    if film is not None:
        _film(film, found[0][0], robot, weights, name)
    if log is not None:
        _log(log, *found[0])
    row = summary(name, [one for _, flown in found for one in flown]) | more
    if as_json:
        print(json.dumps(row | {"flights": _rows(found)}))
    elif talk:
        show_table(row)
        for end in sorted({one.trouble for _, flown in found for one in flown} - {""}):
            say(f"robot: {end}")
        for path in filter(None, (out, picture, film, log)):
            say(f"written: {path}")


def _write_board(entries: Path, out: Path | None, talk: bool) -> None:
    """Write the page of all entries in a folder."""
    if out is None:
        raise click.UsageError("--leaderboard: say where to write the page with -o, .html")
    write_result(out, leaderboard(entries).encode())
    if talk:
        say(f"written: {out}")


def _check_results(film: Path | None, log: Path | None, recorded: Path | None) -> None:
    """Raise, before anything is flown, for results that cannot be written."""
    if film and recorded:
        raise click.UsageError("--film is taken while a robot flies; leave out --replay")
    if film and film.suffix not in (".gif", ".html"):
        raise click.UsageError(f"--film {film}: expected a name that ends in .gif or .html")
    if log is not None:
        check_free(log)


def _rows(found: "Sequence[tuple[Course, Sequence[Flown]]]") -> list[dict[str, Any]]:
    """What `--json` tells of each flight."""
    return [
        one.row() | {"seed": course.seed, "difficulty": grade._asdict()}
        for course, flown in found
        for one, grade in zip(flown, course.graded(), strict=False)
    ]


def _fly_again(
    recorded: Path, robot: str, weights: str | None
) -> "tuple[str, list[tuple[Course, Sequence[Flown]]], dict[str, str]]":
    """The robot of a recording, its flights, flown again, and how many of them are as they were.

    Raises ScenegenError where one is not. A robot that was given flies a part anew.
    """
    from scenegen.fly.course import Recording, replay
    from scenegen.fly.suite import QUICK

    recording, found, told = Recording.read(recorded), list[Any](), {}
    for course, flown, same in replay(recording):
        if not same:
            flight = f"a flight through {course.world}, seed {course.seed},"
            raise ScenegenError(f"{recorded}: {flight} is not as it was recorded")
        if not found or found[-1][0] is not course:
            found.append((course, []))
        found[-1][1].append(flown)
    told["as recorded, to the bit"] = f"{sum(len(flown) for _, flown in found)} flights"
    if weights is not None or was_given("robot"):
        _check(robot, weights)
        some = recording.courses[::QUICK]
        same_count = sum(_flown_anew(one, robot, weights) for one in some)
        count = sum(len(flown) for _, flown in some)
        told["anew, equal to the bit"] = f"{same_count} of {count} flights"
    return recording.robot, found, told


def _flown_anew(recorded: "tuple[Course, Sequence[Flown]]", robot: str, weights: str | None) -> int:
    """How many flights of a course a robot flies to the bit as they were recorded."""
    course, before = recorded
    _, now = fly_course(course, robot=robot, weights=weights)
    return sum(one.digest == other.digest for one, other in zip(before, now, strict=False))


def _courses(world: str, flights: int, worlds: int, options: dict[str, Any]) -> "list[Course]":
    """Courses through a world, or through several of a kind."""
    from scenegen.fly.course import Course

    about: dict[str, Any] = {
        "vehicle": Vehicle(**taken(Vehicle, options)),
        "rules": Rules(**taken(Rules, options)),
        "lidar": options["lidar"] or "raster",
        "noise": options["noise"] or "",
        "difficulty": options["difficulty"],
        "moving": options["moving"],
    }
    shares = [flights // worlds + (n < flights % worlds) for n in range(worlds)]
    return [
        Course(world=world, seed=options["seed"] + n, flights=share, **about)
        for n, share in enumerate(shares)
        if share
    ]


def fly_courses(
    courses: "Sequence[Course]",
    work: "Callable[[Course], tuple[Course, Sequence[Flown]]]",
    name: str,
    suite: str | None,
    out: Path | None,
    execute: Executor,
    progress: Progress,
) -> "list[tuple[Course, Sequence[Flown]]]":
    """The flights through all courses, in their order. What `out` holds of a suite's entry is not
    flown again; it is written anew after every `SAVED` courses."""
    from scenegen.fly.course import Recording

    found = {}
    if suite is not None and out is not None and out.exists():
        former = Recording.read(out)
        if (former.robot, former.suite) != (name, suite):
            raise ScenegenError(
                f"{out}: is an entry of {former.robot} to {former.suite}; give another name"
            )
        there = {replace(course, document=""): flown for course, flown in former.courses}
        found = {c: there[key] for c in courses if (key := replace(c, document="")) in there}
        if len(found) < len(there):  # they would be lost
            raise ScenegenError(f"{out}: is an entry with other courses, too; give another name")
    left = [course for course in courses if course not in found]

    def save() -> None:
        if out is not None:
            flown = [(course, found[course]) for course in courses if course in found]
            write_result(out, Recording(robot=name, suite=suite, courses=flown).encoded())

    for course, flown in execute(work, left, lambda: progress.start(sum(c.flights for c in left))):
        found[course] = flown
        progress.count(len(flown))
        if suite and len(found) % SAVED == 0:
            save()
    if left:
        save()
    return [(course, found[course]) for course in courses]


def _check(robot: str, weights: str | None) -> None:
    """Raise UsageError for a robot that cannot be."""
    from lidarsim.registry import Registry

    if weights is not None and was_given("robot"):
        raise click.UsageError("--weights says which robot flies; leave out --robot")
    if robot not in NAMES and not any(mark in robot for mark in ":/ "):
        raise click.UsageError(Registry("robot", dict.fromkeys(NAMES, "")).unknown(robot))


def _draw(picture: Path, course: "Course", flown: "Sequence[Flown]", name: str) -> None:
    from scenegen.display.oblique import VIEW
    from scenegen.display.panels import RED, to_bytes
    from scenegen.display.pictures import draw_world
    from scenegen.worlds.world import solid

    figure = draw_world(solid(course.drawn, course.world), title=f"{name} in {course.world}")
    for one in flown:
        success = one.outcome == "success"
        figure.axes[0].plot(
            *VIEW.project(one.path).T, color="#1d7a2f" if success else RED, zorder=6
        )
    write_result(picture, to_bytes(figure, ".png"))


def _film(path: Path, course: "Course", robot: str, weights: str | None, name: str) -> None:
    from scenegen.model.robots import robot_maker
    from scenegen.model.robots.film import film, flight_page

    made = robot_maker(robot, weights)(course)
    try:
        taken = (
            film(course, 0, made) if path.suffix == ".gif" else flight_page(course, 0, made, name)
        )
        write_result(path, taken)
    finally:
        getattr(made, "close", lambda: None)()


def _log(path: Path, course: "Course", flown: "Sequence[Flown]") -> None:
    from scenegen.fly.course import log_of
    from scenegen.logs.write import write_log

    write_log(path, log_of(course, 0, flown[0]))
