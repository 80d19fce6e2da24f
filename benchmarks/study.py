"""Draw the pictures of the study's findings from its figures.

python benchmarks/study.py docs/results/study.json --out docs/pictures/study
"""

import json
from pathlib import Path
from typing import Any

import measuring
from matplotlib.figure import Figure
from tyro.conf import Positional

from scenegen.model.bench.metrics import METRICS, PLAN_METRICS

COLOURS = {
    "confirmed": "tab:blue",
    "refuted": "tab:red",
    "contradicted": "tab:orange",
    "undecided": "tab:gray",
}
CURVES = {"val_loss": "validation loss", "val_iou": "IoU", "val_near_rmse": "Near-RMSE, m"}


class Options(measuring.Options):
    """The study."""

    study: Positional[Path]
    out: Path = Path()


def learning(study: dict[str, Any]) -> Figure:
    """Loss, IoU and Near-RMSE on validation by maps seen; runs with the whole budget."""
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    shown = {name: run for name, run in study["runs"].items() if name[-3:-1] == "-s"}
    kinds = list(dict.fromkeys(name[:-3] for name in shown))
    for axes, (column, title) in zip(figure.subplots(1, len(CURVES)), CURVES.items(), strict=True):
        for name, run in shown.items():
            rows = [row for row in run["curve"] if column in row]
            axes.plot(
                [row["maps"] for row in rows],
                [row[column] for row in rows],
                "-" if run["seed"] == 0 else ":",
                marker=".",
                color=f"C{kinds.index(name[:-3])}",
                label=name,
            )
        axes.set(xlabel="maps seen", title=title)
        if column == "val_loss":
            axes.set_yscale("log")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize="small")
    return figure


def claims(study: dict[str, Any]) -> Figure:
    """Every claim's difference with its interval over worlds and seeds: a line a claim, from the
    top, a point with its interval."""
    kinds = {
        kind: [claim for claim in study["claims"] if claim["pairs"] and claim["kind"] == kind]
        for kind in study["worlds"]
    }
    most = max(map(len, kinds.values()), default=1)
    figure = Figure(figsize=(12, 1.2 + 0.3 * most), layout="constrained")
    panels = figure.subplots(1, len(kinds), squeeze=False)[0]
    for axes, (kind, tried) in zip(panels, kinds.items(), strict=True):
        for n, one in enumerate(tried):
            if (mean := one["difference"]) is None:
                continue
            reach = [[0.0], [0.0]]
            if one["low"] is not None:
                reach = [[mean - one["low"]], [one["high"] - mean]]
            colour = COLOURS[one["verdict"]]
            axes.errorbar(mean, n, xerr=reach, fmt="o", color=colour, markersize=4)
        names = [
            f"{(METRICS | PLAN_METRICS)[one['metric']].label}: {one['best']} beats {one['other']}"
            for one in tried
        ]
        axes.axvline(0, color="grey", linewidth=0.8)
        axes.set_yticks(range(len(names)), names, fontsize="small")
        axes.invert_yaxis()
        axes.grid(alpha=0.3)
        axes.set_title(f"{kind}: difference", fontsize="medium")
    figure.suptitle(", ".join(f"{colour[4:]}: {name}" for name, colour in COLOURS.items()))
    return figure


def main() -> None:
    """Draw a study."""
    given = measuring.parse(Options)
    given.out.mkdir(parents=True, exist_ok=True)
    study = json.loads(given.study.read_text())
    for name, drawn in {"learning.png": learning(study), "claims.png": claims(study)}.items():
        drawn.savefig(given.out / name, dpi=100)
        print(given.out / name)


if __name__ == "__main__":
    main()
