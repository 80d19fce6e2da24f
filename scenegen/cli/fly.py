"""`scenegen fly`: flies a robot to goals in closed loop, through a world or a suite's courses.
Replays and ranks recordings of flights.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.parameters import Bounds
from lidarsim.registry import Registry
from scenegen.base.errors import ScenegenError
from scenegen.base.executors import Executor, check_together
from scenegen.base.files import write_result
from scenegen.cli.bench import Weights
from scenegen.cli.options import (
    WORLD,
    command,
    difficulty_option,
    executing,
    fields_in,
    group,
    lidar_option,
    noise_option,
    options_of,
    out_option,
    printing,
    quiet_option,
    seed_option,
    together,
    was_given,
)
from scenegen.cli.show import ProgressBar, Reporter, announce_compilation, echo, show_table
from scenegen.cli.types import FILE, Choice, Named, Number, OutputFile
from scenegen.fly import SUITES, TRACKS, Rules, Vehicle
from scenegen.logs import check_log
from scenegen.model.robots import (
    BRAKING,
    LEAST_DOUBT,
    MAPPING,
    NAMES,
    REACTIVE,
    WITH_NETWORK,
    robot_name,
)
from scenegen.worlds.traffic import PRESETS as TRAFFIC

if TYPE_CHECKING:
    from scenegen.fly.course import Course, Flights
    from scenegen.fly.loop import Flown


FOLDER = click.Path(path_type=Path, exists=True, file_okay=False)
"""Type of a folder to read."""
MAX_FLIGHTS = 10_000
"""Maximum of --flights and of --worlds."""

robot_options = together(
    click.option(
        "--robot",
        type=Named(Registry("robot", dict.fromkeys(NAMES, "")), paths=True),
        default="optimistic",
        help=f"{', '.join(MAPPING)}, which map and plan; {REACTIVE}; or your own as MODULE:CLASS "
        "or a command in quotes, which run in another process.",
    ),
    click.option(
        "--weights",
        type=Weights(),
        help="Network that completes the robot's map, or with --robot returns the last scan; with "
        "--robot sampling, it plans by RRT*.",
    ),
    click.option(
        "--brakes",
        is_flag=True,
        help="On its path, the robot is never faster than it can stop before the first voxel that "
        "it has not seen, but at least 0.25 m/s.",
    ),
    click.option(
        "--doubt",
        type=Number(Bounds(above=LEAST_DOUBT, maximum=1)),
        help="With --brakes: only for unseen voxels whose predicted probability of being occupied "
        "is at least this.",
    ),
)
picture_options = together(
    click.option(
        "--picture",
        type=OutputFile(".png"),
        help="A picture (.png) of the first world and the paths through it.",
    ),
    click.option(
        "--film",
        type=OutputFile(".html"),
        help="A page (.html) that plays the first flight, with the robot's map.",
    ),
    click.option(
        "--log",
        type=click.Path(path_type=Path),
        help="A log of the first flight, as of `scan --sequence`: a folder, or .mcap.",
    ),
    group("What is drawn", "picture film log"),
    executing,
    printing,
)


def track_options(hidden: str, maps: str) -> Callable[[Any], Any]:
    """Make the options --hidden and --maps.

    Args:
        hidden: Help text of --hidden.
        maps: Help text of --maps.
    """
    return together(
        click.option("--hidden", type=click.IntRange(0), metavar="SEED", help=hidden),
        click.option("--maps", type=FOLDER, help=maps),
    )


@click.group()
def fly() -> None:
    """Fly a robot with a LiDAR to goals in closed loop; replay and rank recordings."""


@command(
    "fly world pillar --weights columns --flights 20",
    "fly world scenes/forest.xml --robot my_robot:Robot -o flights.json --picture flights.png",
)
@click.argument("name", metavar="WORLD", type=WORLD)
@robot_options
@click.option(
    "--flights", type=click.IntRange(1, MAX_FLIGHTS), default=10, help="Number of flights."
)
@click.option(
    "--worlds",
    type=click.IntRange(1, MAX_FLIGHTS),
    default=1,
    help="Number of worlds of a kind, drawn by the seed and those after it. Flights are divided "
    "among them.",
)
@difficulty_option
@options_of(
    Vehicle,
    radius_m="Radius of the vehicle, metres.",
    speed_mps="Maximum speed, metres a second.",
    acceleration_mps2="Maximum acceleration, metres a second squared.",
    dynamics="kinematic: the vehicle moves exactly within its bounds. mujoco: a quadrotor with "
    "inertia, rotors and drag tracks that motion.",
)
@options_of(
    Rules,
    apart_m="Minimum distance from start to goal, metres.",
    latency_s="Time until the vehicle does what was decided on a scan, seconds.",
    drift_m="Standard deviation of the robot's position after 100 m, metres.",
    drift_deg="Standard deviation of the robot's yaw after 100 m, degrees.",
)
@lidar_option("raster")
@noise_option
@click.option("--moving", is_flag=True, help="Cast each ray from where the sensor is at its time.")
@click.option(
    "--movers",
    type=Choice(TRAFFIC),
    help="People, vehicles and drones that move; a file's own are kept.",
)
@click.option(
    "--scans",
    type=click.IntRange(1, 10),
    default=1,
    help="Number of scans of an observation: the last one and those before.",
)
@seed_option("Seed of the world, the goals and the noise.")
@out_option("File for a recording of the flights, .json.")
@picture_options
@group(
    "Robot",
    "robot weights brakes doubt scans latency drift drift-deg radius speed acceleration dynamics",
)
@group("Courses", "flights worlds difficulty movers apart moving seed")
def world(
    name: str,
    flights: int,
    worlds: int,
    seed: int,
    difficulty: str | None,
    lidar: str | None,
    noise: str | None,
    moving: bool,
    movers: Any,
    scans: int,
    **options: Any,
) -> None:
    """Fly a robot through a world: a kind's, an MJCF file, or a map of a real place.

    Ten times a second the sensor scans, and the robot decides.

    \f
    Raises:
        UsageError: Options contradict each other.
        ScenegenError: There is no such robot or world, or the world is too narrow.
    """
    # imported here: help pages do without NumPy and MuJoCo
    from scenegen.fly.course import Course

    # click gives the options of both dataclasses in one dictionary
    parts: Any = (
        kind(**{field: options.pop(field) for field in fields_in(kind, options)})
        for kind in (Vehicle, Rules)
    )
    vehicle, rules = parts
    # the first worlds get a flight more if the number cannot be divided
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
            movers=movers or "",
            scans=scans,
            vehicle=vehicle,
            rules=rules,
        )
        for n, share in enumerate(shares)
        if share
    ]
    _fly(courses, **options)


@command(
    "fly suite --robot my_robot:Robot -o entry.json",
    "fly suite --track movers --quick --robot predicting --brakes -o quick.json",
)
@click.argument("suite", metavar="[SUITE]", type=Choice(SUITES), default=SUITES[0])
@robot_options
@click.option(
    "--track", type=Choice(TRACKS), default=TRACKS[0], help="Which of the suite's courses to fly."
)
@options_of(Rules, latency_s="What a decision of the robot takes, seconds: it comes as late.")
@click.option("--quick", is_flag=True, help="Every sixteenth course.")
@track_options(
    "Fly 50 courses that this number draws: the track hidden.",
    "Fly 56 courses through the maps of real places in this folder: the track places.",
)
@out_option("The entry, .json; an unfinished one is continued.")
@picture_options
@group("Robot", "robot weights brakes doubt latency")
@group("Courses", "track quick hidden maps")
def suite(
    suite: str,
    track: str,
    latency_s: float,
    quick: bool,
    hidden: int | None,
    maps: Path | None,
    **options: Any,
) -> None:
    """Fly a robot through all courses of a track of a suite.

    \f
    Raises:
        UsageError: Options contradict each other.
        ScenegenError: There is no such robot, or a map is missing.
    """
    from scenegen.fly.suite import chosen_courses, late, track_name

    if was_given("track") + (hidden is not None) + (maps is not None) > 1:
        raise click.UsageError(
            "--track, --hidden and --maps choose other courses; give one of them"
        )
    track = track_name(track, hidden, maps)
    courses = [late(course, latency_s) for course in chosen_courses(track, maps, quick=quick)]
    _fly(courses, suite=suite, hidden=hidden, track=track, **options)


def _fly(
    courses: "Sequence[Course]",
    *,
    robot: str,
    weights: str | None,
    brakes: bool,
    doubt: float | None,
    out: Path | None,
    verbose: bool,
    execute: Executor,
    suite: str | None = None,
    hidden: int | None = None,
    track: str = "",
    **drawing: Any,
) -> None:
    """Fly through courses, record the flights, and print and draw them. Raises UsageError for a
    recording whose name does not end in .json."""
    from scenegen.model.robots.flights import check_begins, crew_of, fly_courses, real_course

    if out is not None and out.suffix != ".json":
        raise click.UsageError(f"-o {out}: expected a name that ends in .json")
    robot_settings = robot, weights, _braking(brakes, doubt)
    name, network, work = _begin(robot_settings, hidden, drawing["log"], execute, verbose)
    # wrong robots and worlds are refused here, before any worker starts
    first = real_course(courses[0], hidden)
    _ = first.drawn
    if weights is None:  # a network's robot is scenegen's own
        check_begins(robot, first)
    if drawing["picture"]:
        from scenegen.worlds.world import solid

        # a map has no solids to draw: refused before the flights
        solid(first.drawn, first.world)
    with ProgressBar("fly", visible=verbose) as progress:
        crew = crew_of(execute, on_start=progress.start, on_done=progress.count)
        flown = fly_courses(courses, work, name, suite, out, crew, track=track, network=network)
    # without a bar, for the difficulties of courses in --json
    _show(flown, name, robot_settings, hidden=hidden, crew=crew_of(execute), files=[out], **drawing)


def _braking(brakes: bool, doubt: float | None) -> float | None:
    """Return `brakes` of a robot, see `robot_maker`. Raises UsageError for --doubt alone."""
    if doubt is not None and not brakes:
        raise click.UsageError("--doubt says for what the robot brakes; add --brakes")
    return (doubt or 0.0) if brakes else None


def _begin(
    robot_settings: tuple[str, str | None, float | None],
    hidden: int | None,
    log: Path | None,
    execute: Executor,
    verbose: bool,
) -> tuple[str, str, Any]:
    """Check the options of a robot, given as for `robot_maker`.

    Returns:
        The robot's name, the SHA-256 of its network or "", and a function that flies it through a
        course.

    Raises:
        UsageError: Options contradict each other.
        ScenegenError: The log exists or has a wrong name, or there is no such network.
    """
    from scenegen.dataset.locate import file_sha256
    from scenegen.model.completion.completer import locate
    from scenegen.model.robots.flights import fly_course

    robot, weights, brakes = robot_settings
    if brakes is not None and weights is None and robot not in BRAKING:
        raise click.UsageError(
            f"--brakes: {robot} has no map of what it has seen; expected --weights, or --robot "
            f"{', '.join(BRAKING)}"
        )
    if weights is not None and was_given("robot") and robot not in WITH_NETWORK:
        raise click.UsageError(
            "--weights chooses the robot; leave out --robot, or give --robot returns, which "
            "completes only the last scan, or --robot sampling, which plans by RRT*"
        )
    if log is not None:
        check_log(log)  # before the flights: a log is never replaced
    check_together(execute, "a row of flights takes")
    if verbose:
        announce_compilation()
    name, network = robot, ""
    if weights is not None:
        name = f"{weights}, {WITH_NETWORK[robot]}" if robot in WITH_NETWORK else weights
        network = file_sha256(locate(weights))
    name = robot_name(name, brakes)
    work = partial(fly_course, robot=robot, weights=weights, brakes=brakes, hidden=hidden)
    return name, network, work


@command("fly replay entry.json", "fly replay entry.json --robot my_robot:Robot")
@click.argument("path", metavar="RECORDING", type=FILE)
@robot_options
@track_options("Number of an entry's hidden track.", "Folder of an entry's maps.")
@picture_options
@group("Robot", "robot weights brakes doubt")
@group("Courses", "hidden maps")
def replay(
    path: Path,
    robot: str,
    weights: str | None,
    brakes: bool,
    doubt: float | None,
    hidden: int | None,
    maps: Path | None,
    verbose: bool,
    execute: Executor,
    **drawing: Any,
) -> None:
    """Fly a recording's commands again, and compare every bit and figure.

    With --robot, --weights or --brakes, also let that robot fly every sixteenth course anew; exit
    code 1 if its flights differ from the recording.

    \f
    Raises:
        UsageError: Options contradict each other.
        DatasetError: The file is not a recording, or a flight differs from it.
        ScenegenError: The robot flies differently.
    """
    from scenegen.model.robots.flights import ANEW, crew_of, fly_again, fly_anew, open_recording

    if hidden is not None and maps:
        raise click.UsageError("--hidden and --maps are of other entries; give one of them")
    robot_settings = robot, weights, _braking(brakes, doubt)
    pilot, _, work = _begin(robot_settings, hidden, drawing["log"], execute, verbose)
    recording, notes = open_recording(path, hidden, maps)
    name, differing, filmed = recording.robot, list["Flown"](), None
    with ProgressBar("replay", visible=verbose) as progress:
        crew = crew_of(execute, on_start=progress.start, on_done=progress.count)
        flown = fly_again(path, recording, hidden, crew)
        notes["as recorded, to the bit"] = f"{sum(len(flights) for _, flights in flown)} flights"
        # only a robot that the user names: the default one may not be that of the recording
        if weights is not None or was_given("robot") or brakes:
            filmed = robot_settings
            count, differing = fly_anew(recording, work, crew)
            notes[ANEW] = f"{count - len(differing)} of {count} flights"
    crew = crew_of(execute)
    _show(flown, name, filmed, notes, differing, hidden=hidden, crew=crew, files=[], **drawing)
    if differing:
        raise ScenegenError(
            f"{path}: {pilot} flew {notes[ANEW]} as they are recorded; the recording is of robot "
            f"{name}"
        )


@command("fly rank entries -o page.html")
@click.argument("entries", type=FOLDER)
@out_option("The page.", ".html", required=True)
@quiet_option
def rank(entries: Path, out: Path, quiet: bool) -> None:
    """Write a page that ranks the entries to a suite in a folder.

    \f
    Raises:
        ScenegenError: The folder has no entries.
        DatasetError: A file is not an entry.
    """
    from scenegen.model.robots.board import leaderboard

    write_result(out, leaderboard(entries, out).encode())
    if not quiet:
        echo(f"written: {out}")


for subcommand in (world, suite, replay, rank):
    fly.add_command(subcommand)


def _show(
    flown: "Flights",
    name: str,
    filmed: tuple[str, str | None, float | None] | None,
    notes: Mapping[str, str] = MappingProxyType({}),
    differing: "Sequence[Flown]" = (),
    *,
    hidden: int | None,
    crew: Callable[..., Any],
    report_result: Reporter,
    files: Sequence[Path | None],
    picture: Path | None,
    film: Path | None,
    log: Path | None,
) -> None:
    """Draw the flights of the first course, and print figures of all.

    Args:
        flown: All flights.
        name: Name of the robot.
        filmed: The robot, named as for `robot_maker`, whose map the film shows; None: no map.
        notes: Further lines of the table.
        differing: Flights that differ from recorded ones; errors of the robot are printed.
        hidden: Number of the hidden track, or None.
        crew: Runs work on the cores, for the difficulties of the courses.
        report_result: Prints the result as JSON if the user wants that.
        files: Files written so far.
        picture: File of the picture, or None.
        film: File of the film, or None.
        log: File or folder of the log, or None.
    """
    from scenegen.model.robots.flights import real_course, robot_maker, rows_of, summary

    (first, ways), *_ = flown
    # recordings hide the seeds of a hidden track; drawing needs them
    course = real_course(first, hidden)
    if picture is not None:
        from scenegen.fly.simulation import HITS
        from scenegen.view.opened import look_of_world
        from scenegen.view.stills import draw, to_bytes, with_path

        look = look_of_world(course.drawn, course.world)
        for n, (flight, mission) in enumerate(zip(ways, course.missions, strict=True), 1):
            hit = flight.path[-1] if flight.outcome in HITS else None
            look = with_path(look, f"{n}: {flight.outcome}", flight.path, mission.goal, hit)
        figure = draw([look], "paths", title=f"{name} in {course.world}")
        write_result(picture, to_bytes(figure, ".png"))
    if film is not None:
        from scenegen.model.robots.film import looks_of_flight
        from scenegen.view.page import page

        robot = None if filmed is None else robot_maker(*filmed)(course)
        try:
            looks = looks_of_flight(name, course, 0, robot, ways)
            title = f"{name} in {course.world}"
            write_result(film, page(looks, title=title, film=True).encode())
        finally:
            getattr(robot, "close", lambda: None)()  # a robot of another process has one
    if log is not None:
        from scenegen.fly.course import flight_log
        from scenegen.logs.record import write_log

        write_log(log, flight_log(course, 0, ways[0]))
    flights = [flight for _, several in flown for flight in several]
    row = {**summary(name, flights), **notes}
    # a function, since grading courses takes time, and only --json shows it
    if report_result(lambda: row | {"flights": rows_of(flown, hidden, crew)}):
        show_table(row)
        for trouble in sorted({flight.trouble for flight in [*flights, *differing]} - {""}):
            echo(f"robot: {trouble}")
        for path in filter(None, (*files, picture, film, log)):
            echo(f"written: {path}")
