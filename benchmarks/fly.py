"""Does completing the scene help a robot that moves? Robots fly the suite: docs/results/fly.md.

    python benchmarks/fly.py                        # the tables, from fly-flights.csv.gz
    python benchmarks/fly.py ENTRIES --maps MAPS    # first flies what ENTRIES lacks
    python benchmarks/fly.py ENTRIES --runs drawn unseen --robots "optimistic, brakes"

A run of the plan (benchmarks/fly.md) is a track of the suite, or 60 worlds of it, with something
that differs. ENTRIES is a folder with a recording of each run and robot; one that is there is not
flown again, and an entry to the suite goes on. Rows of other runs and robots stay in the file of
flights.
A network's robot completes all scans; as `returns:NETWORK`, only the last one; as
`sampling:NETWORK`, it plans by RRT*. The end ", brakes" stands for --brakes, ", brakes at 0.5" for
--brakes --doubt 0.5.
"""

import csv
import gzip
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import measuring
import numpy as np
from numpy.typing import NDArray
from places import PLACES
from scoring import RESULTS, publish, titled, told
from tyro.conf import Positional

from lidarsim.grid import Floats
from scenegen.base.workers import ALONE
from scenegen.dataset.locate import file_sha256
from scenegen.fly.course import Course, read_recording
from scenegen.fly.motion import STEP_S
from scenegen.fly.simulation import HITS
from scenegen.fly.suite import (
    SUITE,
    VEHICLE,
    WORLDS,
    chosen_courses,
)
from scenegen.model.bench.statistics import holm, paired_p, summarise
from scenegen.model.completion.completer import locate
from scenegen.model.robots import NAMES, WITH_NETWORK, robot_name, split_robot_name
from scenegen.model.robots.flights import crew_of, fly_course, fly_courses

LATENCY_S = {
    "reactive": 1 * STEP_S,
    "truth": 1 * STEP_S,
    "optimistic": 1 * STEP_S,
    "optimistic, brakes": 1 * STEP_S,
    "pessimistic, brakes": 1 * STEP_S,
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
    "sampling:anywhere, brakes": 3 * STEP_S,
    "seed-11, brakes": 3 * STEP_S,
    "seed-12, brakes": 3 * STEP_S,
}
"""What a decision takes, mean, rounded up to steps of the motion, seconds: measured by
benchmarks/decisions.py on one core of an AMD EPYC (2 cores, AVX-512), networks in torch."""


class Run(NamedTuple):
    """Who flies where, and what differs from the suite."""

    robots: Sequence[str]
    track: str = "drawn"
    some: bool = False
    """Only the first `SOME` worlds of each kind and level."""
    vehicle: Mapping[str, Any] = {}
    rules: Mapping[str, Any] = {}
    """Without a latency, that of the robot is charged."""
    noise: str = ""


SOME = 2
VLP_16 = "range:0.03,quantise:0.002"
"""What Velodyne's data sheet says; the suite's own sensor has none."""
PAIR = ("optimistic, brakes", "anywhere, brakes")
SIX = ("truth", *PAIR, "extrude, brakes", "columns, brakes", "anywhere")
FIVE = tuple(name for name in SIX if name != "columns, brakes")
SEEDS = ("seed-11, brakes", "seed-12, brakes")
"""Networks with the layers of `anywhere`, of other training seeds: benchmarks/fly.md has how to
train them; --exported is their folder."""
ALL = (*SIX, "optimistic", "anywhere, brakes at 0.5", "returns", "reactive")
AT_SPEEDS = {"1 m/s": 1.0, "2 m/s": 2.0, "6 m/s": 6.0, "8 m/s": 8.0}
"""Runs at other speeds than the suite's, m/s."""
SPEEDS_MPS = dict(sorted([*AT_SPEEDS.items(), ("drawn", VEHICLE.speed_mps)], key=lambda at: at[1]))
VARIED = {
    "drift": Run(PAIR, some=True, rules={"drift_m": 0.6, "drift_deg": 0.2}),
    "noise": Run(PAIR, some=True, noise=VLP_16),
    "no latency": Run(PAIR, some=True, rules={"latency_s": 0.0}),
    "latency 0.1 s": Run(PAIR, some=True, rules={"latency_s": 0.1}),
    "latency 0.2 s": Run(PAIR, some=True, rules={"latency_s": 0.2}),
    "RRT*": Run(("sampling, brakes", "sampling:anywhere, brakes"), some=True),
}
RUNS: dict[str, Run] = {
    "drawn": Run(ALL),
    "unseen": Run((*SIX, "pessimistic, brakes"), "unseen"),
    **{track: Run(SIX, track) for track in ("movers", "places")},
    **{
        title: Run(FIVE, some=True, vehicle={"speed_mps": speed})
        for title, speed in AT_SPEEDS.items()
    },
    **VARIED,
    "seeds": Run(SEEDS, some=True),
    "seeds, unseen": Run(SEEDS, "unseen"),
}


