"""`scenegen fly`: a robot flies to goals through a world, closed loop, and is scored."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.registry import Registry
from scenegen.cli.options import (
    WORLD,
    command,
    difficulty_option,
    executing,
    flags_given,
    group,
    lidar_option,
    noise_option,
    options_of,
    out_option,
    printing,
    seed_option,
    taken,
    was_given,
)
from scenegen.cli.show import Progress, Tell, announce_compilation, say, show_table
from scenegen.cli.types import FILE, Choice, Named, OutputFile
from scenegen.errors import ScenegenError
from scenegen.files import check_free, write_result
from scenegen.fly import SUITES, Rules, Vehicle
from scenegen.model.commands.weights import Weights
from scenegen.model.robots import FORGETFUL, MAPPING, NAMES, REACTIVE
from scenegen.run import Executor, check_together

if TYPE_CHECKING:
    from scenegen.fly.course import Course
    from scenegen.fly.loop import Flown


FOLDER = click.Path(path_type=Path, exists=True, file_okay=False)
"""A folder to read."""
MOST_FLIGHTS = 10_000
OF_WORLD = (
    "flights",
    "worlds",
    "difficulty",
    "lidar",
    "noise",
    "moving",
    "seed",
    *(item.name for kind in (Vehicle, Rules) for item in dataclasses.fields(kind)),
)
"""Options that courses of a suite do not take: theirs are frozen."""


@command(
    "fly pillar --weights columns --flights 20",
    "fly scenes/forest.xml --robot my_robot:Robot -o flights.json --picture flights.png",
    "fly --suite aerial-1 --robot my_robot:Robot -o entry.json",
    "fly --replay entry.json",
    "fly --leaderboard entries -o page.html",
)
@click.argument("world", required=False, type=WORLD)
@click.option(
    "--robot",
    type=Named(Registry("robot", dict.fromkeys(NAMES, "")), paths=True),
    default="optimistic",
    help=f"{', '.join(MAPPING)}, which map and plan; {REACTIVE}; MODULE:CLASS, or a command in "
    "quotes, which run in a process of their own.",
)
@click.option(
    "--weights",
    type=Weights(),
    help="The robot maps, and this network completes: "
    "what all scans say, or with --robot returns the last one.",
)
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
    help="With --suite: 50 courses that this number draws, in place of the suite's own. With "
    "--replay: the number of the entries.",
)
@click.option(
    "--maps",
    type=FOLDER,
    help="With --suite: 24 courses through the maps of real places in this folder, in place of the "
    "suite's own. With --replay: where the entries' maps are.",
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
@difficulty_option
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
@seed_option("Seed of the world, the goals and the noise.")
@click.option(
    "--replay",
    "recorded",
    type=FILE,
    help="Fly what -o wrote again, in place of all else, and compare every bit and figure. With "
    "--robot or --weights, that robot flies every sixteenth course anew, too; exit code 1 if it "
    "flies otherwise.",
)
@click.option(
    "--leaderboard",
    "entries",
    type=FOLDER,
    help="Write a page (-o, .html) of all entries in a folder, in place of all else.",
)
@out_option("Where to record the flights, .json.")
@click.option(
    "--picture",
    type=OutputFile(".png"),
    help="A picture (.png) of the first world and the ways through it.",
)
@click.option(
    "--film",
    type=OutputFile(".gif", ".html"),
    help="A film of the first flight, and what the robot takes for occupied: .gif from above, or "
    ".html, a page that plays it in three dimensions.",
)
@click.option(
    "--log",
    type=click.Path(path_type=Path),
    help="What the sensor saw on the first flight, as `scan --sequence` writes logs: a folder, or "
    ".mcap.",
)
@executing
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
    execute: Executor,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Fly a robot to goals through a world, by what its LiDAR sees: ten times a second it decides.

    The world is a kind's name, an MJCF file, or a map of a real place.
    """
    _check()
    if entries is not None:
        if out is None:
            raise click.UsageError("--leaderboard: say where to write the page with -o, .html")
        from scenegen.model.robots.board import leaderboard

        write_result(out, leaderboard(entries).encode())
        if talk:
            say(f"written: {out}")
        return
    from scenegen.dataset.locate import file_sha256
    from scenegen.fly.suite import chosen_courses, track_name
    from scenegen.model.robots.flights import (
        ANEW,
        check_begins,
        crew_of,
        flown_again,
        fly_course,
        fly_courses,
        real_course,
        rows_of,
        summary,
    )
    from scenegen.worlds.world import solid

    if talk:
        announce_compilation()
    network = ""
    if weights is not None:  # before anything is flown: there may be none
        from scenegen.model.completion.completer import locate

        network = file_sha256(locate(weights))
    is_given = weights is not None or was_given("robot")
    fly_one = partial(fly_course, robot=robot, weights=weights, hidden=hidden)
    check_together(execute, "a row of flights takes")
    notes, unlike = dict[str, str](), list["Flown"]()
    pilot = f"{weights}, last scan" if weights and robot == FORGETFUL else weights or robot
    if recorded is not None:
        anew = fly_one if is_given else None
        with Progress("replay", shown=talk) as progress:
            crew = crew_of(execute, on_start=progress.start, on_done=progress.count)
            name, by_course, notes, unlike = flown_again(recorded, hidden, maps, anew, crew)
    else:
        name = pilot
        if suite is None:
            courses = _courses(str(world), flights, worlds, options)
        else:
            courses = chosen_courses(suite, hidden, maps, quick=quick)
        first = real_course(courses[0], hidden)
        if weights is None:
            check_begins(robot, first)
        if picture is not None:
            solid(first.drawn, first.world)
        about = {"network": network, "track": track_name(hidden, maps) if suite else ""}
        with Progress("fly", shown=talk) as progress:
            crew = crew_of(execute, on_start=progress.start, on_done=progress.count)
            by_course = fly_courses(courses, fly_one, name, suite, out, crew, **about)
    if picture or film or log:
        course, flown = by_course[0]
        shown = (robot, weights) if is_given or not recorded else None
        _show(real_course(course, hidden), flown, name, shown, picture, film, log)
    all_flights = [flight for _, flown in by_course for flight in flown]
    row = summary(name, all_flights) | notes
    if tell(lambda: row | {"flights": rows_of(by_course, hidden, crew_of(execute))}):
        show_table(row)
        for end in sorted({flight.trouble for flight in [*all_flights, *unlike]} - {""}):
            say(f"robot: {end}")
        for path in filter(None, (out, picture, film, log)):
            say(f"written: {path}")
    if unlike:
        raise ScenegenError(
            f"{recorded}: {pilot} flew {notes[ANEW]} as they are recorded; the recording is of "
            f"robot {name}"
        )


