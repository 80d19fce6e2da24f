"""The leaderboard: a page of the entries to a suite."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from scenegen.base.errors import DatasetError, ScenegenError, reraise_as
from scenegen.fly.course import Course, Recording, read_recording
from scenegen.fly.loop import Flown, marks
from scenegen.fly.suite import SuiteCoverage, coverage_of, entry_course, latency_of
from scenegen.model.bench.statistics import Scale, brief, summarise
from scenegen.model.tables import Table, framed, page


class Column(NamedTuple):
    """Column of the leaderboard."""

    of: Callable[[Flown], float]
    maximum: float = 1.0
    """No value is greater, and none is less than 0: intervals end there."""
    scale: Scale = "amount"


ENDS = ("success", "collision", "timeout")
"""Ends of flights of sound robots; others crash, hang or leave the bounds."""
BOARD = {
    "success": Column(lambda row: row.outcome == "success", scale="outcome"),
    "success, blocked line": Column(
        lambda row: row.outcome == "success" if row.blocked else math.nan, scale="outcome"
    ),
    "progress": Column(lambda row: row.progress, scale="share"),
    "collision": Column(lambda row: row.outcome == "collision", scale="outcome"),
    "time-out": Column(lambda row: row.outcome == "timeout", scale="outcome"),
    "other end": Column(lambda row: row.outcome not in ENDS, scale="outcome"),
    "score": Column(lambda row: row.score, 0.5),
    "SPL": Column(lambda row: row.spl),
    "least clearance, m": Column(lambda row: row.min_clearance_m),
    "mean clearance, m": Column(lambda row: row.mean_clearance_m),
    "decision, ms": Column(lambda row: 1e3 * row.step_s, float("inf")),
}
BEST = "score, less the best's"
"""The last column: the differences flight by flight."""
WIDE = " body { max-width: none; } th { cursor: pointer; }"
SORTED = Path(__file__).with_name("board.js").read_text(encoding="utf-8")


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
        return [flight.score for flight in self.flights]


def leaderboard(folder: Path, out: Path) -> str:
    """Write an HTML page of all entries (.json) in a folder.

    It has a table for each choice of courses, those of whole tracks first, the best score first,
    with 95 % intervals over worlds. A click on a column's head sorts by it. Scores are those of the
    recorded outcomes, times and lengths, which `fly replay` checks. Below the tables are the films
    that lie beside entries: x.html beside x.json.

    Args:
        folder: The folder.
        out: File of the page, from which films are referred to.

    Returns:
        The page.

    Raises:
        DatasetError: A file is no entry, or has courses that are not its suite's.
    """
    # only entries that flew the same worlds can be compared, so each choice of courses has a table
    tables: dict[tuple[str, ...], tuple[SuiteCoverage, list[Row]]] = {}
    films = ""
    for path in sorted(folder.glob("*.json")):
        entry = read_recording(path)
        with reraise_as(DatasetError, f"{path}: ", of=DatasetError):
            part = coverage_of(entry)
        row = _row(entry)
        key = (str(entry.suite), str(part), *row.worlds)
        tables.setdefault(key, (part, []))[1].append(row)
        if (film := path.with_suffix(".html")).exists():
            films += framed(f"{entry.robot} flies", os.path.relpath(film, out.parent))
    if not tables:
        raise ScenegenError(f"{folder}: holds no entry, .json as `scenegen fly suite -o` writes it")
    whole_first = sorted(tables.items(), key=lambda table: table[1][0].there < table[1][0].of)
    body = ""
    for (suite, title, *_), (_, rows) in whole_first:
        # all rows of a table have the same flights, so sums order as means do
        rows.sort(key=lambda row: -sum(row.scores))
        cells = [(row.robot, _cells(row, rows[0])) for row in rows]
        body += Table(f"{suite}, {title}", ("flights", *BOARD, BEST), cells).html()
    return page("Robots", body + films, style=WIDE, script=SORTED)


def _row(entry: Recording) -> Row:
    """An entry's flights, with the scores that their outcomes, times and lengths give."""
    courses, scored = [], []
    for course, flights in sorted(entry.courses, key=lambda flight: str(entry_course(flight[0]))):
        for number, flight in enumerate(flights):
            best_s = flight.shortest_m / course.vehicle.speed_mps
            # from the outcome, the time and the lengths, which `fly replay` checks
            success = flight.outcome == "success"
            figures = marks(success, flight.time_s, flight.flown_m, flight.shortest_m, best_s)
            scored.append(replace(flight, score=figures["score"], spl=figures["spl"]))
            courses.append((course, number))
    latency_s = latency_of(entry)
    robot = f"{entry.robot}, latency {latency_s:g} s" if latency_s else entry.robot
    return Row(robot, courses, scored)


def _cells(row: Row, best: Row) -> list[str]:
    """An entry's figures, and its scores less those of the best that flew the same courses."""
    cells = [str(len(row.flights))]
    for column in BOARD.values():
        summary = summarise([column.of(flight) for flight in row.flights], row.worlds, column.scale)
        # an interval by Student's t may pass the bounds of a share
        for name in ("low", "high"):
            if summary[name] is not None:
                summary[name] = min(max(summary[name], 0.0), column.maximum)
        cells.append(brief(summary))
    # differences on the same flights: how hard these are cancels
    pairs = zip(row.scores, best.scores, strict=True)
    less = summarise([flight - best_score for flight, best_score in pairs], row.worlds)
    return [*cells, "–" if row is best else brief(less, "+.3f")]