class Claim(NamedTuple):
    """A hypothesis of the plan: that `first` differs from `second` in this direction."""

    run: str
    first: str
    second: str
    figure: str
    sign: int = 1


BLOCKED = "score, blocked line"
CLAIMS = {
    "H1": Claim("drawn", "anywhere, brakes", "optimistic, brakes", BLOCKED),
    "H2": Claim("unseen", "anywhere, brakes", "optimistic, brakes", BLOCKED),
    "H3": Claim("movers", "anywhere, brakes", "optimistic, brakes", "score"),
    "H4": Claim("places", "anywhere, brakes", "optimistic, brakes", "collision", -1),
    "H5": Claim("drawn", "anywhere, brakes", "extrude, brakes", BLOCKED),
    "H6": Claim("drawn", "anywhere, brakes at 0.5", "anywhere, brakes", "score"),
    "H7": Claim("drawn", "anywhere, brakes", "anywhere", "success"),
    "H8": Claim("unseen", "columns, brakes", "anywhere, brakes", BLOCKED, -1),
}
LEAST = {"success": 0.03, "collision": 0.03, "score": 0.01, BLOCKED: 0.01}
"""The smallest differences of interest."""
TIME = "time, of the shortest"
Rows = dict[str, NDArray[Any]]
"""Flights by column, (flights,)."""
FIGURES: dict[str, Callable[[Rows], Any]] = {
    "success": lambda rows: rows["outcome"] == "success",
    "success, blocked line": lambda rows: np.where(rows["blocked"], rows["success"], np.nan),
    "collision": lambda rows: np.isin(rows["outcome"], HITS),
    "progress": lambda rows: rows["progress"],
    "score": lambda rows: rows["score"],
    BLOCKED: lambda rows: np.where(rows["blocked"], rows["score"], np.nan),
    "path ratio": lambda rows: np.where(rows["success"], rows["ratio"], np.nan),
    TIME: lambda rows: np.where(rows["success"], rows["time_s"] / rows["shortest_s"], np.nan),
    "mean clearance, m": lambda rows: rows["mean_clearance_m"],
}
"""Made in this order; the first is there for the others."""
OUTCOMES = ("success", "success, blocked line", "collision")
"""Figures that are 1 or 0."""
BASELINES = ("optimistic, brakes", "extrude, brakes")
GAINS = ("success", "collision", "progress", "score", BLOCKED)
"""Figures of which differences are told."""
NUMBERS = (
    *("blocked", "score", "progress", "time_s", "shortest_s", "ratio"),
    *("mean_clearance_m", "min_clearance_m"),
)
COLUMNS = ("run", "robot", "world", "level", "seed", "mission", "outcome", *NUMBERS, "digest")


class Options(measuring.Options):
    """Who flies, and where."""

    entries: Positional[Path | None] = None
    """folder of the recordings; without it, nothing is flown"""
    runs: Sequence[str] = tuple(RUNS)
    robots: Sequence[str] | None = None
    """some of those of the plan; by default all"""
    maps: Path | None = None
    """folder of the maps of the track places"""
    exported: Path | None = None
    """folder of the bundled networks as `scenegen export` writes them, which are faster"""
    flights: Path = RESULTS / "fly-flights.csv.gz"
    figures: Path = RESULTS / "fly.csv"


