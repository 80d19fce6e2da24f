"""A page that plays a flight: the truth, the robot's own map, and its path."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lidarsim import GridSpec
from lidarsim.grid import Floats, Mask
from lidarsim.pose import rotate
from lidarsim.voxelization import sort_points
from scenegen.base.errors import DatasetError
from scenegen.fly.course import Course, flown_again
from scenegen.fly.loop import Flown
from scenegen.fly.simulation import Observation, Simulation
from scenegen.model.robots.mapping import within
from scenegen.view.look import Guess, Look, Route
from scenegen.view.page import page

PERIODS_PER_PICTURE = 3
"""Periods from picture to picture."""
MAX_PICTURES = 200
"""Of a longer flight, the first ones are shown."""


class _Moment(NamedTuple):
    """Observation at a decision, with the robot's map and plan."""

    seen: Observation
    taken: Mask | None
    """Voxels within the bounds that it takes for occupied; None if it has no map."""
    plan: Floats | None
    """The way ahead (n, 3), world metres."""
    way: Floats
    """The way flown until then (n, 3), world metres."""


def _moments(simulation: Simulation, robot: Any, flown: Flown) -> Iterator[_Moment]:
    """Fly a flight again, and yield its moments; the last one is at its end. The robot, if there is
    one, gets the recorded observations.

    Raises:
        DatasetError: The flight ended before it began.
    """
    way, moment = list[Floats](), None
    if robot is not None:
        robot.reset(simulation.about())
    for n, seen in enumerate(flown_again(simulation, flown)):
        if robot is not None:
            robot.act(seen)
        way.append(seen["position"])
        if n % PERIODS_PER_PICTURE == 0 and n < PERIODS_PER_PICTURE * MAX_PICTURES:
            # a robot of a user's own need not map
            taken = robot.taken() if hasattr(robot, "taken") else None
            moment = _Moment(seen, taken, getattr(robot, "path", None), np.array(way))
            yield moment
    if moment is None:
        raise DatasetError(f"the flight ended before it began: {flown.trouble}")
    end = simulation.state[:3]
    # the robot decides no more at the end: its last map and plan stand
    yield moment._replace(seen=moment.seen | {"position": end}, way=np.array([*way, end]))


def flight_page(name: str, course: Course, number: int, robot: Any, flown: Flown) -> bytes:
    """Write an HTML page that plays a flight in three dimensions, five pictures a second.

    It shows the truth, the voxels that the robot takes for occupied, its scans, and its path, first
    the flown part and then the planned one.

    Args:
        name: Name of the robot.
        course: The course.
        number: The mission's in the course.
        robot: The robot, which flies again, since recordings hold no maps; or None.
        flown: The flight.

    Returns:
        The page, UTF-8.

    Raises:
        DatasetError: The flight ended before it began, or no browser takes the voxels within its
            bounds.
    """
    # the grid of the whole flight: all pictures are of the same voxels
    simulation = course.simulation(number)
    mission = simulation.mission
    grid, first = within(mission.bounds, getattr(robot, "grid", GridSpec()))
    origin = first * np.float64(grid.voxel_m)
    truth = course.simulated.truth(grid, origin)["occupancy"]
    moments, looks = list(_moments(simulation, robot, flown)), []
    for moment in moments:
        seen = moment.seen
        position, hits = seen["position"], seen["points"][np.isfinite(seen["ranges"])]
        returns = position + rotate(seen["quaternion"], hits.astype(np.float64))
        # without a robot's map, the picture shows the last scan
        observed = sort_points(position, returns, grid, origin).observed
        ahead = np.empty((0, 3)) if moment.plan is None else moment.plan[1:]
        outcome = "under way" if moment is not moments[-1] else flown.outcome
        route = Route(
            start=np.array(mission.start),
            goal=np.array(mission.goal),
            points=np.concatenate([moment.way, ahead]),
            told=f"{outcome}, {len(moment.way) - 1} of {len(flown.commands)} periods flown",
            hit=position if outcome == "collision" else None,
        )
        occupied = observed if moment.taken is None else moment.taken
        looks.append(
            Look(
                name=f"{seen['time_s'][0]:.1f} s",
                grid=grid,
                origin=origin,
                position=position,
                quaternion=seen["quaternion"],
                masks={"occupancy": truth, "observed": observed},
                scans=[returns],
                rays=seen["ranges"].size,
                guesses=(Guess(name=name, occupied=occupied, tudf=None, route=route),),
            )
        )
    return page(looks, title=f"{name} in {course.world}", film=True).encode()
