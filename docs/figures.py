"""Draw the reliability of a bench's report: needs the extra `train`.

scenegen bench data/pillar --reliability
python docs/figures.py bench/report.json [FOLDER]     # writes the pictures' *.png
"""

import io
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

Draw = Callable[[Any, str, Any, str], None]
"""Draws one method's part: axes, its name, its reliability and scores by class, its colour."""


def draw(report: Mapping[str, Any]) -> dict[str, bytes]:
    """Every picture by its file's name, PNG. Raises ImportError without matplotlib, and ValueError
    for a report without reliability."""
    if "reliability" not in report:
        raise ValueError("the report holds no reliability; run bench with --reliability")
    panels: dict[str, tuple[str, str, Draw]] = {
        "near-mae-by-visibility.png": ("", "Near-MAE, m", _visibility),
        "reliability.png": (
            "said (dotted), class weight inverted (solid), calibrated (dashed)",
            "occupied",
            _reliability,
        ),
    }
    return {name: _picture(report, *panel) for name, panel in panels.items()}


def _picture(report: Mapping[str, Any], x: str, y: str, draw_method: Draw) -> bytes:
    """Panels side by side, one a kind, with every method in each."""
    from matplotlib.figure import Figure

    kinds = report["reliability"]
    figure = Figure(figsize=(1.5 + 4.5 * len(kinds), 3.6), layout="constrained")
    for axes, (kind, methods) in zip(
        figure.subplots(1, len(kinds), squeeze=False)[0], kinds.items(), strict=True
    ):
        axes.set(title=kind, xlabel=x, ylabel=y)
        axes.grid(alpha=0.3)
        for n, (name, found) in enumerate(methods.items()):
            by_class = report["reconstruction"][kind][name]["by_class"]
            draw_method(axes, name, {"reliability": found, "by_class": by_class}, f"C{n}")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize="small")
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=110)
    return memory.getvalue()


def _visibility(axes: Any, name: str, study: Any, colour: str) -> None:
    values = {seen: row["near_mae"]["mean"] for seen, row in study["by_class"].items()}
    held = {seen: value for seen, value in values.items() if value is not None}
    axes.plot(list(held), list(held.values()), "o", color=colour, label=name)


def _reliability(axes: Any, name: str, study: Any, colour: str) -> None:
    """The probability as said, thin, with the class weight inverted, and calibrated."""
    axes.axline((0, 0), slope=1, color="grey", linewidth=0.5)
    if study["reliability"] is None:
        return
    styles: dict[str, dict[str, Any]] = {
        "said": {"alpha": 0.4, "linestyle": ":"},
        "corrected": {"label": name},
        "calibrated": {"linestyle": "--"},
    }
    for reading, style in styles.items():
        if reading not in study["reliability"]["map"]:
            continue
        bins = study["reliability"]["map"][reading]["bins"]
        axes.plot(
            [one["said"] for one in bins],
            [one["occupied"] for one in bins],
            color=colour,
            marker=".",
            **style,
        )


if __name__ == "__main__":
    source = Path(sys.argv[1])
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else source.parent
    for name, picture in draw(json.loads(source.read_text())).items():
        (folder / name).write_bytes(picture)
        print(folder / name)