def main() -> None:
    """Fly what is missing; print the tables, and write them beside the page."""
    given = measuring.parse(Options, runs=["drawn"], robots=["reactive", "optimistic, brakes"])
    with tempfile.TemporaryDirectory() as spare:
        entries = given.entries or (Path(spare) if given.smoke else None)
        file = Path(spare) / given.flights.name if given.smoke else given.flights
        for title in given.runs if entries else ():
            for name in given.robots or RUNS[title].robots:
                keep(flown(title, name, Path(str(entries)), given), file)
        runs = by_run(file)
    publish(given, [*claims(runs), *curves(runs), *variations(runs), *seeds(runs), *tracks(runs)])


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


def courses_of(title: str, name: str, given: Options) -> list[Course]:
    """The courses of a run for the robot of this name; with --smoke, the first one."""
    run = RUNS[title]
    every = chosen_courses(run.track, given.maps if run.track == "places" else None, quick=False)
    if run.some:  # worlds of a kind and level follow one another
        every = [one for n, one in enumerate(every) if n % WORLDS["drawn"] < SOME]
    rules = {"latency_s": LATENCY_S[name], **run.rules}
    return [
        replace(
            one,
            vehicle=replace(one.vehicle, **run.vehicle),
            rules=replace(one.rules, **rules),
            noise=run.noise,
        )
        for one in every[: 1 if given.smoke else None]
    ]


def flown(title: str, name: str, entries: Path, given: Options) -> list[list[Any]]:
    """A row for each flight of a robot; those that its recording holds are not flown."""
    robot, network, called, brakes = parts(name)
    exported = given.exported and network and given.exported / f"{network}.onnx"
    if exported and exported.is_file():
        network = str(exported)
    courses = courses_of(title, name, given)
    entries.mkdir(parents=True, exist_ok=True)
    file = entries / f"{title}-{called.replace(', ', '-')}.json"
    work = partial(fly_course, robot=robot, weights=network, brakes=brakes)
    if title == (track := RUNS[title].track):
        sha256 = file_sha256(locate(network)) if network else ""
        done = fly_courses(
            courses, work, called, SUITE, file, crew_of(ALONE), track=track, network=sha256
        )
    elif file.exists():
        done = read_recording(file).courses
    else:
        done = fly_courses(courses, work, called, None, file, crew_of(ALONE))
    print(f"{title}: {name}: {sum(len(several) for _, several in done)} flights", flush=True)
    return [
        [
            *(title, called, Path(course.world).name, course.level, course.seed, mission),
            *(one.outcome, int(one.blocked), f"{one.score:.5f}", f"{one.progress:.4f}"),
            f"{one.time_s:.3f}",
            f"{one.shortest_m / course.vehicle.speed_mps:.3f}",
            *(f"{one.ratio:.4f}", f"{one.mean_clearance_m:.3f}", f"{one.min_clearance_m:.4f}"),
            one.digest[:8],
        ]
        for course, several in done
        for mission, one in enumerate(several)
    ]


def keep(rows: Sequence[Sequence[Any]], path: Path) -> None:
    """Put rows into the file of flights, in the place of those of the same run and robot."""
    ours = {tuple(row[:2]) for row in rows}
    old = [row for row in read(path) if tuple(row[:2]) not in ours] if path.exists() else []
    order = [(title, parts(name)[2]) for title, run in RUNS.items() for name in run.robots]
    every = sorted([*old, *rows], key=lambda row: order.index((row[0], row[1])))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([COLUMNS, *every])
    path.write_bytes(gzip.compress(text.getvalue().encode(), mtime=0))


def read(path: Path) -> list[list[str]]:
    """The rows of the file of flights."""
    with gzip.open(path, "rt", encoding="utf-8", newline="") as text:
        return [*csv.reader(text)][1:]


def by_run(path: Path) -> dict[str, dict[str, Rows]]:
    """The flights of each run and robot, with the figures of each."""
    found: dict[str, dict[str, list[list[str]]]] = {}
    for row in read(path):
        found.setdefault(row[0], {}).setdefault(row[1], []).append(row)
    return {
        title: {name: measured(several) for name, several in robots.items()}
        for title, robots in found.items()
    }


