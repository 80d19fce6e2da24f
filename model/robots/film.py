"""Films of a flight: what is there, what the robot takes for occupied, and its way; and the
leaderboard, a page of the entries to a suite with such films."""

import html
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from lidarsim import GridSpec
from lidarsim.grid import Floats, Mask
from lidarsim.pose import rotate
from lidarsim.voxelization import sort_points
from scenegen.cli.show import Progress
from scenegen.display.colours import GOAL, INVENTED, SENSOR
from scenegen.display.look import Guess, Look, Route
from scenegen.display.page import page
from scenegen.errors import DatasetError, ScenegenError, raised_as
from scenegen.fly.course import Course, Recording, flown_again
from scenegen.fly.loop import Flown, marks
from scenegen.fly.simulation import Observation
from scenegen.fly.suite import Part, frozen_courses, named, part_of, track_name
from scenegen.model.evaluation.report import HEAD, STYLE, Table, block, framed
from scenegen.model.evaluation.statistics import Scale, brief, figure
from scenegen.model.robots.flights import real_course
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
        for n, (seen, *_) in enumerate(flown_again(self.simulation, self.flown)):
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
        at = moment.seen["position"]
        level = min(max(int(at[2] / voxel_m - start[2]), 0), z - 1)
        there = scene.truth[:, :, level]
        colours = np.full((x, y, 3), FREE, np.uint8)
        colours[there] = UNHELD
        if moment.taken is not None:
            taken = moment.taken[:, :, level]
            colours[there & taken], colours[taken & ~there] = RIGHT, INVENTED
        from_above = colours[:, ::-1].transpose(1, 0, 2)
        picture = Image.fromarray(from_above.repeat(scale, axis=0).repeat(scale, axis=1))
        draw = ImageDraw.Draw(picture)
        if moment.plan is not None and len(moment.plan) > 1:
            draw.line(pixels(moment.plan), fill=PLAN, width=2)
        draw.line(pixels(moment.way), fill=WAY, width=2)
        discs = (
            (scene.simulation.mission.goal, course.rules.reach_m, GOAL),
            (at, course.vehicle.radius_m, SENSOR),
        )
        for point, radius_m, fill in discs:
            ((u, v),), r = pixels(point), radius_m / voxel_m * scale
            draw.ellipse([u - r, v - r, u + r, v + r], fill=fill)
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


class Column(NamedTuple):
    """What the leaderboard tells of flights."""

    of: Callable[[Flown], float]
    most: float = 1.0
    """No value is greater, and none is less than 0: intervals end there."""
    scale: Scale = "amount"


ENDS = ("success", "collision", "timeout")
"""How flights end of whose robots nothing is wrong; others crash, hang or leave the bounds."""
BOARD = {
    "success": Column(lambda one: one.outcome == "success", scale="outcome"),
    "collision": Column(lambda one: one.outcome == "collision", scale="outcome"),
    "time-out": Column(lambda one: one.outcome == "timeout", scale="outcome"),
    "other end": Column(lambda one: one.outcome not in ENDS, scale="outcome"),
    "score": Column(lambda one: one.score, 0.5),
    "SPL": Column(lambda one: one.spl),
    "least clearance, m": Column(lambda one: one.min_clearance_m),
    "mean clearance, m": Column(lambda one: one.mean_clearance_m),
    "decision, ms": Column(lambda one: 1e3 * one.step_s, float("inf")),
}
BEST = "score, less the best's"
"""The last column: the differences flight by flight."""
SORTED = """
for (const head of document.querySelectorAll("th")) head.onclick = () => {
  const rows = [...head.closest("table").tBodies[0].rows], n = head.cellIndex;
  const value = (row) => row.cells[n].textContent;
  rows.sort((a, b) =>
    parseFloat(value(b)) - parseFloat(value(a)) || value(a).localeCompare(value(b)));
  rows.forEach((row) => row.parentElement.append(row));
};
"""


class Row(NamedTuple):
    """An entry's flights, in the order of their courses' names."""

    robot: str
    courses: Sequence[tuple[Course, int]]
    """Each flight's course, and its number there."""
    flights: Sequence[Flown]

    @property
    def worlds(self) -> list[str]:
        """The hash of each flight's world."""
        return [course.document for course, _ in self.courses]

    @property
    def scores(self) -> list[float]:
        """Of each flight."""
        return [one.score for one in self.flights]


