"""The report as one HTML page, for people: both tables beside the paper's, charts with intervals
and failures as pictures.

It has no script and fetches nothing; texts and names are shown as text alone.
"""

import base64
import html
from collections.abc import Mapping, Sequence

from scenegen.files import Json
from scenegen.model.evaluation.report import Table, shown

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
HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
"""


def to_html(report: Json, pictures: Mapping[str, Sequence[tuple[str, bytes]]] | None = None) -> str:
    """The page of what `build_report` gives; `pictures` are charts and failures by kind: what each
    shows, and a WebP image."""
    about = "".join(
        f"<dt>{_text(name)}</dt><dd>{_text(value)}</dd>"
        for name, value in report.items()
        if isinstance(value, str)
    )
    body = [f"<h1>Bench</h1><dl>{about}</dl>"]
    for kind in report["datasets"]:
        body.append(f"<h2>{_text(kind)}</h2>")
        body += [_block(block) for block in shown(report, kind)]
        images = [
            f"<figure><figcaption>{_text(told)}</figcaption><img alt='{_text(told)}' "
            f"src='data:image/webp;base64,{base64.b64encode(image).decode()}'></figure>"
            for told, image in (pictures or {}).get(kind, ())
        ]
        body.append(f"<div class='charts'>{''.join(images)}</div>")
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


def _text(value: object) -> str:
    return html.escape(str(value))
