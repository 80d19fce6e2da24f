"""The report as one HTML page, for people: both tables beside the paper's, charts with intervals,
failures as pictures.

It has no script and fetches nothing; texts and names are shown as text alone.
"""

import base64
import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

from scenegen.model.evaluation.metrics import Metric
from scenegen.model.evaluation.report import tables
from scenegen.model.evaluation.shown import CAUSES
from scenegen.model.evaluation.statistics import caution, interval, spread, threshold

REFERENCES = ("truth", "seen")
"""Rows that nobody can beat, so that they are never the best."""
CHARTS = {"reconstruction": ("iou", "near_rmse"), "planning": ("success", "min_clearance")}
"""Metrics that are drawn, by table."""
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1b1f24; background: #fff;
  margin: 0 auto; padding: 1rem; max-width: 70rem; }
h1, h2, h3 { line-height: 1.2; }
h2 { margin-top: 2.2rem; border-top: 1px solid #d5dae1; padding-top: 1rem; }
dl { display: grid; grid-template-columns: auto 1fr; gap: 0 1rem; }
dd { margin: 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; margin: .6rem 0; }
table { border-collapse: collapse; }
th, td { padding: .25rem .6rem; text-align: right; white-space: nowrap; }
th:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
thead th { border-bottom: 1px solid #59636e; }
tbody tr:nth-child(odd), tbody tr:nth-child(odd) th:first-child { background: #f5f7f9; }
small { color: #59636e; display: block; font-weight: 400; }
.paper { font-style: italic; }
.best { font-weight: 700; }
.charts { display: flex; flex-wrap: wrap; gap: 1rem; }
figure { margin: 0; flex: 1 1 20rem; max-width: 34rem; }
figcaption { font-weight: 600; }
svg, img { width: 100%; height: auto; }
"""
HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
"""


def to_html(
    report: Mapping[str, Any], pictures: Mapping[str, Sequence[tuple[str, bytes]]] | None = None
) -> str:
    """The page of what `build_report` gives; `pictures` are failures by kind: what each shows, and
    a WebP image."""
    about = "".join(
        f"<dt>{_text(name)}</dt><dd>{_text(value)}</dd>"
        for name, value in report.items()
        if isinstance(value, str)
    )
    body = [f"<h1>Bench</h1><dl>{about}</dl>"]
    for kind, held in report["datasets"].items():
        excluded = (
            ", ".join(f"{cause} {count}" for cause, count in held["excluded"].items()) or "none"
        )
        body.append(
            f"<h2>{_text(kind)}</h2><p>{held['samples']} samples of {held['worlds']} worlds, "
            f"dataset "
            f"{_text(str(held['digest'])[:12])}…; {held['trials']} planning trials, excluded "
            f"draws: {_text(excluded)}. "
            "Means; below them ± standard deviation over samples or trials, and the 95 % interval "
            "of the mean, by "
            "a jackknife over worlds. Bold: the best of what was measured. <i>Italics: the "
            "paper's.</i></p>"
        )
        body.append(f"<p>{few}.</p>" if (few := caution(held["worlds"])) else "")
        for name, metrics, rows, reference in tables(report, kind):
            body.append(f"<h3>{name.capitalize()}</h3>{_table(rows, metrics, reference)}")
            charts = (_chart(rows, metrics[one], one, reference) for one in CHARTS[name])
            body.append(f"<div class='charts'>{''.join(charts)}</div>")
        body.append(_failures(report["planning"][kind]))
        shown = (pictures or {}).get(kind, ())
        images = (
            f"<figure><figcaption>{_text(told)}</figcaption><img alt='{_text(told)}' "
            f"src='data:image/webp;base64,{base64.b64encode(image).decode()}'></figure>"
            for told, image in shown
        )
        body.append(f"<div class='charts'>{''.join(images)}</div>" if shown else "")
    head = f"{HEAD}<title>Bench</title><style>{STYLE}</style></head>"
    return f"{head}<body>{''.join(body)}</body></html>\n"


def best(rows: Mapping[str, Any], name: str, metric: Metric) -> set[str]:
    """The methods with the best mean of a metric, as it is printed; none of the references."""
    means = {
        method: row[name]["mean"]
        for method, row in rows.items()
        if row[name]["n"] and method not in REFERENCES
    }
    worth = {
        "higher": lambda mean: -round(mean, 3),
        "lower": lambda mean: round(mean, 3),
        "nearer to 0": lambda mean: abs(round(mean, 3)),
    }[metric.better]
    first = min(map(worth, means.values()), default=None)
    return {method for method, mean in means.items() if worth(mean) == first}


def _table(
    rows: Mapping[str, Any], metrics: Mapping[str, Metric], reference: Mapping[str, Any]
) -> str:
    arrows = {"higher": " ↑", "lower": " ↓", "nearer to 0": ""}
    heads = "".join(
        f"<th>{_text(metric.label)}{arrows[metric.better]}</th>" for metric in metrics.values()
    )
    bests = {name: best(rows, name, metric) for name, metric in metrics.items()}
    lines = []
    for method, row in rows.items():
        cells = (_cell(row[name], method in bests[name]) for name in metrics)
        lines.append(f"<tr><th>{_text(method)}</th>{''.join(cells)}</tr>")
    for method, row in reference.items():
        cells = (
            f"<td>{spread(*row[name]) if metric.paper else '–'}</td>"
            for name, metric in metrics.items()
        )
        lines.append(f"<tr class='paper'><th>{_text(method)}</th>{''.join(cells)}</tr>")
    return _framed(heads, "".join(lines))


def _framed(heads: str, lines: str) -> str:
    head = f"<thead><tr><th></th>{heads}</tr></thead>"
    return f"<div class='wide'><table>{head}<tbody>{lines}</tbody></table></div>"


def _cell(figure: Mapping[str, Any], is_best: bool) -> str:
    if not figure["n"]:
        return "<td>–</td>"
    more = "" if figure["std"] is None else f"± {figure['std']:.3f}<br>"
    mark = " class='best'" if is_best else ""
    more += f"{interval(figure, '.3f')}{threshold(figure)}"
    return f"<td{mark}>{figure['mean']:.3f}<small>{more}</small></td>"


def _chart(rows: Mapping[str, Any], metric: Metric, name: str, reference: Mapping[str, Any]) -> str:
    """A dot for each method with its interval, and a ring for each of the paper's."""
    dots = [
        (method, row[name]["mean"], row[name]["low"], row[name]["high"], False)
        for method, row in rows.items()
    ]
    dots += [
        (f"{method} (paper)", row[name][0], None, None, True) for method, row in reference.items()
    ]
    dots = [dot for dot in dots if dot[1] is not None]
    if not dots:
        return ""
    held = [value for _, *values, _ in dots for value in values if value is not None]
    low, high = min(*held, 0.0), max(*held, 1e-9)
    left, wide, step = 170.0, 380.0, 26.0
    at = lambda value: left + wide * (value - low) / (high - low)  # noqa: E731
    tall = step * len(dots) + 30
    parts = [
        f"<line x1='{at(value):.1f}' x2='{at(value):.1f}' y1='4' y2='{tall - 24}' "
        f"stroke='#d5dae1'/>"
        f"<text x='{at(value):.1f}' y='{tall - 8}' text-anchor='middle' "
        f"font-size='12'>{value:.2f}</text>"
        for value in _ticks(low, high)
    ]
    for n, (method, mean, least, most, hollow) in enumerate(dots):
        y = step * n + 16
        parts.append(
            f"<text x='{left - 10}' y='{y + 4}' text-anchor='end' "
            f"font-size='13'>{_text(method[:24])}</text>"
        )
        if least is not None:
            parts.append(
                f"<line x1='{at(least):.1f}' x2='{at(most):.1f}' y1='{y}' y2='{y}' "
                f"stroke='#1560bd' stroke-width='3'/>"
            )
        look = "fill='#fff' stroke='#59636e' stroke-width='2'" if hollow else "fill='#1560bd'"
        parts.append(f"<circle cx='{at(mean):.1f}' cy='{y}' r='5' {look}/>")
    return (
        f"<figure><figcaption>{_text(metric.label)}</figcaption><svg viewBox='0 0 580 {tall:.0f}' "
        f"role='img' "
        f"aria-label='{_text(metric.label)}'>{''.join(parts)}</svg></figure>"
    )


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from `low` to `high`, about five."""
    decade = 10 ** math.floor(math.log10((high - low) / 4))
    step = next(decade * many for many in (1, 2, 5, 10) if decade * many >= (high - low) / 5)
    return [
        step * n for n in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ]


def _failures(rows: Mapping[str, Any]) -> str:
    causes = [cause for cause in CAUSES if any(cause in row["failures"] for row in rows.values())]
    if not causes:
        return ""
    heads = "".join(f"<th>{_text(CAUSES[cause])}</th>" for cause in causes)
    lines = ""
    for method, row in rows.items():
        counts = "".join(f"<td>{row['failures'].get(cause, 0)}</td>" for cause in causes)
        lines += f"<tr><th>{_text(method)}</th>{counts}</tr>"
    return f"<h3>Trials that failed, by what became of the path</h3>{_framed(heads, lines)}"


def _text(value: object) -> str:
    return html.escape(str(value))
