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
from scenegen.model.evaluation.report import Table, shown, tables

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
    for kind in report["datasets"]:
        body.append(f"<h2>{_text(kind)}</h2>")
        body += [_block(block) for block in shown(report, kind)]
        charts = [
            _chart(rows, metrics[one], one, reference)
            for name, metrics, rows, reference in tables(report, kind)
            for one in CHARTS[name]
        ]
        images = [
            f"<figure><figcaption>{_text(told)}</figcaption><img alt='{_text(told)}' "
            f"src='data:image/webp;base64,{base64.b64encode(image).decode()}'></figure>"
            for told, image in (pictures or {}).get(kind, ())
        ]
        body.append(f"<div class='charts'>{''.join(charts + images)}</div>")
    head = f"{HEAD}<title>Bench</title><style>{STYLE}</style></head>"
    return f"{head}<body>{''.join(body)}</body></html>\n"


def _block(block: str | Table) -> str:
    """A sentence or a table; the spread of a figure stands below it."""
    if isinstance(block, str):
        return f"<p>{_text(block)}</p>"
    lines = ""
    for row, (name, cells) in enumerate((*block.rows, *block.paper)):
        mark, told = " class='paper'" * (row >= len(block.rows)), ""
        for n, one in enumerate(cells):
            figure, _, more = one.partition(" ")
            best = " class='best'" if not mark and (name, n) in block.best else ""
            told += f"<td{best}>{_text(figure)}<small>{_text(more)}</small></td>"
        lines += f"<tr{mark}><th>{_text(name)}</th>{told}</tr>"
    heads = "".join(f"<th>{_text(one)}</th>" for one in block.heads)
    return (
        f"<h3>{_text(block.title)}</h3><div class='wide'><table><thead><tr><th></th>{heads}</tr>"
        f"</thead><tbody>{lines}</tbody></table></div>"
    )


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


def _text(value: object) -> str:
    return html.escape(str(value))
