"""`scenegen fly`: a robot flies to goals through a world, closed loop, and is scored."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.cli.options import (
    examples,
    lidar_option,
    noise_option,
    on_option,
    options_of,
    out_option,
    printing,
    seed_option,
    taken,
    workers_option,
)
from scenegen.cli.show import Progress, announce_compilation, say, show_table
from scenegen.cli.types import OutputFile
from scenegen.errors import ScenegenError
from scenegen.fly import Rules, Vehicle
from scenegen.model.commands.weights import Weights
from scenegen.model.robots import MAPPING, NAMES, REACTIVE, fly_course, summary

if TYPE_CHECKING:
    from scenegen.fly.course import Course
    from scenegen.fly.loop import Flown

MOST_FLIGHTS = 10_000


@click.command(
    epilog=examples(
        "fly pillar --weights columns --flights 20",
        "fly room.xml --robot my_robot:Robot -o flights.json --picture flights.png",
        "fly --replay flights.json",
    )
)
@click.argument("world", required=False)
@click.option(
    "--robot",
    default="optimistic",
    show_default=True,
    help=f"{', '.join(MAPPING)}, which map and plan; {REACTIVE}; MODULE:CLASS, or a command in "
    "quotes, which run in a process of their own.",
)
@click.option("--weights", type=Weights(), help="The robot maps, and this network completes.")
@click.option(
    "--flights",
    type=click.IntRange(1, MOST_FLIGHTS),
    default=10,
    show_default=True,
    help="Starts and goals.",
)
@click.option(
    "--worlds",
    type=click.IntRange(1, MOST_FLIGHTS),
    default=1,
    show_default=True,
    help="Worlds of a kind, drawn by the seed and those after it; each has its share of the "
    "flights.",
)
@click.option(
    "--difficulty",
    type=click.Choice(["easy", "medium", "hard"]),
    help="How hard a kind's worlds are.  [default: medium]",
)
@options_of(
    Vehicle,
    radius_m="Radius of the vehicle, metres.",
    speed_mps="Metres a second, at most.",
    acceleration_mps2="Metres a second squared, at most.",
)
@options_of(Rules, apart_m="Least distance from start to goal, metres.")
@lidar_option("raster")
@noise_option
@click.option("--moving", is_flag=True, help="Cast each ray from where the sensor is at its time.")
@seed_option("What the world, the goals and the noise are drawn by.")
@click.option(
    "--replay",
    "recorded",
    type=click.Path(path_type=Path),
    help="Fly what -o wrote again, in place of all else, and compare every bit.",
)
@out_option("Where to record the flights, .json.", file=True)
@click.option(
    "--picture",
    type=OutputFile(),
    help="A picture (.png) of the first world and the ways through it.",
)
@workers_option
@on_option
@printing
def fly(
    world: str | None,
    robot: str,
    weights: str | None,
    flights: int,
    worlds: int,
    recorded: Path | None,
    out: Path | None,
    picture: Path | None,
    workers: int,
    on: str,
    as_json: bool,
    talk: bool,
    **options: Any,
) -> None:
    """Fly a robot to goals through a world, by what its LiDAR sees: ten times a second it decides.

    The world is a kind's name, an MJCF file, or a map of a real place.
    """
    if (world is None) == (recorded is None):
        raise click.UsageError("give a WORLD, or --replay FILE")
    from scenegen.fly.course import Course, encode_recording, read_recording, replay

    trouble = ""
    if recorded is not None:
        name, found = read_recording(recorded)[0], []
        for course, again, same in replay(recorded):
            found.append((course, [again]))
            trouble = trouble if same else f"{recorded}: a flight is not as it was recorded"
    else:
        from scenegen.run import executor

        if talk:
            announce_compilation()
        name, found = weights or robot, []
        _check(robot, weights)
        parts: dict[str, Any] = {
            "vehicle": Vehicle(**taken(Vehicle, options)),
            "rules": Rules(**taken(Rules, options)),
        }
        options = {key: options[key] for key in ("difficulty", "moving", "seed")} | {
            "lidar": options["lidar"] or "raster",
            "noise": options["noise"] or "",
        }
        first = options.pop("seed")
        shares = [flights // worlds + (n < flights % worlds) for n in range(worlds)]
        courses = [
            Course(world=str(world), seed=first + n, flights=share, **parts, **options)
            for n, share in enumerate(shares)
            if share
        ]
        with Progress("fly", shown=talk) as progress:
            work = partial(fly_course, robot=robot, weights=weights)
            for course, flown in executor(on, workers)(
                work, courses, lambda: progress.start(flights)
            ):
                found.append((course, flown))
                progress.count(len(flown))
        found.sort(key=lambda one: one[0].seed)
    if out is not None:
        from scenegen.files import write_result

        write_result(out, encode_recording(name, found))
    if picture is not None:
        _draw(picture, *found[0], name)
    row = summary(name, [one for _, flown in found for one in flown])
    if as_json:
        rows = [one.row() | {"seed": course.seed} for course, flown in found for one in flown]
        print(json.dumps(row | {"flights": rows}))
    elif talk:
        show_table(row)
        for end in sorted({one.trouble for _, flown in found for one in flown} - {""}):
            say(f"robot: {end}")
    if trouble:
        raise ScenegenError(trouble)


def _check(robot: str, weights: str | None) -> None:
    """Raise UsageError for a robot that cannot be."""
    from lidarsim.registry import Registry
    from scenegen.cli.options import was_given

    if weights is not None and was_given("robot"):
        raise click.UsageError("--weights says which robot flies; leave out --robot")
    if robot not in NAMES and not any(mark in robot for mark in ":/ "):
        raise click.UsageError(Registry("robot", dict.fromkeys(NAMES, "")).unknown(robot))


def _draw(picture: Path, course: "Course", flown: "Sequence[Flown]", name: str) -> None:
    from scenegen.display.oblique import VIEW
    from scenegen.display.panels import RED, to_bytes
    from scenegen.display.pictures import draw_world
    from scenegen.files import write_result
    from scenegen.worlds.world import solid

    figure = draw_world(solid(course.drawn, course.world), title=f"{name} in {course.world}")
    for one in flown:
        success = one.outcome == "success"
        figure.axes[0].plot(
            *VIEW.project(one.path).T, color="#1d7a2f" if success else RED, zorder=6
        )
    write_result(picture, to_bytes(figure, ".png"))
