"""Films of a flight: what is there, what the robot takes for occupied, and its way."""

import io
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from lidarsim import GridSpec
from lidarsim.grid import Floats, Mask
from lidarsim.pose import rotate
from lidarsim.voxelization import sort_points
from scenegen.display.colours import GOAL, INVENTED, SENSOR
from scenegen.display.look import Guess, Look, Route
from scenegen.display.page import page
from scenegen.errors import DatasetError
from scenegen.fly.course import Course, flown_again
from scenegen.fly.loop import Flown
from scenegen.fly.simulation import Observation
from scenegen.model.robots.mapping import within

EVERY = 3
"""Periods from picture to picture."""
MOST = 200
"""Pictures; of a longer flight, the first."""
WIDTH = 480
"""Pixels of the longer side, about."""
FREE, UNHELD, RIGHT = (255, 255, 255), (190, 190, 190), (60, 90, 140)
"""What is free; what is there; and what of it the robot takes for occupied."""
WAY, PLAN = (20, 20, 20), (0, 120, 70)


class _Moment(NamedTuple):
    """What was seen at a decision, and what the robot held then."""

    seen: Observation
    taken: Mask | None
    """What it takes for occupied, of the scene's grid; None where it has no map."""
    plan: Floats | None
    """The way ahead (n, 3), world metres."""
    way: Floats
    """The way flown until then (n, 3), world metres."""


class _Scene:
    """A flight, and the voxels that lie wholly within its bounds."""

    def __init__(self, course: Course, number: int, robot: Any, flown: Flown):
        """Mission `number` as it was flown; the robot, if there is one, sees what was seen and
        tells what it takes for occupied."""
        self.simulation, self.flown = course.simulation(number), flown
        self._robot = robot
        bounds = self.simulation.mission.bounds
        self.grid, self.first = within(bounds, getattr(robot, "grid", GridSpec()))
        """The grid, and its least voxel (3,), counted from the world's origin."""
        self.origin = self.first * np.float64(self.grid.voxel_m)
        """Its least corner (3,), world metres."""
        self.truth: Mask = course.simulated.truth(self.grid, self.origin)["occupancy"]
        """What is occupied, of the grid's shape."""

    def moments(self) -> Iterator[_Moment]:
        """What was held on the way, as it is flown again; at the end, what was held last. Raises
        DatasetError for a flight that ended before it began."""
        robot, way, moment = self._robot, list[Floats](), None
        if robot is not None:
            robot.reset(self.simulation.about())
        for n, seen in enumerate(flown_again(self.simulation, self.flown)):
            if robot is not None:
                robot.act(seen)
            way.append(seen["position"])
            if n % EVERY == 0 and n < EVERY * MOST:
                taken = robot.taken() if hasattr(robot, "taken") else None
                moment = _Moment(seen, taken, getattr(robot, "path", None), np.array(way))
                yield moment
        if moment is None:
            raise DatasetError(f"the flight ended before it began: {self.flown.trouble}")
        end = self.simulation.state[:3]
        yield moment._replace(seen=moment.seen | {"position": end}, way=np.array([*way, end]))


def film(course: Course, number: int, robot: Any, flown: Flown) -> bytes:
    """A GIF of mission `number`, see `_Scene`: the level of the vehicle's height, five pictures
    a second, 1.5 times as fast as it was flown."""
    scene = _Scene(course, number, robot, flown)
    start, voxel_m, (x, y, z) = scene.first, scene.grid.voxel_m, scene.grid.shape
    scale = max(WIDTH // max(x, y), 1)

    def pixels(points: Any) -> list[tuple[float, float]]:
        across, along = (np.atleast_2d(points)[:, :2] / voxel_m - start[:2]).T * scale
        return list(zip(across.tolist(), (y * scale - along).tolist(), strict=True))

    pictures = []
    for moment in scene.moments():
        position = moment.seen["position"]
        level = min(max(int(position[2] / voxel_m - start[2]), 0), z - 1)
        occupied = scene.truth[:, :, level]
        colours = np.full((x, y, 3), FREE, np.uint8)
        colours[occupied] = UNHELD
        if moment.taken is not None:
            believed = moment.taken[:, :, level]
            colours[occupied & believed], colours[believed & ~occupied] = RIGHT, INVENTED
        from_above = colours[:, ::-1].transpose(1, 0, 2)
        picture = Image.fromarray(from_above.repeat(scale, axis=0).repeat(scale, axis=1))
        draw = ImageDraw.Draw(picture)
        if moment.plan is not None and len(moment.plan) > 1:
            draw.line(pixels(moment.plan), fill=PLAN, width=2)
        draw.line(pixels(moment.way), fill=WAY, width=2)
        discs = (
            (scene.simulation.mission.goal, course.rules.reach_m, GOAL),
            (position, course.vehicle.radius_m, SENSOR),
        )
        for point, radius_m, fill in discs:
            ((column, row),), radius = pixels(point), radius_m / voxel_m * scale
            draw.ellipse([column - radius, row - radius, column + radius, row + radius], fill=fill)
        pictures.append(picture.quantize(16))
    file, shown_ms = io.BytesIO(), [200] * (len(pictures) - 1) + [1500]
    pictures[0].save(
        file, "GIF", save_all=True, append_images=pictures[1:], duration=shown_ms, loop=0
    )
    return file.getvalue()


def flight_page(name: str, course: Course, number: int, robot: Any, flown: Flown) -> bytes:
    """A page (HTML) that plays mission `number`, see `_Scene`, of a robot called `name`, in
    three dimensions: what is there, what the robot takes for occupied, its scans, and its way,
    first flown and then planned.

    Raises DatasetError where no browser takes the voxels within the flight's bounds.
    """
    scene = _Scene(course, number, robot, flown)
    start, goal = map(np.array, (scene.simulation.mission.start, scene.simulation.mission.goal))
    moments, looks = list(scene.moments()), []
    for moment in moments:
        seen = moment.seen
        at, hits = seen["position"], seen["points"][np.isfinite(seen["ranges"])]
        returns = at + rotate(seen["quaternion"], hits.astype(np.float64))
        observed = sort_points(at, returns, scene.grid, scene.origin).observed
        ahead = np.empty((0, 3)) if moment.plan is None else moment.plan[1:]
        told = "under way" if moment is not moments[-1] else flown.outcome
        route = Route(
            start=start,
            goal=goal,
            points=np.concatenate([moment.way, ahead]),
            told=f"{told}, {len(moment.way) - 1} of {len(flown.commands)} periods flown",
            hit=at if told == "collision" else None,
        )
        held = observed if moment.taken is None else moment.taken
        looks.append(
            Look(
                name=f"{seen['time_s'][0]:.1f} s",
                grid=scene.grid,
                origin=scene.origin,
                position=at,
                quaternion=seen["quaternion"],
                masks={"occupancy": scene.truth, "observed": observed},
                scans=[returns],
                rays=seen["ranges"].size,
                guesses=(Guess(name=name, occupied=held, tudf=None, route=route),),
            )
        )
    return page(looks, title=f"{name} in {course.world}").encode()