def measured(several: Sequence[Sequence[str]]) -> Rows:
    """The columns and figures of a robot's flights through a run."""
    rows: Rows = dict(zip(COLUMNS, np.array(several).T, strict=True))
    rows |= {name: rows[name].astype(float) for name in NUMBERS}
    courses = zip(rows["world"], rows["level"], rows["seed"], strict=True)
    # of a drawn world, the flights through it; of a map, all through its place
    rows["group"] = np.array([" ".join(one) if one[1] else place_of(one[0]) for one in courses])
    for title, of in FIGURES.items():
        rows[title] = np.asarray(of(rows), float)
    return rows


def place_of(world: str) -> str:
    """The place of a map, or the world itself."""
    return str(PLACES.get(Path(world).stem, {}).get("place", world))


def by_group(rows: Rows, figure: str) -> Floats:
    """The mean of a figure in each world or place, in the order of their names; NaN where no flight
    has it."""
    _, member = np.unique(rows["group"], return_inverse=True)
    has = np.isfinite(rows[figure])
    count = np.bincount(member, has)
    total = np.bincount(member, np.where(has, rows[figure], 0.0))
    return np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)


def gain(first: Rows, second: Rows, figure: str) -> Floats:
    """By how much a robot differs from another in each world."""
    return by_group(first, figure) - by_group(second, figure)


def shown(values: Floats, form: str = "+.3f") -> str:
    """The mean of worlds' values, with its interval."""
    return told(values, range(len(values)), form)


def claims(runs: Mapping[str, Mapping[str, Rows]]) -> list[str]:
    """The verdict on each hypothesis of the plan whose flights are there."""
    there = {
        title: one
        for title, one in CLAIMS.items()
        if {one.first, one.second} <= runs.get(one.run, {}).keys()
    }
    gains = {
        title: gain(runs[one.run][one.first], runs[one.run][one.second], one.figure)
        for title, one in there.items()
    }
    rng = np.random.default_rng(0)
    chances = [
        paired_p(values, np.zeros_like(values), range(len(values)), rng=rng)
        for values in gains.values()
    ]
    # a hypothesis that is not flown yet counts among the eight
    adjusted = holm([*chances, *[1.0] * (len(CLAIMS) - len(there))])
    rows = []
    for (title, one), values, p in zip(there.items(), gains.values(), adjusted, strict=False):
        cells = [one.run, f"`{one.first}` less `{one.second}`", one.figure, shown(values)]
        also = (gain(runs[one.run][one.first], runs[one.run][one.second], "success"),)
        rows.append((title, [*cells, f"{p:.4f}", verdict(one, values, p), *map(shown, also)]))
    heads = ("run", "robots", "figure", "difference", "p (Holm)", "verdict", "success, difference")
    return titled("## Hypotheses", heads, rows) if rows else []


def verdict(claim: Claim, values: Floats, p: float) -> str:
    """What a hypothesis's differences show, as the plan says."""
    found = summarise(values, range(len(values)))
    if p < 0.05:
        return "shown" if found["mean"] * claim.sign > 0 else "contradicted"
    most = found["high"] if claim.sign > 0 else -found["low"]
    return "ruled out" if most < LEAST[claim.figure] else "open"


def curves(runs: Mapping[str, Mapping[str, Rows]]) -> list[str]:
    """Success, score and time at every speed, in the worlds that are flown at all of them."""
    there = [title for title in SPEEDS_MPS if title in runs]
    lines = []
    for figure in ("success", "score", TIME) if there[1:] else ():
        rows = [
            (
                f"`{name}`",
                [
                    shown(by_group(some(runs[title][name]), figure), ".3f")
                    if name in runs[title]
                    else "–"
                    for title in there
                ],
            )
            for name in FIVE
        ]
        lines += titled(
            f"## {figure.capitalize()}, by speed",
            [f"{SPEEDS_MPS[title]:g} m/s" for title in there],
            rows,
        )
    return lines


def some(rows: Rows) -> Rows:
    """The flights through the first `SOME` worlds of each kind and level."""
    firsts: dict[tuple[str, str], list[str]] = {}
    for world, level, seed in zip(rows["world"], rows["level"], rows["seed"], strict=True):
        seeds = firsts.setdefault((world, level), [])
        if seed not in seeds and len(seeds) < SOME:
            seeds.append(seed)
    named = zip(rows["world"], rows["level"], rows["seed"], strict=True)
    chosen = np.array([seed in firsts[world, level] for world, level, seed in named])
    return {name: values[chosen] for name, values in rows.items()}


