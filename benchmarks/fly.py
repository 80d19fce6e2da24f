"""Does completing the scene help a robot that moves? Robots fly the suite: docs/results/fly.md.

    python benchmarks/fly.py ENTRIES                        # flies what ENTRIES lacks; the page
    python benchmarks/fly.py ENTRIES --every 1 --robots optimistic my_net.onnx
    python benchmarks/fly.py REAL --maps MAPS               # the real track: fly-real.md

ENTRIES is a folder with an entry of each robot, as `scenegen fly --suite` writes them; one that is
there goes on. Every tenth course is one world of each kind and difficulty. A name that is no
robot's is a network, with which a robot maps; as `returns:NETWORK`, it completes the last scan
alone. Decisions are timed in this process alone.
"""

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import measuring
import numpy as np
from scoring import RESULTS, publish, titled

from scenegen.cli.show import Progress
from scenegen.fly.course import Course
from scenegen.fly.loop import Flown
from scenegen.fly.suite import DIFFICULTIES, MAPS, courses_of, map_courses
from scenegen.model.evaluation.statistics import brief, figure, line
from scenegen.model.robots.flights import FORGETFUL, NAMES, fly_course, fly_courses
from scenegen.recipes import kind_names
from scenegen.run.workers import ALONE

ROBOTS = (*NAMES, "proposed", "columns", "anywhere")
BASELINES = ("optimistic", "extrude")
Row = tuple[Course, Flown]
Flights = dict[str, list[Row]]
"""By robot."""
HARDER = {
    "clearance_m": -1,
    "visibility_m": -1,
    "dispersion": 1,
    "passage_m": -1,
    "tortuosity": 1,
    "traversability": -1,
    "gap": -1,
    "obstruction": 1,
    "occlusion": 1,
    "turning": 1,
}
"""The figures of difficulty: 1 where more is harder, else -1."""
FIGURES: dict[str, Callable[[Flown], float]] = {
    "success": lambda one: float(one.outcome == "success"),
    "collision": lambda one: float(one.outcome == "collision"),
    "score": lambda one: one.score,
    "path ratio": lambda one: one.ratio if one.outcome == "success" else np.nan,
    "time, s": lambda one: one.time_s if one.outcome == "success" else np.nan,
    "mean clearance, m": lambda one: one.mean_clearance_m,
    "jerk, m/s³": lambda one: one.jerk_mps3,
}

GAINS = ("success", "score")
"""Figures of which differences are told."""
BY_GROUP = ("success", "time, s", "mean clearance, m")
"""Figures that are told for every difficulty and kind, too."""


def main() -> None:
    """Fly what is missing; print the tables, and write them to the page."""
    parser = measuring.options(__doc__)
    parser.add_argument("entries", type=Path, nargs="?", help="folder of the entries")
    parser.add_argument("--every", type=int, default=10, help="one of so many courses")
    parser.add_argument("--maps", type=Path, help="folder of the real maps, to fly these")
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--dynamics", default="kinematic", help="of the vehicle")
    parser.add_argument("--page", type=Path)
    given = measuring.parse(parser, every=300, robots=["reactive", "optimistic"])
    given.page = given.page or RESULTS / ("fly-real.md" if given.maps else "fly.md")
    with tempfile.TemporaryDirectory() as spare:
        courses = map_courses(given.maps) if given.maps else courses_of("aerial-1")[:: given.every]
        courses = [
            replace(one, vehicle=replace(one.vehicle, dynamics=given.dynamics)) for one in courses
        ]
        found: Flights = {}
        for name in given.robots:
            found[called(name)] = flown(name, courses, given.entries or Path(spare))
    differences = [part for base in BASELINES if base in found for part in less(base, found)]
    publish(given, [*robots(found), *differences, *by_groups(found), *how_hard(found)])


def parts(name: str) -> tuple[str, str | None]:
    """The robot and the network that a name of --robots stands for."""
    if name in NAMES:
        return name, None
    network = name.removeprefix(f"{FORGETFUL}:")
    return ("optimistic" if network == name else FORGETFUL), network


def called(name: str) -> str:
    """What a robot is called in tables and in the name of its entry."""
    robot, network = parts(name)
    if network is None:
        return robot
    return Path(network).stem + (", last scan" if robot == FORGETFUL else "")