def leaderboard(folder: Path, progress: Progress, hidden: int | None, maps: Path | None) -> str:
    """An HTML page of all entries (.json) in a folder: a table for each choice of courses, those of
    whole tracks first, the best score first, with 95 % intervals over worlds. A click on a column's
    head sorts by it. Below each table, films of one flight show every robot: see `_films`.

    Scores are those of the recorded outcomes, times and lengths, which `--replay` checks. Raises
    DatasetError for a file that is no entry, or has courses that are not its suite's.
    """
    tables: dict[tuple[str, ...], tuple[Part, list[Row]]] = {}
    for path in sorted(folder.glob("*.json")):
        entry = Recording.read(path)
        with raised_as(DatasetError, f"{path}: ", of=DatasetError):
            part = part_of(entry)
        row = _row(entry)
        key = (str(entry.suite), str(part), *row.worlds)
        tables.setdefault(key, (part, []))[1].append(row)
    if not tables:
        raise ScenegenError(f"{folder}: holds no entry, .json as `fly --suite -o` writes it")
    whole_first = sorted(tables.items(), key=lambda table: table[1][0].there < table[1][0].of)
    body = ""
    progress.start(sum(len(rows) for _, (_, rows) in whole_first))
    for (suite, title, *_), (part, rows) in whole_first:
        rows.sort(key=lambda row: -sum(row.scores))
        cells = [(row.robot, _cells(row, rows[0])) for row in rows]
        body += block(Table(f"{suite}, {title}", ("flights", *BOARD, BEST), cells))
        body += _films(suite, part.track, rows, progress, hidden, maps)
    page = HEAD.replace("img-src", "script-src 'unsafe-inline'; img-src")
    style = f"{STYLE} body {{ max-width: none; }} th {{ cursor: pointer; }}"
    page += f"<title>Robots</title><style>{style}</style></head>"
    return f"{page}<body><h1>Robots</h1>{body}<script>{SORTED}</script></body></html>\n"


def _row(entry: Recording) -> Row:
    """An entry's flights, with the scores that their outcomes, times and lengths give."""
    courses, found = [], []
    for course, flights in sorted(entry.courses, key=lambda one: str(named(one[0]))):
        for number, one in enumerate(flights):
            best_s = one.shortest_m / course.vehicle.speed_mps
            success = one.outcome == "success"
            given = marks(success, one.time_s, one.flown_m, one.shortest_m, best_s)
            found.append(replace(one, score=given["score"], spl=given["spl"]))
            courses.append((course, number))
    return Row(entry.robot, courses, found)


def _cells(row: Row, best: Row) -> list[str]:
    """An entry's figures, and its scores less those of the best that flew the same courses."""
    cells = [str(len(row.flights))]
    for column in BOARD.values():
        found = figure([column.of(one) for one in row.flights], row.worlds, column.scale)
        for name in ("low", "high"):
            if found[name] is not None:
                found[name] = min(max(found[name], 0.0), column.most)
        cells.append(brief(found))
    pairs = zip(row.scores, best.scores, strict=True)
    less = figure([one - other for one, other in pairs], row.worlds)
    return [*cells, "–" if row is best else brief(less, "+.3f")]


def _films(
    suite: str,
    track: str,
    rows: Sequence[Row],
    progress: Progress,
    hidden: int | None,
    maps: Path | None,
) -> str:
    """Films (GIF) of the flight on whose outcome robots differ most, one for
    each row whose robot began it.

    "" for worlds that cannot be drawn here: a hidden track's without its number `hidden`, those of
    the real track without the folder of its `maps`.
    """
    if track == "own":
        hidden = None
    elif track != track_name(hidden, maps):
        progress.count(len(rows))
        return ""
    flights = zip(*(row.flights for row in rows), strict=True)
    lost = [sum(one.outcome != "success" for one in flight) for flight in flights]
    chosen = max(range(len(lost)), key=lambda n: (lost[n] * (len(rows) - lost[n]), lost[n]))
    entered, number = rows[0].courses[chosen]
    # not the entry's own, which may lead to another world of that name
    ours = {named(one): one for one in frozen_courses(suite, track, maps)}[named(entered)]
    course = real_course(ours, hidden)
    title = f"{ours.world}, {ours.difficulty or 'map'}, seed {ours.seed}, flight {number + 1}"
    films = []
    for row in rows:
        flown = row.flights[chosen]
        told = f"{row.robot}: {flown.outcome} after {flown.time_s:.1f} s"
        with suppress(DatasetError):  # of a flight that ended before it began
            films.append((told, film(course, number, None, flown)))
        progress.count(1)
    return f"<h3>{html.escape(title)}</h3>{framed(films, 'gif')}"
