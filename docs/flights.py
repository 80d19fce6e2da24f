"""Draw flights through the suite, for docs/results/fly.md.

python docs/flights.py                      # docs/pictures/fly/curves.png, from fly-flights.csv.gz
python docs/flights.py ENTRIES [EXPORTED]   # films of the clearest help and the clearest harm, too

ENTRIES and EXPORTED are those of benchmarks/fly.py. Clearest are the flights of `drawn` in which
the scores of `anywhere` and `optimistic`, both with brakes, differ most each way; of equal ones,
the first in the suite's order.
"""

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "benchmarks"))

import fly  # noqa: E402

from lidarsim import GridSpec  # noqa: E402
from scenegen.fly.course import Course, read_recording  # noqa: E402
from scenegen.fly.loop import Flown  # noqa: E402
from scenegen.fly.simulation import bounded  # noqa: E402
from scenegen.model.robots.flights import robot_maker  # noqa: E402

PICTURES = DOCS / "pictures" / "fly"
EVERY = 3
"""Of so many decisions, one is a picture of the film."""
BESIDE_M = 0.4
"""Solids so far above and below the vehicle are drawn, metres."""
FREE, SOLID, RIGHT, WRONG, PLAN, FLOWN = range(6)
COLOURS = np.array(
    [[255, 255, 255], [200, 200, 200], [60, 110, 200], [0, 0, 0], [40, 160, 60], [220, 40, 40]],
    np.uint8,
)
PIXELS = 4
"""Of a voxel."""


def draw_curves() -> None:
    """Success over time, a point for each speed."""
    runs = fly.by_run(fly.Options().flights)
    if not fly.AT_SPEEDS.keys() & runs.keys():
        return  # one speed makes no curve
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel="mean time of successful flights, s", ylabel="success")
    axes.grid(alpha=0.3)
    there = [title for title in fly.SPEEDS_MPS if {*fly.FIVE} <= runs.get(title, {}).keys()]
    for name in fly.FIVE:
        flights = [fly.some(runs[title][name]) for title in there]
        times = [one["time_s"][one["success"] > 0].mean() for one in flights]
        axes.plot(times, [one["success"].mean() for one in flights], ".-", label=name)
    speeds = ", ".join(f"{fly.SPEEDS_MPS[title]:g}" for title in reversed(there))
    axes.legend(fontsize="small", title=f"left to right: {speeds} m/s")
    figure.savefig(PICTURES / "curves.png", dpi=110)


def draw_films(entries: Path, exported: Path | None) -> None:
    """The clearest help and the clearest harm, `optimistic` on the left."""
    recorded = []
    for name in fly.PAIR:
        entry = read_recording(entries / f"drawn-{name.replace(', ', '-')}.json")
        recorded.append(
            [(course, n, one) for course, many in entry.courses for n, one in enumerate(many)]
        )
    gains = [
        second.score - first.score for (_, _, first), (_, _, second) in zip(*recorded, strict=True)
    ]
    for title, number in (("helps", int(np.argmax(gains))), ("harms", int(np.argmin(gains)))):
        films = []
        for name, flights in zip(fly.PAIR, recorded, strict=True):
            course, mission, flown = flights[number]
            robot, network, _, brakes = fly.parts(name)
            if network and exported:
                network = str(exported / f"{network}.onnx")
            films.append(film(course, mission, flown, robot_maker(robot, network, brakes)(course)))
            print(
                title,
                name,
                course.world,
                course.level,
                course.seed,
                mission,
                flown.outcome,
                flown.score,
            )
        length = max(map(len, films))
        frames = [np.hstack([one[min(n, len(one) - 1)] for one in films]) for n in range(length)]
        images = [Image.fromarray(frame).quantize(8) for frame in frames]
        images[0].save(
            PICTURES / f"{title}.gif", save_all=True, append_images=images[1:], duration=150, loop=0
        )


def film(course: Course, mission: int, flown: Flown, robot: Any) -> list[Any]:
    """Pictures of a flight from above, flown again by the robot, which must decide the same."""
    simulation = course.simulation(mission)
    robot.reset(simulation.about())
    frames, way = [], []
    grid, low = robot._fence, robot._low * np.float64(robot.grid.voxel_m)
    truth = course.simulated.truth(GridSpec(shape=grid.shape, voxel_m=grid.voxel_m), low)[
        "occupancy"
    ]
    for n, command in enumerate(flown.commands):
        action, _ = bounded(robot.act(simulation.observe()), simulation.vehicle)
        if action is None or not np.array_equal(action[0], command):
            raise RuntimeError(f"decision {n} is another one than in the recording")
        way.append(simulation.state[:3].copy())
        if not n % EVERY:
            frames.append(picture(robot, truth, low, way))
        simulation.step(command)
    way.append(simulation.state[:3].copy())
    return [*frames, *[picture(robot, truth, low, way)] * 8]


def picture(robot: Any, truth: Any, low: Any, way: list[Any]) -> Any:
    """The section at the vehicle's height (y, x, 3): what is there, and what the robot takes for
    occupied."""
    voxel_m, taken = robot.grid.voxel_m, robot.taken()
    z = np.clip(
        ((way[-1][2] - low[2] + np.array([-BESIDE_M, BESIDE_M])) / voxel_m).astype(int),
        0,
        truth.shape[2] - 1,
    )
    section = (..., slice(z[0], z[1] + 1))
    there, believed = truth[section].any(axis=2), taken[section].any(axis=2)
    plan = np.full(there.shape, FREE)
    plan[there] = SOLID
    plan[believed] = np.where(there, RIGHT, WRONG)[believed]
    large = plan.repeat(PIXELS, 0).repeat(PIXELS, 1)
    for points, colour in ((robot.path, PLAN), (np.array(way), FLOWN)):
        if points is None or len(points) < 2:
            continue
        ends = pairwise(points)
        dense = np.concatenate(
            [np.linspace(a, b, 2 + int(np.linalg.norm(b - a) * 30)) for a, b in ends]
        )
        x, y = np.clip(
            ((dense[:, :2] - low[:2]) / voxel_m * PIXELS).astype(int).T,
            0,
            np.array(large.shape)[:, None] - 1,
        )
        large[x, y] = colour
    return COLOURS[np.pad(large, 4, constant_values=FREE).T[::-1]]


if __name__ == "__main__":
    if len(sys.argv) > 1:
        draw_films(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
    draw_curves()
