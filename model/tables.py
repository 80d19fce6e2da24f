"""Tables of figures as Markdown and in HTML pages.

The pages fetch nothing and run no script but ours. Texts and names are escaped, since datasets and
networks of strangers have names, too.
"""

import html
import math
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

STYLE = Path(__file__).with_name("tables.css").read_text(encoding="utf-8")
MAX_OPEN = 24
"""Longer tables are closed at first: a click opens them."""
NAME_LETTERS = 18
"""Of a method's name in a chart."""


class Table(NamedTuple):
    """A table of figures."""

    title: str
    heads: Sequence[str]
    """Heads of the columns; the column of names has none."""
    rows: Sequence[tuple[str, Sequence[str]]]
    """Name and cells of each row. A cell is a figure and, after a space, its spread."""
    paper: Sequence[tuple[str, Sequence[str]]] = ()
    """Further rows with the paper's figures."""
    best: Collection[tuple[str, int]] = ()
    """Best cells, each by the name of its row and the number of its column."""
    note: str = ""
    """What the figures rest on, such as thresholds."""

    def markdown(self) -> str:
        """Format as Markdown: a heading and a table, with the paper's figures in italics."""
        paper = [
            (f"*{name}*", [text if text == "–" else f"*{text}*" for text in cells])
            for name, cells in self.paper
        ]
        note = f"{self.note}\n\n" if self.note else ""
        return f"### {self.title}\n\n{note}{markdown(self.heads, [*self.rows, *paper])}"

    def html(self) -> str:
        """Format as HTML: as `markdown`, with spreads below figures, and the best ones bold."""
        lines = ""
        for number, (name, texts) in enumerate((*self.rows, *self.paper)):
            is_paper = number >= len(self.rows)
            cells = ""
            for column, text in enumerate(texts):
                mean, _, spread = text.partition(" ")
                mark = " class='best'" * (not is_paper and (name, column) in self.best)
                # a line each for the deviation, the interval and the threshold: narrow columns
                lined = as_text(spread).replace(" [", "<br>[").replace("] at", "]<br>at")
                cells += f"<td{mark}>{as_text(mean)}<small>{lined}</small></td>"
            mark = " class='paper'" * is_paper
            lines += f"<tr{mark}><th>{as_text(name)}</th>{cells}</tr>"
        heads = "".join(f"<th>{as_text(head)}</th>" for head in self.heads)
        is_open = " open" * (len(self.rows) <= MAX_OPEN)
        return (
            f"<details{is_open}><summary>{as_text(self.title)}</summary><div class='wide'><table>"
            f"<caption><span>{as_text(self.note)}</span></caption><thead><tr><th></th>{heads}"
            f"</tr></thead><tbody>{lines}</tbody></table></div></details>"
        )


class Dot(NamedTuple):
    """A method's mark in a chart."""

    name: str
    mean: float
    low: float | None = None
    """Ends of the interval; None: there is none."""
    high: float | None = None
    style: str = ""
    """"reference", "paper", or "" for a method."""


def chart(title: str, dots: Sequence[Dot]) -> str:
    """Draw means and their intervals as SVG, a line each, in the colours of `STYLE`.

    Args:
        title: Title of the chart.
        dots: The methods, from top to bottom.
    """
    every = [value for dot in dots for value in (dot.mean, dot.low, dot.high) if value is not None]
    least, greatest = min(0.0, *every), max(0.1, *every)
    step = 10.0 ** math.floor(math.log10(greatest))
    # the scale ends at a round number
    end = math.ceil(round(greatest / step, 6)) * step

    def x(value: float) -> float:
        return round(140 + 200 * (value - least) / (end - least), 1)

    tall = 22 * len(dots)
    marks = "".join(
        f"<line class='rule' x1='{x(at)}' x2='{x(at)}' y2='{tall}'/>"
        f"<text class='scale' x='{x(at)}' y='{tall + 15}' text-anchor='middle'>{at:g}</text>"
        for at in (0, end / 2, end)
    )
    for number, (name, mean, low, high, style) in enumerate(dots):
        y, label = 22 * number + 11, f"{mean:.3f}"
        short = name if len(name) <= NAME_LETTERS else f"{name[: NAME_LETTERS - 1]}…"
        left, right = (x(mean if at is None else at) for at in (low, high))
        marks += (
            f"<g class='{style}'><title>{as_text(name)}: {label}</title>"
            f"<text x='0' y='{y + 4}'>{as_text(short)}</text>"
            f"<line x1='{left}' x2='{right}' y1='{y}' y2='{y}'/>"
            f"<circle cx='{x(mean)}' cy='{y}' r='5'/>"
            f"<text x='400' y='{y + 4}' text-anchor='end'>{label}</text></g>"
        )
    return (
        f"<figure><figcaption>{as_text(title)}</figcaption><svg role='img' viewBox='0 0 400 "
        f"{tall + 20}' aria-label='{as_text(title)}'>{marks}</svg></figure>"
    )


def markdown(heads: Collection[str], rows: Iterable[tuple[str, Iterable[str]]]) -> str:
    """Format a Markdown table.

    Args:
        heads: Heads of the columns; the column of names has none.
        rows: Name and cells of each row.

    Returns:
        Lines joined by newlines, without one at the end.
    """
    lines = [f"| | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    return "\n".join([*lines, *(f"| {name} | {' | '.join(cells)} |" for name, cells in rows)])


def page(title: str, body: str, *, style: str = "", script: str = "") -> str:
    """Format an HTML page.

    Args:
        title: Title, already escaped.
        body: HTML of the body.
        style: CSS that is added to `STYLE`.
        script: JavaScript of ours, if any.

    Returns:
        The page.
    """
    # the policy holds even if a text escaped its quotes: no requests but for a page beside it, and
    # no script where we have none ourselves
    allowed = "script-src 'unsafe-inline'; " if script else ""
    script = f"<script>{script}</script>" if script else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; style-src 'unsafe-inline'; frame-src 'self'; {allowed}img-src data:">
<title>{title}</title><style>{STYLE}{style}</style></head>\
<body><h1>{title}</h1>{body}{script}</body></html>
"""


def framed(title: str, name: str) -> str:
    """Show another page in a frame, with a link to it.

    Args:
        title: Title above it.
        name: The file, as seen from the page.

    Returns:
        HTML.
    """
    title, address = as_text(title), quote(name)
    return (
        f"<h2><a href='{address}'>{title}</a></h2>"
        f"<iframe title='{title}' loading='lazy' src='{address}'></iframe>"
    )


def as_text(value: object) -> str:
    """Escape a value for HTML."""
    return html.escape(str(value))
