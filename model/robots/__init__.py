"""Robots that fly: those that map, complete and plan, and one without a map."""

import html
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from scenegen.errors import ScenegenError

if TYPE_CHECKING:  # the command line asks for the names alone
    from pathlib import Path

    from scenegen.fly.course import Course
    from scenegen.fly.loop import Flown
    from scenegen.model.evaluation.statistics import Scale

MAPPING = {
    "returns": "what the last scan says, unknown voxels free",
    "optimistic": "what all scans say, unknown voxels free",
    "pessimistic": "what all scans say, unknown voxels occupied",
    "extrude": "all scans, returns extended up and down",
    "truth": "the truth, which nobody else gets",
}
"""Robots that map and plan, by what they take for occupied."""
REACTIVE = "reactive"
"""The one without a map."""
NAMES = (*MAPPING, REACTIVE)
RATIOS = ("score", "spl", "ratio", "speed_mps", "mean_clearance_m", "jerk_mps3", "step_s")
"""Figures of which the mean over flights is told."""
COUNTS = ("late", "invalid", "speeding")
"""Those of which the sum is."""


def robot_maker(name: str, weights: str | None) -> "Callable[[Course], Any]":
    """What makes the robot for a course: one of `NAMES`; one that maps and has the network called
    `weights` complete; or one's own, which runs in a process of its own."""
    from scenegen.fly.pipe import own_robot
    from scenegen.model.completion.unlearned import Conservative, Extrude, Returns
    from scenegen.model.robots.mapping import MappingRobot, TruthRobot
    from scenegen.model.robots.reactive import ReactiveRobot

    if weights is not None:
        from scenegen.model.completion.completer import opened_once

        network = opened_once(weights, "cpu", 1)
        if set(network.inputs) - {"observed", "free"}:
            raise ScenegenError(
                f"{weights}: takes {', '.join(network.inputs)}; robots give "
                "observed and free voxels alone"
            )
        return lambda course: MappingRobot(network, doubts=True)
    known: dict[str, Callable[[Course], Any]] = {
        "returns": lambda course: MappingRobot(Returns(), memory=False),
        "optimistic": lambda course: MappingRobot(Returns()),
        "pessimistic": lambda course: MappingRobot(Conservative(), frontier=True),
        "extrude": lambda course: MappingRobot(Extrude(), doubts=True),
        "truth": lambda course: TruthRobot(course.simulated),
        REACTIVE: lambda course: ReactiveRobot(),
    }
    return known.get(name) or (lambda course: own_robot(name))


def fly_course(
    course: "Course", *, robot: str, weights: str | None
) -> "tuple[Course, Sequence[Flown]]":
    """All flights of a course, one after the other, by the same robot."""
    from scenegen.fly.loop import fly as fly_mission

    made = robot_maker(robot, weights)(course)
    try:
        flown = [fly_mission(course.simulation(n), made) for n in range(course.flights)]
    finally:
        getattr(made, "close", lambda: None)()
    if all(one.outcome == "crashed" and not one.time_s for one in flown):
        raise ScenegenError(f"--robot {robot}: never begins: {flown[0].trouble}")
    return course, flown


def summary(name: str, flown: "Sequence[Flown]") -> dict[str, Any]:
    """What is told of flights, together."""
    import numpy as np

    ends = Counter(one.outcome for one in flown)
    row: dict[str, Any] = {"robot": name, "flights": len(flown)}
    row |= {end: f"{100 * count / len(flown):.0f} %" for end, count in ends.most_common()}
    row |= {
        part: round(float(np.mean([getattr(one, part) for one in flown])), 4) for part in RATIOS
    }
    row["min_clearance_m"] = round(min(one.min_clearance_m for one in flown), 4)
    row["most_step_s"] = round(max(one.most_step_s for one in flown), 4)
    return row | {part: sum(getattr(one, part) for one in flown) for part in COUNTS}


BOARD: dict[str, tuple["Scale", Callable[["Flown"], float]]] = {
    "success": ("outcome", lambda one: one.outcome == "success"),
    "collision": ("outcome", lambda one: one.outcome == "collision"),
    "score": ("amount", lambda one: one.score),
    "SPL": ("amount", lambda one: one.spl),
    "mean clearance, m": ("amount", lambda one: one.mean_clearance_m),
    "decision, ms": ("amount", lambda one: 1e3 * one.step_s),
}
"""Columns of the leaderboard: the scale of their intervals, and what they tell of a flight."""
SORTED = """
for (const head of document.querySelectorAll("th")) head.onclick = () => {
  const rows = [...head.closest("table").tBodies[0].rows], n = head.cellIndex;
  const value = (row) => row.cells[n].textContent;
  rows.sort((a, b) =>
    parseFloat(value(b)) - parseFloat(value(a)) || value(a).localeCompare(value(b)));
  rows.forEach((row) => row.parentElement.append(row));
};
"""


def leaderboard(folder: "Path") -> str:
    """An HTML page of all entries (.json) in a folder: a table for each choice of courses, the
    best score first, 95 % intervals over worlds; a click on a column's head sorts by it."""
    from scenegen.fly.course import Recording
    from scenegen.model.evaluation.page import HEAD, STYLE
    from scenegen.model.evaluation.statistics import brief, figure

    tables: dict[tuple[str, ...], list[tuple[float, str]]] = {}
    for path in sorted(folder.glob("*.json")):
        entry = Recording.read(path)
        rows = [(course.document, one) for course, flights in entry.courses for one in flights]
        worlds = [document for document, _ in rows]
        found = {
            title: figure([of(one) for _, one in rows], worlds, scale)
            for title, (scale, of) in BOARD.items()
        }
        cells = "".join(f"<td>{brief(one)}</td>" for one in found.values())
        row = f"<tr><th>{html.escape(entry.robot)}</th><td>{len(rows)}</td>{cells}</tr>"
        key = (entry.suite or "", *sorted(set(worlds)))
        tables.setdefault(key, []).append((-(found["score"]["mean"] or 0), row))
    if not tables:
        raise ScenegenError(f"{folder}: holds no entry, .json as `fly --suite -o` writes it")
    heads = "".join(f"<th>{title}</th>" for title in ("robot", "flights", *BOARD))
    body = "".join(
        f"<h2>{html.escape(key[0])}: {len(key) - 1} worlds</h2><div class='wide'><table>"
        f"<thead><tr>{heads}</tr></thead><tbody>{''.join(row for _, row in sorted(rows))}</tbody>"
        "</table></div>"
        for key, rows in tables.items()
    )
    page = HEAD.replace("img-src", "script-src 'unsafe-inline'; img-src")
    page += f"<title>Robots</title><style>{STYLE} th {{ cursor: pointer; }}</style></head>"
    return f"{page}<body><h1>Robots</h1>{body}<script>{SORTED}</script></body></html>\n"