def variations(runs: Mapping[str, Mapping[str, Rows]]) -> list[str]:
    """What each variation changes, and what completion gains there, in the same worlds."""
    lines, drawn = [], runs.get("drawn", {})
    for figure in ("success", "score"):
        rows = []
        for title, run in {"none": RUNS["drawn"]._replace(robots=PAIR), **VARIED}.items():
            flights = runs.get(title, {}) if title in VARIED else drawn
            robots = [parts(name)[2] for name in run.robots]
            if {*robots} <= flights.keys():
                plain, completing = (some(flights[name]) for name in robots)
                usual = [some(drawn[name]) for name in PAIR]
                pairs = [(plain, usual[0]), (completing, usual[1]), (completing, plain)]
                rows.append((title, [shown(gain(*pair, figure)) for pair in pairs]))
        heads = [
            f"`{PAIR[0]}`, changed by",
            f"`{PAIR[1]}`, changed by",
            "the second less the first",
        ]
        lines += titled(f"## {figure.capitalize()}, by variation", heads, rows) if rows[1:] else []
    return lines


def seeds(runs: Mapping[str, Mapping[str, Rows]]) -> list[str]:
    """How networks of other training seeds differ, in the same worlds."""
    lines = []
    for title in ("seeds", "seeds, unseen"):
        if {*SEEDS} <= (flights := runs.get(title, {})).keys():
            usual = {name: runs[RUNS[title].track][name] for name in PAIR}
            if RUNS[title].some:
                usual = {name: some(rows) for name, rows in usual.items()}
            flights = {**flights, **usual}
            pairs = [*product(SEEDS, PAIR), SEEDS[::-1]]
            cells = [
                (
                    f"`{one}` less `{other}`",
                    [shown(gain(flights[one], flights[other], figure)) for figure in GAINS],
                )
                for one, other in pairs
            ]
            lines += titled(f"## Training {title}", GAINS, cells)
    return lines


def tracks(runs: Mapping[str, Mapping[str, Rows]]) -> list[str]:
    """Every robot's figures in each track, over worlds; what it gains on others, flight by flight;
    and success and score by group."""
    lines = []
    for track in [title for title in runs if RUNS[title].track == title]:
        robots = runs[track]
        rows = [
            (
                f"`{name}`",
                [
                    told(flights[figure], flights["group"], ".3f", scale_of(figure))
                    for figure in FIGURES
                ],
            )
            for name, flights in robots.items()
        ]
        lines += titled(f"## Robots: {track}", FIGURES, rows)
        for base in [name for name in BASELINES if name in robots]:
            rows = [
                (
                    f"`{name}`",
                    [
                        *(shown(gain(flights, robots[base], figure)) for figure in GAINS),
                        *(longer(flights, robots[base], what) for what in ("ratio", "time_s")),
                    ],
                )
                for name, flights in robots.items()
            ]
            heads = *GAINS, "path, log ratio", "time, log ratio"
            lines += titled(f"## {track.capitalize()}, less `{base}`", heads, rows)
        for column, figure in product(("level", "world"), ("success", "score")):
            groups = list(dict.fromkeys(next(iter(robots.values()))[column]))
            rows = [
                (
                    f"`{name}`",
                    [f"{flights[figure][flights[column] == one].mean():.2f}" for one in groups],
                )
                for name, flights in robots.items()
            ]
            if groups[1:]:
                lines += titled(f"## {track.capitalize()}, {figure} by {column}", groups, rows)
    return lines


def longer(first: Rows, second: Rows, what: str) -> str:
    """The logarithm of the ratio of a column, over the flights that both robots end at the goal."""
    both = (first["success"] > 0) & (second["success"] > 0)
    values = np.full(len(both), np.nan)
    values[both] = np.log(first[what][both] / second[what][both])
    return told(values, first["group"], "+.3f")


def scale_of(figure: str) -> Any:
    """The kind of a figure's values, for intervals."""
    return "outcome" if figure in OUTCOMES else "amount"


if __name__ == "__main__":
    main()
