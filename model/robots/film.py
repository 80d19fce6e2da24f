"""A film of a flight: the truth, the robot's own map and its path, with speed and clearance."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim import GridSpec
from lidarsim.grid import Floats, Mask
from lidarsim.pose import rotate
from lidarsim.voxelization import sort_points
from scenegen.base.errors import DatasetError, ScenegenError
from scenegen.base.files import Json
from scenegen.dataset.locate import file_sha256
from scenegen.draw.movers import mover_voxels
from scenegen.fly import PERIOD_S
from scenegen.fly.course import Course, Recording, compared, flown_again
from scenegen.fly.loop import Flown
from scenegen.fly.motion import POSITION, VELOCITY
from scenegen.fly.simulation import HITS, Observation, Simulation
from scenegen.model.config import split_own
from scenegen.model.robots import NAMES, WITH_NETWORK, split_robot_name
from scenegen.model.robots.flights import open_recording, robot_maker
from scenegen.model.robots.mapping import within
from scenegen.view.look import Guess, Look, PlannedPath, field_of_view
from scenegen.worlds.world import World

PERIODS_PER_PICTURE = 3
"""Periods from picture to picture, at least."""
MAX_PICTURES = 200
"""Maximum pictures of a flight; those of a longer flight are farther apart."""
ENDS = {
    "success": "reaches the goal",
    "collision": "hits an obstacle",
    "struck": "meets a mover",
    "left": "leaves the bounds",
    "timeout": "runs out of time",
    "crashed": "ends because the robot fails",
    "hung": "ends because the robot does not answer",
    "flooded": "ends because the robot writes too much",
}
"""Outcomes in words."""


class _Moment(NamedTuple):
    """Observation at a decision, with the robot's map and plan."""

    seen: Observation
    taken: Mask | None
    """Voxels within the bounds that it takes for occupied; None if it has no map."""
    plan: Floats | None
    """The way ahead (n, 3), world metres."""
    way: Floats
    """The way flown until then (n, 3), world metres."""


