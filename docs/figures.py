"""Draw the study of a bench's report: needs the extra `train`.

scenegen bench data/pillar --study
python docs/figures.py bench/report.json [FOLDER]     # writes the pictures' *.png
"""

import io
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

SHARES = {"success": "-", "collided": ":", "abstained": "--"}
"""What becomes of the careful planner's trials, and how lines tell it."""
Draw = Callable[[Any, str, Any, str], None]
"""Draws one method's part: axes, its name, its study and row of reconstruction, its colour."""


def draw(report: Mapping[str, Any]) -> dict[str, bytes]:
    """Every picture by its file's name, PNG. Raises ImportError without matplotlib, and ValueError
    for a report without a study."""
    if "study" not in report:
        raise ValueError("the report holds no study; run bench with --study")
    panels: dict[str, tuple[str, str, Draw]] = {
        "near-mae-by-visibility.png": ("", "Near-MAE, m", _visibility),
        "reliability.png": (
            "said (dotted), class weight inverted (solid), calibrated (dashed)",
            "occupied",
            _reliability,
        ),
        "risk.png": ("collided (solid: by risk; dotted: by a fixed threshold)", "success", _risk),
        "success-by-risk.png": (
            "risk of the bounds",
            "success; collided (dotted); abstained (dashed)",
            _by_risk(SHARES),
        ),
        "length-by-risk.png": ("risk of the bounds", "length, m", _by_risk({"length": "-"})),
    }
    return {name: _picture(report, *panel) for name, panel in panels.items()}


def _picture(report: Mapping[str, Any], x: str, y: str, draw_method: Draw) -> bytes:
    """Panels side by side, one a kind, with every method in each."""
    from matplotlib.figure import Figure

    kinds = report["study"]
    figure = Figure(figsize=(1.5 + 4.5 * len(kinds), 3.6), layout="constrained")
    for axes, (kind, methods) in zip(
        figure.subplots(1, len(kinds), squeeze=False)[0], kinds.items(), strict=True
    ):
        axes.set(title=kind, xlabel=x, ylabel=y)
        axes.grid(alpha=0.3)
        for n, (name, study) in enumerate(methods.items()):
            draw_method(
                axes,
                name,
                study | {"by_class": report["reconstruction"][kind][name]["by_class"]},
                f"C{n}",
            )
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize="small")
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=110)
    return memory.getvalue()


def _line(axes: Any, points: Iterable[tuple[float, Mapping[str, Any]]], **style: Any) -> None:
    """Means with their intervals; points without a value are left out."""
    shown = sorted((x, figure) for x, figure in points if figure["mean"] is not None)
    axes.plot([x for x, _ in shown], [figure["mean"] for _, figure in shown], marker=".", **style)
    if all(figure["low"] is not None for _, figure in shown):
        low, high = ([figure[end] for _, figure in shown] for end in ("low", "high"))
        axes.fill_between(
            [x for x, _ in shown], low, high, alpha=0.08, color=style.get("color"), linewidth=0
        )


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


def _by_risk(shown: Mapping[str, str]) -> Draw:
    """Figures of the careful planner, each in its style, over the risk of the bounds that it plans
    on."""

    def draw_method(axes: Any, name: str, study: Any, colour: str) -> None:
        rows = [row for row in study["risk"]["settings"] if row["by"] == "risk"]
        for n, (told, dashes) in enumerate(shown.items()):
            label = None if n else name
            _line(
                axes,
                [(row["value"], row[told]) for row in rows],
                color=colour,
                linestyle=dashes,
                label=label,
            )
        if rows:
            axes.set_xscale("log")

    return draw_method


def _risk(axes: Any, name: str, study: Any, colour: str) -> None:
    """What the careful planner gains for what it risks, over the risk of its bounds and over fixed
    thresholds."""
    styles: dict[bool, dict[str, Any]] = {
        True: {"linestyle": "-", "label": name},
        False: {"linestyle": ":"},
    }
    for by_risk, style in styles.items():
        rows = [
            row
            for row in study["risk"]["settings"]
            if (row["by"] == "risk") == by_risk and row["success"]["n"]
        ]
        points = sorted((row["collided"]["mean"], row["success"]["mean"]) for row in rows)
        axes.plot(
            *zip(*points, strict=True) if points else ((), ()), color=colour, marker=".", **style
        )


if __name__ == "__main__":
    source = Path(sys.argv[1])
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else source.parent
    for name, picture in draw(json.loads(source.read_text())).items():
        (folder / name).write_bytes(picture)
        print(folder / name)
