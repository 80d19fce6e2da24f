"""Does completing the scene help a robot that moves? Robots fly the suite: docs/results/fly.md.

    python benchmarks/fly.py ENTRIES                        # flies what ENTRIES lacks: fly.csv
    python benchmarks/fly.py ENTRIES --every 1 --robots "optimistic, brakes" "my_net.onnx, brakes"
    python benchmarks/fly.py ENTRIES --every 1 --tracks movers unseen     # fly-movers.csv, …
    python benchmarks/fly.py ENTRIES --every 1 --tracks places --maps MAPS

ENTRIES is a folder with an entry of each track and robot, as `scenegen fly suite` writes them; one
that is there goes on. Every tenth course of `drawn` is one world of each kind and level. A name
that is no robot's is a network, with which a robot maps; as `returns:NETWORK`, it completes the
last scan alone, and as `sampling:NETWORK`, the robot plans by RRT*. A name may end in ", brakes",
or in ", brakes at 0.5" (the doubt). Decisions are timed in this process alone. With --charged, each
robot's decisions come as late as they took when they were measured.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import measuring
import numpy as np
from scoring import RESULTS, publish, titled, told
from tyro.conf import Positional

from lidarsim.grid import Floats
from scenegen.base.workers import ALONE
from scenegen.dataset.locate import file_sha256
from scenegen.fly.course import Course
from scenegen.fly.loop import Flown
from scenegen.fly.motion import STEP_S
from scenegen.fly.simulation import HITS
from scenegen.fly.suite import KINDS, LEVELS, SUITE, TRAFFIC, UNSEEN, chosen_courses, frozen, late
from scenegen.model.completion.completer import locate
from scenegen.model.robots import NAMES, WITH_NETWORK, robot_name, split_robot_name
from scenegen.model.robots.flights import crew_of, fly_course, fly_courses

ROBOTS = (
    *("truth", "optimistic", "optimistic, brakes", "extrude, brakes", "returns", "reactive"),
    *("columns, brakes", "anywhere", "anywhere, brakes", "anywhere, brakes at 0.5"),
)
BASELINES = ("optimistic, brakes", "extrude, brakes")
LATENCY_S = {
    "reactive": 1 * STEP_S,
    "truth": 1 * STEP_S,
    "optimistic": 1 * STEP_S,
    "optimistic, brakes": 1 * STEP_S,
    "extrude": 1 * STEP_S,
    "extrude, brakes": 1 * STEP_S,
    "returns": 1 * STEP_S,
    "sampling": 2 * STEP_S,
    "sampling, brakes": 1 * STEP_S,
    "columns": 4 * STEP_S,
    "columns, brakes": 3 * STEP_S,
    "anywhere": 4 * STEP_S,
    "anywhere, brakes": 3 * STEP_S,
    "anywhere, brakes at 0.5": 3 * STEP_S,
}
"""What a decision takes, mean, rounded up to steps of the motion, seconds: measured by
benchmarks/decisions.py on one core of an AMD EPYC (2 cores, AVX-512), networks in torch."""
Found = dict[str, dict[str, Floats]]
"""By robot and figure, of every flight, (flights,)."""
DECISION = "decision, ms"
"""Told without an interval: by the clock, beside other work."""
FIGURES: dict[str, Callable[[Flown], float]] = {
    "success": lambda one: one.outcome == "success",
    "success, blocked line": lambda one: one.outcome == "success" if one.blocked else np.nan,
    "collision": lambda one: one.outcome in HITS,
    "progress": lambda one: one.progress,
    "score": lambda one: one.score,
    "path ratio": lambda one: one.ratio if one.outcome == "success" else np.nan,
    "time, s": lambda one: one.time_s if one.outcome == "success" else np.nan,
    "mean clearance, m": lambda one: one.mean_clearance_m,
    "jerk, m/s³": lambda one: one.jerk_mps3,
    DECISION: lambda one: 1e3 * one.step_s,
}
OUTCOMES = ("success", "success, blocked line", "collision")
"""Figures that are 1 or 0."""
GAINS = ("success", "progress", "score")
"""Figures of which differences are told."""
BY_GROUP = ("success", "score", "progress", "time, s")
"""Figures that are told for every difficulty and kind, too."""


class Options(measuring.Options):
    """Who flies, and where."""

    entries: Positional[Path | None] = None
    """folder of the entries"""
    every: int = 10
    """one of so many courses"""
    tracks: Sequence[str] = ("drawn",)
    maps: Path | None = None
    """folder of the maps of the track places"""
    robots: Sequence[str] = ROBOTS
    dynamics: Literal["kinematic", "mujoco"] = "kinematic"
    """of the vehicle"""
    charged: bool = False
    """decisions come late by `LATENCY_S`"""
    figures: Path | None = None


def main() -> None:
    """Fly what is missing; print the tables, and write them beside the page."""
    given = measuring.parse(Options, every=300, robots=["reactive", "optimistic, brakes"])
    for track in given.tracks:
        name = "fly.csv" if track == "drawn" else f"fly-{track}.csv"
        measured(track, replace(given, figures=given.figures or RESULTS / name))


def measured(track: str, given: Options) -> None:
    """Fly what is missing of a track; print its tables, and write them."""
    with tempfile.TemporaryDirectory() as spare:
        courses = [
            replace(one, vehicle=replace(one.vehicle, dynamics=given.dynamics))
            for one in chosen_courses(track, given.maps, quick=False)[:: given.every]
        ]
        found: Found = {}
        for name in given.robots:
            latency_s = LATENCY_S[parts(name)[2]] if given.charged else 0.0
            own = [late(one, latency_s) for one in courses]
            found |= flown(name, own, track, given.entries or Path(spare))
    of_each = [course for course in courses for _ in range(course.flights)]
    worlds = [course.sha256 for course in of_each]
    lines = robots(found, worlds)
    for base in BASELINES:
        lines += less(base, found, worlds) if base in found else []
    publish(given, [*lines, *by_groups(found, of_each)])


def parts(name: str) -> tuple[str, str | None, str, float | None]:
    """The robot and the network that a name of --robots stands for; what this robot is called in
    tables and in the name of its entry; and how it brakes."""
    plain, brakes = split_robot_name(name)
    if plain in NAMES:
        return plain, None, name, brakes
    robot = next((one for one in WITH_NETWORK if plain.startswith(f"{one}:")), "optimistic")
    network = plain.removeprefix(f"{robot}:")
    title = Path(network).stem
    if robot in WITH_NETWORK:
        title += f", {WITH_NETWORK[robot]}"
    return robot, network, robot_name(title, brakes), brakes


def flown(name: str, courses: Sequence[Course], track: str, entries: Path) -> Found:
    """The figures of a robot's flights through all courses; those that its entry holds are not
    flown."""
    robot, weights, title, brakes = parts(name)
    entries.mkdir(parents=True, exist_ok=True)
    entry = entries / f"{track}-{title.replace(', ', '-')}.json"
    work = partial(fly_course, robot=robot, weights=weights, brakes=brakes)
    network = file_sha256(locate(weights)) if weights else ""
    crew = crew_of(ALONE)
    done = fly_courses(courses, work, title, SUITE, entry, crew, track=track, network=network)
    flights = [one for _, several in done for one in several]
    print(f"{name}: {len(flights)} flights", flush=True)
    return {title: {what: np.array([*map(of, flights)], float) for what, of in FIGURES.items()}}


def robots(found: Found, worlds: Sequence[str]) -> list[str]:
    """Every robot's figures; intervals are over worlds."""
    rows = []
    for name, figures in found.items():
        cells = [
            told(values, worlds, ".3f", "outcome" if title in OUTCOMES else "amount")
            for title, values in figures.items()
        ]
        cells[-1] = f"{figures[DECISION].mean():.1f}"
        rows.append((f"`{name}`", cells))
    return titled("## Robots", FIGURES, rows)


