"""A picture of milliseconds, for the benchmarks that are asked for one."""

from collections.abc import Mapping
from pathlib import Path


def draw(path: Path, rows: Mapping[str, Mapping[str, float]], title: str, *, stacked: bool) -> None:
    """Write to `path` a bar for every row: its parts, milliseconds, end to end where `stacked`,
    else side by side."""
    from matplotlib.figure import Figure

    parts = list(dict.fromkeys(part for row in rows.values() for part in row))
    count = len(rows) if stacked else len(rows) * len(parts)
    figure = Figure(figsize=(9, 1.2 + 0.35 * count), layout="constrained")
    axes = figure.subplots()
    thick, left = 0.8 if stacked else 0.8 / len(parts), [0.0] * len(rows)
    for n, part in enumerate(parts):
        values = [row.get(part, 0.0) for row in rows.values()]
        at = [m if stacked else m + (n - (len(parts) - 1) / 2) * thick for m in range(len(rows))]
        axes.barh(
            at,
            values,
            thick,
            left=left if stacked else None,
            label=part,
            color=f"C{n % 10}",
            hatch="/" * (n // 10),
        )
        left = [a + b for a, b in zip(left, values, strict=True)]
    axes.set_yticks(range(len(rows)), list(rows))
    axes.invert_yaxis()
    axes.set(xlabel="ms", title=title)
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=100)
