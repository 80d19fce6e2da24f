"""Tables of figures as Markdown and in HTML pages.

The pages fetch nothing and run no script but ours. Texts and names are escaped, since datasets and
networks of strangers have names, too.
"""

import html
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

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
img { width: 100%; height: auto; }
"""


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

    def markdown(self) -> str:
        """Format as Markdown: a heading and a table, with the paper's figures in italics."""
        paper = [
            (f"*{name}*", [text if text == "–" else f"*{text}*" for text in cells])
            for name, cells in self.paper
        ]
        return f"### {self.title}\n\n{markdown(self.heads, [*self.rows, *paper])}"

    def html(self) -> str:
        """Format as HTML: as `markdown`, with spreads below figures, and the best ones bold."""
        lines = ""
        for number, (name, texts) in enumerate((*self.rows, *self.paper)):
            is_paper = number >= len(self.rows)
            cells = ""
            for column, text in enumerate(texts):
                mean, _, spread = text.partition(" ")
                mark = " class='best'" * (not is_paper and (name, column) in self.best)
                cells += f"<td{mark}>{as_text(mean)}<small>{as_text(spread)}</small></td>"
            mark = " class='paper'" * is_paper
            lines += f"<tr{mark}><th>{as_text(name)}</th>{cells}</tr>"
        heads = "".join(f"<th>{as_text(head)}</th>" for head in self.heads)
        return (
            f"<h3>{as_text(self.title)}</h3><div class='wide'><table><thead><tr><th></th>{heads}"
            f"</tr></thead><tbody>{lines}</tbody></table></div>"
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
    # the policy holds even if a text escaped its quotes: no requests, and no script where we have
    # none ourselves
    allowed = "script-src 'unsafe-inline'; " if script else ""
    script = f"<script>{script}</script>" if script else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; style-src 'unsafe-inline'; {allowed}img-src data:">
<title>{title}</title><style>{STYLE}{style}</style></head>\
<body><h1>{title}</h1>{body}{script}</body></html>
"""


def as_text(value: object) -> str:
    """Escape a value for HTML."""
    return html.escape(str(value))
