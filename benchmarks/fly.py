"""How robots fly, and what a step costs: each robot, on the same missions through each kind.

    python benchmarks/fly.py pillar geometric forest --flights 20 --robots truth optimistic columns

A name of a bundled network is a robot that maps and has it complete. Per kind and robot: success,
collisions and time-outs, %, BARN's score, the length flown over the shortest, and milliseconds of
a decision; first, milliseconds of a simulated period (sensing, motion, collisions). In this
process alone, one after the other.
"""

import time
from collections import Counter

import measuring
import numpy as np

from scenegen.fly.course import Course
from scenegen.fly.loop import Flown, fly
from scenegen.model.robots import NAMES, robot_maker


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
            print(f"{kind:10} {name:11} {_line(flown)}", flush=True)


def _line(flown: list[Flown]) -> str:
    ends = Counter(one.outcome for one in flown)
    shares = "  ".join(
        f"{end} {100 * ends[end] / len(flown):.0f} %" for end in ("success", "collision", "timeout")
    )
    score, ratio, clearance, seconds = (
        float(np.mean([getattr(one, name) for one in flown]))
        for name in ("score", "ratio", "min_clearance_m", "step_s")
    )
    figures = f"score {score:.3f}  ratio {ratio:.2f}  clearance {clearance:.2f} m"
    return f"{shares}  {figures}  {seconds * 1e3:.1f} ms a decision"


if __name__ == "__main__":
    main()
