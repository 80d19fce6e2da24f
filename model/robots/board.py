"""The leaderboard: a page of the entries to a suite."""

import html
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from scenegen.cli.show import Progress
from scenegen.errors import DatasetError, ScenegenError, raised_as
from scenegen.fly.course import Course, Recording
from scenegen.fly.loop import Flown, marks
from scenegen.fly.suite import Part, frozen_courses, named, part_of, track_name
from scenegen.model.evaluation.report import HEAD, STYLE, Table, block, framed
from scenegen.model.evaluation.statistics import Scale, brief, summarise
from scenegen.model.robots.film import film
from scenegen.model.robots.flights import real_course


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
        found = summarise([column.of(one) for one in row.flights], row.worlds, column.scale)
        for name in ("low", "high"):
            if found[name] is not None:
                found[name] = min(max(found[name], 0.0), column.most)
        cells.append(brief(found))
    pairs = zip(row.scores, best.scores, strict=True)
    less = summarise([one - other for one, other in pairs], row.worlds)
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