def _moments(
    course: Course, number: int, simulation: Simulation, robot: Any, flown: Flown
) -> Iterator[_Moment]:
    """Fly a flight again, and yield its moments; the last one is at its end. The robot, if there is
    one, gets the recorded observations.

    Raises:
        DatasetError: The flight ended before it began, or differs from its recording.
    """
    way, moment, count = list[Floats](), None, 0
    every = max(PERIODS_PER_PICTURE, -(-len(flown.commands) // MAX_PICTURES))
    if robot is not None:
        robot.reset(simulation.about())
    for count, seen in enumerate(flown_again(simulation, flown), start=1):
        if robot is not None:
            robot.act(seen)
        # the world's: what the robot is told may drift
        seen |= {"position": simulation.pose.position, "quaternion": simulation.pose.quaternion}
        way.append(seen["position"])
        if count % every == 1:
            # a robot of a user's own need not map
            taken = robot.taken() if hasattr(robot, "taken") else None
            moment = _Moment(seen, taken, getattr(robot, "path", None), np.array(way))
            yield moment
    if moment is None:
        raise DatasetError(f"the flight ended before it began: {flown.trouble}")
    compared(course, number, simulation, flown, count)
    end = simulation.state[POSITION]
    # the robot decides no more at the end: its last map and plan stand
    seen = moment.seen | {"position": end, "time_s": np.array([simulation.time_s])}
    yield moment._replace(seen=seen, way=np.array([*way, end]))


def looks_of_flight(
    name: str, course: Course, number: int, robot: Any, flights: Sequence[Flown]
) -> list[Look]:
    """Fly a flight again, and return its pictures in the order of time.

    They show the truth, the voxels that the robot takes for occupied, its scans, and its path,
    first the flown part and then the planned one. The first has the film's curves. With drift, its
    map and plan are where it takes them to be, all else is where it is.

    Args:
        name: Name of the robot.
        course: The course.
        number: The mission's in the course.
        robot: The robot, which flies again, since recordings hold no maps; or None.
        flights: All flights of the course.

    Raises:
        DatasetError: The flight ended before it began, or differs from its recording.
    """
    # the grid of the whole flight: all pictures are of the same voxels
    simulation, flown = course.simulation(number), flights[number]
    mission = simulation.mission
    grid, first = within(mission.bounds, getattr(robot, "grid", GridSpec()))
    origin = first * np.float64(grid.voxel_m)
    world = course.simulated
    truth = world.truth(grid, origin)["occupancy"]
    movers = world.movers if isinstance(world, World) else None
    moments, looks = list(_moments(course, number, simulation, robot, flown)), []
    film = _film(simulation) | {"ends": _ends(course, flights), "flight": number}
    for moment in moments:
        seen = moment.seen
        position, hits = seen["position"], seen["points"][np.isfinite(seen["ranges"])]
        at_end = moment is moments[-1]
        # the last scan was taken where the robot decided last
        scanned_at = moments[-2].seen["position"] if at_end else position
        returns = scanned_at + rotate(seen["quaternion"], hits.astype(np.float64))
        now = truth
        if movers is not None:
            now = truth | (mover_voxels(movers, grid, origin, float(seen["time_s"][0])) >= 0)
        # without a robot's map, the picture shows the last scan
        observed = sort_points(scanned_at, returns, grid, origin).observed
        ahead = np.empty((0, 3)) if moment.plan is None else moment.plan[1:]
        outcome = flown.outcome if at_end else "under way"
        route = PlannedPath(
            start=np.array(mission.start),
            goal=np.array(mission.goal),
            points=np.concatenate([moment.way, ahead]),
            told=f"{outcome}, {len(moment.way) - 1} of {len(flown.commands)} periods flown",
            hit=position if outcome in HITS else None,
            flown=len(moment.way),
        )
        occupied = observed if moment.taken is None else moment.taken
        looks.append(
            Look(
                name=f"{seen['time_s'][0]:.2f} s",
                grid=grid,
                origin=origin,
                position=position,
                quaternion=seen["quaternion"],
                masks={"occupancy": now, "observed": observed},
                scans=[returns],
                rays=seen["ranges"].size,
                fov_deg=field_of_view(simulation.sensor),
                guesses=(Guess(name=name, occupied=occupied, tudf=None, route=route),),
                film=film,
            )
        )
    return looks


def _film(simulation: Simulation) -> Json:
    """Return the film's curves, with a value for each period, for the page's script."""
    firsts = np.cumsum([0, *map(len, simulation.states[:-1])])
    speeds = [np.linalg.norm(states[-1, VELOCITY]) for states in simulation.states]
    least = np.minimum.reduceat(simulation.clearances_m, firsts)
    curves: Json = {"speed, m/s": speeds, "clearance (to 1 m), m": least}
    return {
        "period_s": PERIOD_S,
        "time_s": simulation.time_s,
        "curves": {name: np.round(values, 3).tolist() for name, values in curves.items()},
    }


def _ends(course: Course, flights: Sequence[Flown]) -> list[Json]:
    """Return how each flight through a world ended: in words, and the place if it hit something."""
    ends = []
    for number, flown in enumerate(flights):
        end: Json = {"text": f"flight {number} {ENDS[flown.outcome]} after {flown.time_s:.2f} s"}
        if flown.outcome in HITS:
            simulation = course.simulation(number)
            for _ in flown_again(simulation, flown, blind=True):
                pass
            end["hit"] = simulation.state[POSITION].tolist()
            end["text"] += " at {:.2f}, {:.2f}, {:.2f} m".format(*end["hit"])
        ends.append(end)
    return ends


def looks_of_recording(path: Path, number: int = 0) -> list[Look]:
    """Fly a recorded flight again, and return its pictures, see `looks_of_flight`.

    The robot that is named in the recording flies along if it is scenegen's own. A robot of a
    user's own does not: a stranger's file must not start a program.

    Args:
        path: The recording, or an entry to a suite.
        number: Number of the flight in the file.

    Raises:
        DatasetError: There is no such flight, or it differs from its recording.
        ScenegenError: The courses are not in this file or package.
    """
    recording = open_recording(path, None, None)[0]
    every = [
        (course, flights, n) for course, flights in recording.courses for n in range(len(flights))
    ]
    if number >= len(every):
        raise DatasetError(f"{path}: has no flight {number}; expected --index below {len(every)}")
    course, flights, own = every[number]
    notes = [f"flight {number} of {len(every)}; --index shows another"] * (len(every) > 1)
    maker = _known_robot(recording)
    if maker is None:
        notes.append(
            f"robot {recording.robot} is not started for a file, so its map and plan are not "
            f"shown; name it: scenegen fly replay {path} --robot or --weights, with --film"
        )
    looks = looks_of_flight(recording.robot, course, own, maker and maker(course), flights)
    return [replace(looks[0], missing=tuple(notes)), *looks[1:]]


def _known_robot(recording: Recording) -> Callable[[Course], Any] | None:
    """Return what makes the robot of a recording: one of scenegen's own, or one with the network
    whose bytes the recording names; else None."""
    name, brakes = split_robot_name(recording.robot)
    if not recording.network:
        return robot_maker(name, None, brakes) if name in NAMES else None
    from scenegen.model.completion.completer import HUB, locate  # imports torch

    ends = {robot: f", {end}" for robot, end in WITH_NETWORK.items()}
    robot = next((robot for robot, end in ends.items() if name.endswith(end)), "")
    weights = name.removesuffix(ends.get(robot, ""))
    # neither a download nor code of a user's own
    if weights.startswith(HUB) or split_own(weights)[0]:
        return None
    try:
        is_same = file_sha256(locate(weights)) == recording.network
    except ScenegenError:
        return None
    return robot_maker(robot, weights, brakes) if is_same else None
