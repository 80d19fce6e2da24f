"""Tables for notebooks."""

import html
from collections.abc import Iterable, Sequence


def html_table(rows: Iterable[Sequence[object]], title: object) -> str:
    """Make an HTML table for notebooks. All text is escaped.

    Args:
        rows: Cells of each row.
        title: Text above the table.
    """
    lines = ("".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<p>{html.escape(str(title))}</p><table>{body}</table>"