def _check() -> None:
    """Raise, before anything is flown, for options that do not go together, and for results that
    cannot be written."""
    context: Any = click.get_current_context()
    asked = SimpleNamespace(**context.params)
    ways = asked.world, asked.suite, asked.recorded, asked.entries
    if sum(one is not None for one in ways) != 1:
        raise click.UsageError("give one of WORLD, --suite, --replay FILE, --leaderboard FOLDER")
    if asked.world is None and (odd := flags_given(OF_WORLD)):
        raise click.UsageError(
            f"{odd[0]}: says how a WORLD is flown through, and none is given; leave it out"
        )
    of_suite = ("quick",) if asked.world is None else ("quick", "hidden", "maps")
    if asked.suite is None and flags_given(of_suite):
        raise click.UsageError(
            "--quick, --hidden and --maps choose courses of a suite; give --suite, too"
        )
    if asked.hidden is not None and asked.maps:
        raise click.UsageError("--hidden and --maps choose other courses; give one of them")
    if asked.weights is not None and was_given("robot") and asked.robot != FORGETFUL:
        raise click.UsageError(
            "--weights says which robot flies; leave out --robot, but for --robot returns, which "
            "completes the last scan alone"
        )
    if asked.out and asked.recorded:
        raise click.UsageError("--replay records nothing; leave out -o")
    if asked.log is not None:
        check_free(asked.log)


def _courses(world: str, flights: int, worlds: int, options: dict[str, Any]) -> "Sequence[Course]":
    """Courses through a world, or through several of a kind."""
    from scenegen.fly.course import Course

    about = {
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


def _show(
    course: "Course",
    flown: "Sequence[Flown]",
    name: str,
    robot: tuple[str, str | None] | None,
    picture: Path | None,
    film: Path | None,
    log: Path | None,
) -> None:
    """Write what is asked for of a course's flights; a film has what the `robot`, named as for
    `robot_maker`, takes for occupied, or else shows the flight alone."""
    if picture is not None:
        from scenegen.display.oblique import VIEW
        from scenegen.display.panels import RED, to_bytes
        from scenegen.display.pictures import draw_world
        from scenegen.worlds.world import solid

        figure = draw_world(solid(course.drawn, course.world), title=f"{name} in {course.world}")
        for one in flown:
            colour = "#1d7a2f" if one.outcome == "success" else RED
            figure.axes[0].plot(*VIEW.project(one.path).T, color=colour, zorder=6)
        write_result(picture, to_bytes(figure, ".png"))
    if film is not None:
        from scenegen.model.robots.film import film as flight_film
        from scenegen.model.robots.film import flight_page
        from scenegen.model.robots.flights import robot_maker

        made = None if robot is None else robot_maker(*robot)(course)
        draw = flight_film if film.suffix == ".gif" else partial(flight_page, name)
        try:
            write_result(film, draw(course, 0, made, flown[0]))
        finally:
            getattr(made, "close", lambda: None)()
    if log is not None:
        from scenegen.fly.course import log_of
        from scenegen.logs.write import write_log

        write_log(log, log_of(course, 0, flown[0]))
