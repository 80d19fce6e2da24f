"""`scenegen fly`: a robot flies to goals, closed loop: through a world or a suite's courses.
Recordings of flights are flown again, and ranked.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.registry import Registry
from scenegen.base.errors import ScenegenError
from scenegen.base.executors import Executor, check_together
from scenegen.base.files import check_free, write_result
from scenegen.cli.bench import Weights
from scenegen.cli.options import (
    WORLD,
    command,
    difficulty_option,
    executing,
    group,
    lidar_option,
    noise_option,
    options_of,
    out_option,
    printing,
    quiet_option,
    seed_option,
    taken,
    together,
    was_given,
)
from scenegen.cli.show import Progress, Tell, announce_compilation, say, show_table
from scenegen.cli.types import FILE, Choice, Named, OutputFile
from scenegen.fly import SUITES, Rules, Vehicle
from scenegen.model.robots import FORGETFUL, MAPPING, NAMES, REACTIVE

if TYPE_CHECKING:
    from scenegen.fly.course import Course, Flights
    from scenegen.fly.loop import Flown


FOLDER = click.Path(path_type=Path, exists=True, file_okay=False)
"""A folder to read."""
MAX_FLIGHTS = 10_000

robot_options = together(
    click.option(
        "--robot",
        type=Named(Registry("robot", dict.fromkeys(NAMES, "")), paths=True),
        default="optimistic",
        help=f"{', '.join(MAPPING)}, which map and plan; {REACTIVE}; MODULE:CLASS, or a command in "
        "quotes, which run in a process of their own.",
    ),
    click.option(
        "--weights",
        type=Weights(),
        help="The robot maps, and this network completes: what all scans say, or with --robot "
        "returns the last one.",
    ),
)
picture_options = together(
    click.option(
        "--picture",
        type=OutputFile(".png"),
        help="A picture (.png) of the first world and the ways through it.",
    ),
    click.option(
        "--film",
        type=OutputFile(".html"),
        help="A page (.html) that plays the first flight, and what the robot takes for occupied.",
    ),
    click.option(
        "--log",
        type=click.Path(path_type=Path),
        help="What the sensor saw on the first flight, as `scan --sequence` writes logs: a folder, "
        "or .mcap.",
    ),
    group("What is drawn", "picture film log"),
    executing,
    printing,
)


def track_options(hidden: str, maps: str) -> Callable[[Any], Any]:
    """--hidden and --maps, with their texts."""
    return together(
        click.option("--hidden", type=click.IntRange(0), metavar="SEED", help=hidden),
        click.option("--maps", type=FOLDER, help=maps),
    )


@click.group()
def fly() -> None:
    """Fly a robot to goals by what its LiDAR sees, closed loop; check and rank recordings."""


@command(
    "fly world pillar --weights columns --flights 20",
    "fly world scenes/forest.xml --robot my_robot:Robot -o flights.json --picture flights.png",
)
@click.argument("name", metavar="WORLD", type=WORLD)
@robot_options
@click.option(
    "--flights", type=click.IntRange(1, MAX_FLIGHTS), default=10, help="Starts and goals."
)
@click.option(
    "--worlds",
    type=click.IntRange(1, MAX_FLIGHTS),
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
@out_option("Where to record the flights, .json.")
@picture_options
@group("Robot", "robot weights radius speed acceleration dynamics")
@group("Courses", "flights worlds difficulty apart moving seed")
def world(
    name: str,
    flights: int,
    worlds: int,
    seed: int,
    difficulty: str | None,
    lidar: str | None,
    noise: str | None,
    moving: bool,
    **options: Any,
) -> None:
    """Fly a robot through a world: a kind's, an MJCF file, or a map of a real place.

    Ten times a second the sensor scans, and the robot decides.
    """
    from scenegen.fly.course import Course

    parts: Any = (
        kind(**{field: options.pop(field) for field in taken(kind, options)})
        for kind in (Vehicle, Rules)
    )
    vehicle, rules = parts
    shares = [flights // worlds + (n < flights % worlds) for n in range(worlds)]
    courses = [
        Course(
            world=name,
            seed=seed + n,
            flights=share,
            difficulty=difficulty,
            lidar=lidar or "raster",
            noise=noise or "",
            moving=moving,
            vehicle=vehicle,
            rules=rules,
        )
        for n, share in enumerate(shares)
        if share
    ]
    _fly(courses, **options)


@command(
    "fly suite --robot my_robot:Robot -o entry.json",
    "fly suite --quick --weights columns -o quick.json",
)
@click.argument("suite", metavar="[SUITE]", type=Choice(SUITES), default=SUITES[0])
@robot_options
@click.option("--quick", is_flag=True, help="Every sixteenth course.")
@track_options(
    "50 courses that this number draws, in place of the suite's own.",
    "24 courses through the maps of real places in this folder, in place of the suite's own.",
)
@out_option("The entry, .json; one that is there goes on where it was.")
@picture_options
@group("Robot", "robot weights")
@group("Courses", "quick hidden maps")
def suite(suite: str, quick: bool, hidden: int | None, maps: Path | None, **options: Any) -> None:
    """Fly a robot through all courses of a suite: 300 worlds, or with --quick 19."""
    from scenegen.fly.suite import chosen_courses

    track = _track(hidden, maps)
    courses = chosen_courses(suite, hidden, maps, quick=quick)
    _fly(courses, suite=suite, hidden=hidden, track=track, **options)


def _track(hidden: int | None, maps: Path | None) -> str:
    """The name of the track. Raises UsageError where both are given."""
    from scenegen.fly.suite import track_name

    if hidden is not None and maps:
        raise click.UsageError("--hidden and --maps choose other courses; give one of them")
    return track_name(hidden, maps)


def _fly(
    courses: "Sequence[Course]",
    *,
    robot: str,
    weights: str | None,
    out: Path | None,
    talk: bool,
    execute: Executor,
    suite: str | None = None,
    hidden: int | None = None,
    track: str = "",
    **shown: Any,
) -> None:
    """Fly through courses, record that, and print and draw it."""
    from scenegen.model.robots.flights import check_begins, crew_of, fly_courses, real_course

    name, network, work = _begin(robot, weights, hidden, shown["log"], execute, talk)
    first = real_course(courses[0], hidden)
    if weights is None:
        check_begins(robot, first)
    if shown["picture"]:
        from scenegen.worlds.world import solid

        solid(first.drawn, first.world)
    with Progress("fly", shown=talk) as progress:
        crew = crew_of(execute, on_start=progress.start, on_done=progress.count)
        flown = fly_courses(courses, work, name, suite, out, crew, track=track, network=network)
    crew = crew_of(execute)
    _show(flown, name, (robot, weights), hidden=hidden, crew=crew, files=[out], **shown)


def _begin(
    robot: str,
    weights: str | None,
    hidden: int | None,
    log: Path | None,
    execute: Executor,
    talk: bool,
) -> tuple[str, str, Any]:
    """The robot's name, the SHA-256 of its network, and what flies it through a course. Raises
    before anything is flown for what cannot be."""
    from scenegen.dataset.locate import file_sha256
    from scenegen.model.completion.completer import locate
    from scenegen.model.robots.flights import fly_course

    if weights is not None and was_given("robot") and robot != FORGETFUL:
        raise click.UsageError(
            "--weights says which robot flies; leave out --robot, but for --robot returns, which "
            "completes the last scan alone"
        )
    if log is not None:
        check_free(log)
    check_together(execute, "a row of flights takes")
    if talk:
        announce_compilation()
    name, network = robot, ""
    if weights is not None:
        name = f"{weights}, last scan" if robot == FORGETFUL else weights
        network = file_sha256(locate(weights))
    work = partial(fly_course, robot=robot, weights=weights, hidden=hidden)
    return name, network, work


@command("fly replay entry.json", "fly replay entry.json --robot my_robot:Robot")
@click.argument("path", metavar="RECORDING", type=FILE)
@robot_options
@track_options("The number of an entry's hidden track.", "Where an entry's maps are.")
@picture_options
@group("Robot", "robot weights")
@group("Courses", "hidden maps")
def replay(
    path: Path,
    robot: str,
    weights: str | None,
    hidden: int | None,
    maps: Path | None,
    talk: bool,
    execute: Executor,
    **shown: Any,
) -> None:
    """Fly a recording again, and compare every bit and figure.

    With --robot or --weights, that robot flies every sixteenth course anew, too; exit code 1 if it
    flies otherwise.
    """
    from scenegen.model.robots.flights import ANEW, crew_of, fly_again, fly_anew, open_recording

    track = _track(hidden, maps)
    pilot, _, work = _begin(robot, weights, hidden, shown["log"], execute, talk)
    recording, notes = open_recording(path, track, maps)
    name, unlike, filmed = recording.robot, list["Flown"](), None
    with Progress("replay", shown=talk) as progress:
        crew = crew_of(execute, on_start=progress.start, on_done=progress.count)
        flown = fly_again(path, recording, hidden, crew)
        notes["as recorded, to the bit"] = f"{sum(len(flights) for _, flights in flown)} flights"
        if weights is not None or was_given("robot"):
            filmed = robot, weights
            count, unlike = fly_anew(recording, work, crew)
            notes[ANEW] = f"{count - len(unlike)} of {count} flights"
    crew = crew_of(execute)
    _show(flown, name, filmed, notes, unlike, hidden=hidden, crew=crew, files=[], **shown)
    if unlike:
        raise ScenegenError(
            f"{path}: {pilot} flew {notes[ANEW]} as they are recorded; the recording is of robot "
            f"{name}"
        )


@command("fly rank entries -o page.html")
@click.argument("entries", type=FOLDER)
@out_option("The page.", ".html", required=True)
@quiet_option
def rank(entries: Path, out: Path, quiet: bool) -> None:
    """Write a page that ranks the entries to a suite in a folder."""
    from scenegen.model.robots.board import leaderboard

    write_result(out, leaderboard(entries).encode())
    if not quiet:
        say(f"written: {out}")


for subcommand in (world, suite, replay, rank):
    fly.add_command(subcommand)


def _show(
    flown: "Flights",
    name: str,
    filmed: tuple[str, str | None] | None,
    notes: Mapping[str, str] = MappingProxyType({}),
    unlike: "Sequence[Flown]" = (),
    *,
    hidden: int | None,
    crew: Callable[..., Any],
    tell: Tell,
    files: Sequence[Path | None],
    picture: Path | None,
    film: Path | None,
    log: Path | None,
) -> None:
    """Draw the first course's flights, and print the figures of all, with `notes`, what was wrong
    with the robot, also in flights that are `unlike` recorded ones, and which `files` were written.

    A film has what the robot `filmed`, named as for `robot_maker`, takes for occupied, or else
    shows the flight alone.
    """
    from scenegen.model.robots.flights import real_course, robot_maker, rows_of, summary

    (first, ways), *_ = flown
    course = real_course(first, hidden)
    if picture is not None:
        from scenegen.view.canvas import VIEW
        from scenegen.view.panels import RED, to_bytes
        from scenegen.view.pictures import draw_world
        from scenegen.worlds.world import solid

        figure = draw_world(solid(course.drawn, course.world), title=f"{name} in {course.world}")
        for flight in ways:
            colour = "#1d7a2f" if flight.outcome == "success" else RED
            figure.axes[0].plot(*VIEW.project(flight.path).T, color=colour, zorder=6)
        write_result(picture, to_bytes(figure, ".png"))
    if film is not None:
        from scenegen.model.robots.film import flight_page

        robot = None if filmed is None else robot_maker(*filmed)(course)
        try:
            write_result(film, flight_page(name, course, 0, robot, ways[0]))
        finally:
            getattr(robot, "close", lambda: None)()
    if log is not None:
        from scenegen.fly.course import log_of
        from scenegen.logs.record import write_log

        write_log(log, log_of(course, 0, ways[0]))
    flights = [flight for _, several in flown for flight in several]
    row = {**summary(name, flights), **notes}
    if tell(lambda: row | {"flights": rows_of(flown, hidden, crew)}):
        show_table(row)
        for trouble in sorted({flight.trouble for flight in [*flights, *unlike]} - {""}):
            say(f"robot: {trouble}")
        for path in filter(None, (*files, picture, film, log)):
            say(f"written: {path}")