def less(base: str, found: Found, worlds: Sequence[str]) -> list[str]:
    """What every robot gains on the robot `base`, flight by flight."""
    rows = (
        (f"`{name}`", [told(one[what] - found[base][what], worlds, "+.3f") for what in GAINS])
        for name, one in found.items()
    )
    return titled(f"## Flight by flight, less `{base}`", GAINS, rows)


def by_groups(found: Found, courses: Sequence[Course]) -> list[str]:
    """Some figures by difficulty and kind, or by map."""
    lines = []
    for title, groups, keys in (
        ("level", (*LEVELS, *TRAFFIC), [course.level for course in courses]),
        ("kind", (*KINDS, *UNSEEN), [course.world for course in courses]),
        ("map", [*frozen()["places"]], [Path(course.world).name for course in courses]),
    ):
        groups = [group for group in dict.fromkeys(groups) if group in keys]
        for what in BY_GROUP if groups else ():
            rows = []
            for name, figures in found.items():
                of_groups = (figures[what][np.array(keys) == group] for group in groups)
                means = [
                    f"{np.nanmean(values):.2f}" if np.isfinite(values).any() else "–"
                    for values in of_groups
                ]
                rows.append((f"`{name}`", means))
            lines += titled(f"## {what.capitalize()}, by {title}", groups, rows)
    return lines


if __name__ == "__main__":
    main()
