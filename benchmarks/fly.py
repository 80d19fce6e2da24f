"""How robots fly, and what a step costs: each robot, on the same missions through each kind.

    python benchmarks/fly.py pillar geometric forest --flights 20 --robots truth optimistic columns

A name of a bundled network is a robot that maps and has it complete. Per kind and robot:
what `scenegen fly` tells; first, milliseconds of a simulated period (sensing, motion, collisions).
In this process alone, one after the other.
"""

import time

import measuring
import numpy as np

from scenegen.fly.course import Course
from scenegen.fly.loop import fly
from scenegen.model.robots import NAMES, robot_maker, summary


def main() -> None:
    """Print a line for each kind and robot."""
    parser = measuring.options(__doc__)
    parser.add_argument("kinds", nargs="*", default=["pillar", "geometric", "forest", "rooms"])
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--difficulty", choices=["easy", "medium", "hard"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", nargs="*", default=[*NAMES, "columns"])
    small = {"kinds": ["pillar"], "flights": 1, "worlds": 1, "robots": ["reactive"]}
    options = measuring.parse(parser, **small)
    for kind in options.kinds:
        each = options.flights // options.worlds
        courses = [
            Course(
                world=kind,
                seed=options.seed + n,
                flights=each,
                difficulty=options.difficulty,
            )
            for n in range(options.worlds)
        ]
        flying = courses[0].simulation(0)
        flying.observe()
        flying.step(np.zeros(4, np.float32))
        begin = time.perf_counter()
        for _ in range(20):
            flying.observe()
            flying.step(np.zeros(4, np.float32))
        print(f"{kind}: {(time.perf_counter() - begin) / 20 * 1e3:.2f} ms a simulated period")
        for name in options.robots:
            make = robot_maker(name, None if name in NAMES else name)
            flown = [
                fly(course.simulation(n), make(course)) for course in courses for n in range(each)
            ]
            told = "  ".join(f"{key} {value}" for key, value in summary(name, flown).items())
            print(f"{kind}: {told}", flush=True)


if __name__ == "__main__":
    main()
