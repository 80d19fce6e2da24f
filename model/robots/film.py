"""A film of a flight, from above: what is there, what the robot takes for occupied, and its way."""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lidarsim import GridSpec
from scenegen.display.colours import GOAL, INVENTED, SENSOR
from scenegen.fly.course import Course
from scenegen.fly.loop import fly
from scenegen.fly.simulation import Observation

EVERY = 3
"""Periods from picture to picture."""
MOST = 200
"""Pictures; of a longer flight, the first."""
WIDTH = 480
"""Pixels of the longer side, about."""
FREE, UNHELD, RIGHT = (255, 255, 255), (190, 190, 190), (60, 90, 140)
"""What is free; what is there; and what of it the robot takes for occupied."""
WAY, PLAN = (20, 20, 20), (0, 120, 70)


class _Watched:
    """A robot, and what it held at every `EVERY`-th decision."""

    def __init__(self, robot: Any):
        self._robot = robot
        self.frames: list[tuple[NDArray[np.float64], Any, Any]] = []
        self.way: list[NDArray[np.float64]] = []

    def reset(self, about: Observation) -> None:
        self._robot.reset(about)

    def act(self, observation: Observation) -> Any:
        answer = self._robot.act(observation)
        at = observation["position"]
        self.way.append(at)
        if len(self.way) % EVERY == 1 and len(self.frames) < MOST:
            taken = self._robot.taken(at[2]) if hasattr(self._robot, "taken") else None
            self.frames.append((at, taken, getattr(self._robot, "path", None)))
        return answer


def film(course: Course, number: int, robot: Any) -> bytes:
    """A GIF of mission `number`, flown by `robot`: the level of the vehicle's height, five pictures
    a second, 1.5 times as fast as it was flown."""
    watched = _Watched(robot)
    simulation = course.simulation(number)
    flown = fly(simulation, watched)
    low, high = np.array(simulation.mission.bounds)
    voxel_m = GridSpec().voxel_m
    start = np.floor(low / voxel_m).astype(np.int64) + 1
    count = np.maximum(np.floor(high / voxel_m).astype(np.int64) - start, 1)
    x, y, z = count.tolist()
    grid = GridSpec(shape=(x, y, z), voxel_m=voxel_m)
    truth = course.simulated.truth(grid, start * voxel_m)["occupancy"]
    scale = max(WIDTH // max(x, y), 1)

    def pixels(points: Any) -> list[tuple[float, float]]:
        across, along = (np.atleast_2d(points)[:, :2] / voxel_m - start[:2]).T * scale
        return list(zip(across.tolist(), (y * scale - along).tolist(), strict=True))

    moments = [*watched.frames, (flown.path[-1], *watched.frames[-1][1:])]
    pictures = []
    for n, (at, taken, plan) in enumerate(moments):
        there = truth[:, :, min(max(int(at[2] / voxel_m - start[2]), 0), z - 1)]
        colours = np.full((x, y, 3), FREE, np.uint8)
        colours[there] = UNHELD
        if taken is not None:
            colours[there & taken], colours[taken & ~there] = RIGHT, INVENTED
        from_above = colours[:, ::-1].transpose(1, 0, 2)
        picture = Image.fromarray(from_above.repeat(scale, axis=0).repeat(scale, axis=1))
        draw = ImageDraw.Draw(picture)
        if plan is not None and len(plan) > 1:
            draw.line(pixels(plan), fill=PLAN, width=2)
        draw.line(pixels([*watched.way[: n * EVERY + 1], at]), fill=WAY, width=2)
        discs = (
            (simulation.mission.goal, course.rules.reach_m, GOAL),
            (at, course.vehicle.radius_m, SENSOR),
        )
        for point, radius_m, fill in discs:
            ((u, v),), r = pixels(point), radius_m / voxel_m * scale
            draw.ellipse([u - r, v - r, u + r, v + r], fill=fill)
        pictures.append(picture.quantize(16))
    file, shown_ms = io.BytesIO(), [200] * len(watched.frames) + [1500]
    pictures[0].save(
        file, "GIF", save_all=True, append_images=pictures[1:], duration=shown_ms, loop=0
    )
    return file.getvalue()