def flown(name: str, courses: Sequence[Course], entries: Path) -> list[Row]:
    """The flights of a robot through all courses; those that its entry holds are not flown."""
    entries.mkdir(parents=True, exist_ok=True)
    entry = entries / f"{called(name)}.json"
    robot, weights = parts(name)
    work = partial(fly_course, robot=robot, weights=weights)
    with Progress(name, shown=False) as progress:
        done = fly_courses(courses, work, name, "aerial-1", entry, ALONE, progress)
    print(f"{name}: {sum(len(flights) for _, flights in done)} flights", flush=True)
    return [(course, one) for course, flights in done for one in flights]


def told(rows: Sequence[Row], values: Iterable[float], form: str, scale: Any = "amount") -> str:
    """A figure of flights; its interval is over worlds."""
    return brief(figure([*values], [course.sha256 for course, _ in rows], scale), form)


def robots(found: Flights) -> list[str]:
    """Every robot's figures."""
    lines = titled("## Robots", [*FIGURES, "decision, ms"])
    for name, rows in found.items():
        cells = []
        for title, of in FIGURES.items():
            scale = "outcome" if title in ("success", "collision") else "amount"
            cells.append(told(rows, (of(one) for _, one in rows), ".3f", scale))
        step = np.mean([one.step_s for _, one in rows]) * 1e3
        lines.append(line(f"`{name}`", [*cells, f"{step:.1f}"]))
    return lines


def less(base: str, found: Flights) -> list[str]:
    """What every robot gains on the robot `base`, flight by flight."""
    lines = titled(f"## Flight by flight, less `{base}`", GAINS)
    for name, rows in found.items():
        pairs = list(zip(rows, found[base], strict=True))
        cells = []
        for of in (FIGURES[title] for title in GAINS):
            cells.append(
                told(rows, (of(one) - of(other) for (_, one), (_, other) in pairs), "+.3f")
            )
        lines.append(line(f"`{name}`", cells))
    return lines


def by_groups(found: Flights) -> list[str]:
    """Some figures by difficulty and kind, or by map."""
    lines = []
    first = next(iter(found.values()))
    for title, groups, key in (
        ("difficulty", DIFFICULTIES, lambda course: course.difficulty),
        ("kind", kind_names(), lambda course: course.world),
        ("map", tuple(MAPS), lambda course: Path(course.world).name),
    ):
        if not any(key(course) in groups for course, _ in first):
            continue
        for what in BY_GROUP:
            lines += titled(f"## {what.capitalize()}, by {title}", groups)
            for name, rows in found.items():
                cells = []
                for group in groups:
                    ours = [FIGURES[what](one) for course, one in rows if key(course) == group]
                    finite = [value for value in ours if np.isfinite(value)]
                    cells.append(f"{np.mean(finite):.2f}" if finite else "–")
                lines.append(line(f"`{name}`", cells))
    return lines


def how_hard(found: Flights) -> list[str]:
    """The figures of difficulty by level, and success in the third of the flights that each figure
    calls easiest, and in the hardest third."""
    courses = dict.fromkeys(course for course, _ in next(iter(found.values())))
    grades = [(course.difficulty, grade) for course in courses for grade in course.graded()]
    levels = [one for one in (*DIFFICULTIES, None) if one in {level for level, _ in grades}]
    lines = titled("## How hard the flights are", [one or "all" for one in levels])
    for name in HARDER:
        of_level = [[getattr(it, name) for level, it in grades if level == one] for one in levels]
        lines.append(line(f"`{name}`", [f"{np.nanmean(values):.2f}" for values in of_level]))
    reached = {
        name: np.array([FIGURES["success"](one) for _, one in rows])
        for name, rows in found.items()
        if name != "truth"
    }
    title = "Success in the easiest third, by the figure · in the hardest:"
    lines += titled(title, [f"`{name}`" for name in reached])
    for name, harder in HARDER.items():
        order = np.argsort([harder * getattr(it, name) for _, it in grades], kind="stable")
        third = max(len(order) // 3, 1)
        ends = order[:third], order[-third:]
        cells = [" · ".join(f"{one[end].mean():.2f}" for end in ends) for one in reached.values()]
        lines.append(line(f"`{name}`", cells))
    return lines


if __name__ == "__main__":
    main()
