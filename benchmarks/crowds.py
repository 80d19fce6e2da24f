"""Does it help a robot to know where movers will be? Robots fly among movers, see
docs/results/movers.md.

    python benchmarks/crowds.py FLIGHTS        # flies what FLIGHTS lacks, and prints the tables

FLIGHTS is a folder with a recording of each robot and density, as `scenegen fly world` writes them.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import measuring
import numpy as np
from scoring import RESULTS, publish, titled, told
from tyro.conf import Positional

from lidarsim.grid import Floats, Ints
from scenegen.base.workers import ALONE
from scenegen.fly import Rules, Vehicle
from scenegen.fly.course import Course, read_recording
from scenegen.fly.loop import Flown
from scenegen.model.bench.statistics import holm, paired_p
from scenegen.model.robots import BRAKES, split_robot_name
from scenegen.model.robots.flights import crew_of, fly_course, fly_courses

DENSITIES = ("light", "medium", "dense")
KINDS = ("industrial", "maze", "rooms", "street", "warehouse")
VEHICLE = Vehicle(radius_m=0.2, speed_mps=4, acceleration_mps2=6, tilt_deg=45)
FLIGHTS = 2
"""Through each world of a density."""
RULES = Rules(apart_m=12, patience=20)
BRAKING = product(("optimistic", "forgetting", "predicting"), ("", BRAKES))
ROBOTS = (*map("".join, BRAKING), "truth", "foreseeing")
TIME = "time, s"
FIGURES: dict[str, Callable[[Flown], float]] = {
    "success": lambda one: one.outcome == "success",
    "struck": lambda one: one.outcome == "struck",
    "collision": lambda one: one.outcome == "collision",
    TIME: lambda one: one.time_s if one.outcome == "success" else np.nan,
}
QUESTIONS = {
    "forgetting old returns": ("forgetting", "optimistic"),
    "braking for the unseen": (f"forgetting{BRAKES}", "forgetting"),
    "predicting, beyond braking": (f"predicting{BRAKES}", f"forgetting{BRAKES}"),
    "knowing the future": ("foreseeing", "truth"),
}
"""What is tested: the success of the first robot less that of the second."""


class Options(measuring.Options):
    """Where flights are kept, and how many there are."""

    flights: Positional[Path | None] = None
    """folder of the recordings"""
    worlds: int = 10
    """of each kind and density"""
    seed: int = 6000
    """of the first of them"""
    lidar: str = "raster"
    densities: tuple[str, ...] = DENSITIES
    figures: Path = RESULTS / "movers.csv"


def main() -> None:
    """Fly what is missing; print the tables, and write them beside the page."""
    given = measuring.parse(Options, worlds=1, seed=9000, densities=("light",))
    folder = given.flights or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    found = {
        (density, name): flown(folder, density, name, given)
        for density, name in product(given.densities, ROBOTS)
    }
    worlds = np.arange(len(KINDS) * given.worlds).repeat(FLIGHTS)
    figures = {
        key: {what: np.array([*map(of, flights)], float) for what, of in FIGURES.items()}
        for key, flights in found.items()
    }
    lines = []
    for density in given.densities:
        rows = [
            (
                f"`{name}`",
                [
                    told(values, worlds, ".2f", "amount" if what == TIME else "outcome")
                    for what, values in figures[density, name].items()
                ],
            )
            for name in ROBOTS
        ]
        lines += titled(f"## Flights among movers, {density}", FIGURES, rows)
    everywhere = {
        name: np.mean([figures[density, name]["success"] for density in given.densities], axis=0)
        for name in ROBOTS
    }
    lines += tests(everywhere, worlds)
    rows = [
        (f"`{name}`", [f"{mean:.2f}" for mean in values.reshape(len(KINDS), -1).mean(axis=1)])
        for name, values in everywhere.items()
    ]
    publish(given, [*lines, *titled("## Success among movers, by kind", KINDS, rows)])


def flown(folder: Path, density: str, name: str, given: Options) -> list[Flown]:
    """The flights of a robot through the worlds of a density; recorded ones are not flown."""
    file = folder / f"{density}-{name.replace(', ', '-')}.json"
    if not file.exists():
        courses = [
            Course(
                world=kind,
                seed=given.seed + n,
                flights=FLIGHTS,
                movers=density,  # type: ignore[arg-type]
                lidar=given.lidar,
                vehicle=VEHICLE,
                rules=RULES,
            )
            for kind, n in product(KINDS, range(given.worlds))
        ]
        robot, brakes = split_robot_name(name)
        work = partial(fly_course, robot=robot, weights=None, brakes=brakes)
        fly_courses(courses, work, name, None, file, crew_of(ALONE))
        print(file, flush=True)
    return [one for _, several in read_recording(file).courses for one in several]


def tests(success: dict[str, Floats], worlds: Ints) -> list[str]:
    """The differences that the plan names, with p-values by Holm over all of them."""
    pairs = [(success[one], success[other]) for one, other in QUESTIONS.values()]
    rng = np.random.default_rng(0)
    adjusted = holm([paired_p(*pair, worlds, rng=rng) for pair in pairs])
    rows = [
        (what, [told(one - other, worlds, "+.3f"), f"{p:.3f}"])
        for what, (one, other), p in zip(QUESTIONS, pairs, adjusted, strict=True)
    ]
    return titled("## What helps among movers", ("success, difference", "p (Holm)"), rows)


if __name__ == "__main__":
    main()
