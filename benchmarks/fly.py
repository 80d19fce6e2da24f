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
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import measuring
import numpy as np
from scoring import RESULTS, write_tables

from scenegen.cli.show import Progress
from scenegen.fly.course import Course
from scenegen.fly.loop import Flown
from scenegen.fly.suite import DIFFICULTIES, MAPS, courses_of, map_courses
from scenegen.model.evaluation.statistics import brief, figure, head, line
from scenegen.model.robots.flights import (
    FORGETFUL,
    MAPPING,
    NAMES,
    fly_course,
    fly_courses,
    robot_maker,
)
from scenegen.model.robots.mapping import RIM
from scenegen.recipes import kind_names
from scenegen.run.workers import ALONE

PAGE = RESULTS / "fly.md"
ROBOTS = (*NAMES, "proposed", "columns", "anywhere")
BASELINES = ("optimistic", "extrude")
Row = tuple[Course, Flown]
HARDER = {
    **{"clearance_m": -1, "visibility_m": -1, "dispersion": 1, "passage_m": -1, "tortuosity": 1},
    **{"traversability": -1, "gap": -1, "obstruction": 1, "occlusion": 1, "turning": 1},
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
    small = {"every": 300, "robots": ["reactive", "optimistic"], "page": Path("/dev/null")}
    given = measuring.parse(parser, **small)
    with tempfile.TemporaryDirectory() as spare:
        courses = map_courses(given.maps) if given.maps else courses_of("aerial-1")[:: given.every]
        courses = [
            replace(one, vehicle=replace(one.vehicle, dynamics=given.dynamics)) for one in courses
        ]
        found = {name: flown(name, courses, given.entries or Path(spare)) for name in given.robots}
    page = given.page or (PAGE.with_stem("fly-real") if given.maps else PAGE)
    lines = [*tables(found), "", *how_hard(found), "", *first_plans(found), "", period(courses[0])]
    print("\n".join(lines))
    write_tables(page, lines)


def parts(name: str) -> tuple[str, str | None]:
    """The robot and the network that a name of --robots stands for."""
    if name in NAMES:
        return name, None
    network = name.removeprefix(f"{FORGETFUL}:")
    return ("optimistic" if network == name else FORGETFUL), network


def titled(name: str) -> str:
    """What a robot is called in tables and in the name of its entry."""
    robot, network = parts(name)
    if network is None:
        return robot
    return Path(network).stem + (", last scan" if robot == FORGETFUL else "")


def flown(name: str, courses: Sequence[Course], entries: Path) -> list[Row]:
    """The flights of a robot through all courses; those that its entry holds are not flown."""
    entries.mkdir(parents=True, exist_ok=True)
    entry = entries / f"{titled(name)}.json"
    robot, weights = parts(name)
    work = partial(fly_course, robot=robot, weights=weights)
    with Progress(name, shown=False) as progress:
        done = fly_courses(courses, work, name, "aerial-1", entry, ALONE, progress)
    print(f"{name}: {sum(len(flights) for _, flights in done)} flights", flush=True)
    return [(course, one) for course, flights in done for one in flights]


def told(rows: Iterable[Row], of: Callable[[Flown], float], scale: Any = "amount") -> Any:
    """A figure of flights; its interval is over worlds."""
    rows = list(rows)
    return figure([of(one) for _, one in rows], [course.sha256 for course, _ in rows], scale)


def tables(found: dict[str, list[Row]]) -> list[str]:
    """Every robot's figures, what completion adds to the baselines, and success by world."""
    success = FIGURES["success"]
    lines = ["", "## Robots", "", *head([*FIGURES, "decision, ms"])]
    for name, rows in found.items():
        cells = [
            brief(told(rows, of, "outcome" if title in ("success", "collision") else "amount"))
            for title, of in FIGURES.items()
        ]
        step = np.mean([one.step_s for _, one in rows]) * 1e3
        lines.append(line(f"`{titled(name)}`", [*cells, f"{step:.1f}"]))
    for base in filter(found.__contains__, BASELINES):
        lines += ["", f"## Flight by flight, less `{base}`", "", *head(["success", "score"])]
        for name, rows in found.items():
            cells = []
            for of in (success, FIGURES["score"]):
                pairs = zip(rows, found[base], strict=True)
                differences = [of(one) - of(other) for (_, one), (_, other) in pairs]
                worlds = [course.sha256 for course, _ in rows]
                cells.append(brief(figure(differences, worlds), "+.3f"))
            lines.append(line(f"`{titled(name)}`", cells))
    for title, groups, key in (
        ("difficulty", DIFFICULTIES, lambda course: course.difficulty),
        ("kind", kind_names(), lambda course: course.world),
        ("map", tuple(MAPS), lambda course: Path(course.world).name),
    ):
        if not any(key(course) in groups for course, _ in next(iter(found.values()))):
            continue
        for what in BY_GROUP:
            lines += ["", f"## {what.capitalize()}, by {title}", "", *head(groups)]
            for name, rows in found.items():
                parts = [[row for row in rows if key(row[0]) == group] for group in groups]
                values = [np.array([FIGURES[what](one) for _, one in part]) for part in parts]
                shown = [each[np.isfinite(each)] for each in values]
                cells = [f"{each.mean():.2f}" if len(each) else "–" for each in shown]
                lines.append(line(f"`{titled(name)}`", cells))
    return lines


def how_hard(found: dict[str, list[Row]]) -> list[str]:
    """The figures of difficulty by level, and success in the third of the flights that each figure
    calls easiest, and in the hardest third."""
    courses = dict.fromkeys(course for course, _ in next(iter(found.values())))
    grades = [(course.difficulty, grade) for course in courses for grade in course.graded()]
    levels = [one for one in (*DIFFICULTIES, None) if one in {level for level, _ in grades}]
    lines = ["## How hard the flights are", "", *head([one or "all" for one in levels])]
    for name in HARDER:
        of_level = [[getattr(it, name) for level, it in grades if level == one] for one in levels]
        lines.append(line(f"`{name}`", [f"{np.nanmean(values):.2f}" for values in of_level]))
    robots = {name: rows for name, rows in found.items() if name != "truth"}
    lines += ["", "Success in the easiest third, by the figure · in the hardest:", ""]
    lines += head([f"`{titled(name)}`" for name in robots])
    reached = [np.array([FIGURES["success"](one) for _, one in rows]) for rows in robots.values()]
    for name, harder in HARDER.items():
        order = np.argsort([harder * getattr(it, name) for _, it in grades], kind="stable")
        third = max(len(order) // 3, 1)
        ends = order[:third], order[-third:]
        cells = [" · ".join(f"{one[end].mean():.2f}" for end in ends) for one in reached]
        lines.append(line(f"`{name}`", cells))
    return lines


def first_plans(found: dict[str, list[Row]]) -> list[str]:
    """How often the first plan is free of collisions, flown blindly as far as the first map shows;
    and what that says of the flight."""
    lines = ["## The first plan and the flight", ""]
    lines += head(["first plan is free", "goal reached, if it is", "if it is not"])
    for name, rows in found.items():
        if name in NAMES and name not in MAPPING:
            continue
        free = [
            first_plan_is_free(course, n % course.flights, name)
            for n, (course, _) in enumerate(rows)
        ]
        reached = [one.outcome == "success" for _, one in rows]
        is_free, worlds = np.array(free), [course.sha256 for course, _ in rows]
        parts = [np.where(is_free == value, reached, np.nan) for value in (True, False)]
        shares = [figure(free, worlds, "outcome"), *(figure(one, worlds) for one in parts)]
        lines.append(line(f"`{titled(name)}`", map(brief, shares)))
    return lines


def first_plan_is_free(course: Course, number: int, name: str) -> bool:
    """Whether the way that a robot plans first leaves room for the vehicle, up to the edge of its
    first map."""
    robot = robot_maker(*parts(name))(course)
    flying = course.simulation(number)
    robot.reset(flying.about())
    robot.act(flying.observe())
    if robot.path is None:
        return False
    is_free = course.drawn.clearance.motion_is_free
    rim = RIM * robot.grid.voxel_m
    low, high = robot.origin + rim, robot.origin + robot.grid.extent_m - rim
    for start, end in zip(robot.path, robot.path[1:], strict=False):
        way = end - start
        room = np.where(way > 0, high, low) - start
        share = np.divide(room, way, out=np.ones(3), where=way != 0).min()
        end = start + min(share, 1.0) * way
        if not is_free(tuple(start), tuple(end), course.vehicle.radius_m):
            return False
        if share < 1:  # of what lies beyond, the map shows nothing
            break
    return True


def period(course: Course) -> str:
    """What it takes to see and to move, ten times a second."""
    flying = course.simulation(0)
    spent = []
    for _ in range(20):
        begin = time.process_time()
        flying.observe()
        flying.step(np.zeros(4, np.float32))
        spent.append(time.process_time() - begin)
    return f"To see and to move takes {np.median(spent) * 1e3:.1f} ms of processor time a period."


if __name__ == "__main__":
    main()
