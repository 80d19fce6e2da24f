"""The study with all of its runs: what single choices are worth, and worlds made otherwise.

    python benchmarks/study.py --out study            # 45 networks: some 21 hours on two cores
    python benchmarks/study.py --draw docs/results/study.json --out docs/pictures/study

`scenegen reproduce` trains the networks that the paper's claims need. This adds those of
docs/study.md, "What single choices are worth", and draws its pictures.
"""

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import measuring
import numpy as np

from scenegen.cli.show import Progress
from scenegen.model.calibration import corrected
from scenegen.model.config import PROTOCOLS, LossConfig, Thresholds
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.study.runs import (
    BOTH,
    CLAIMED,
    COLUMNS,
    KINDS,
    RUNS,
    ReproduceConfig,
    Run,
    Worlds,
)
from scenegen.model.study.stages import Study

SHORT = 0.25
"""The part of the budget that a run has where it shows what one choice is worth."""
ELSEWHERE = {
    "ground": Worlds(
        asks="a ground below pillars, none below loose solids",
        tables={"geometric": {"world": {"ground": False}}, "pillar": {"world": {"ground": True}}},
    ),
    "sparse": Worlds(
        asks="half as many obstacles",
        tables={
            "geometric": {"world": {"density": [0.001, 0.2]}},
            "pillar": {"world": {"density": [0.025, 0.05]}},
        },
    ),
    "hollow": Worlds(
        asks="truth of surfaces alone, as of meshes",
        tables={kind: {"grid": {"hollow": True}} for kind in KINDS},
    ),
    "band": Worlds(
        asks="every ray 30° lower, in place of a tilted sensor",
        tables={kind: {"lidar": {"mount": "band"}} for kind in KINDS},
    ),
}
EVEN = float(
    corrected(np.array(Thresholds().probability, np.float32), LossConfig().occupied_weight)
)
"""The threshold of a network without a class weight that is the paper's of one with it."""


def _short() -> tuple[Run, ...]:
    occ, proposed, proposed_1, columns = (
        replace(run, name=f"{run.name}-short", share=SHORT) for run in (*CLAIMED[:3], COLUMNS)
    )
    proposed = replace(proposed, against=occ.name)

    def unlike(base: Run, name: str, asks: str, **changed: Any) -> Run:
        return replace(base, name=name, asks=asks, against=base.name, **changed)

    def variant(name: str, **more: Any) -> dict[str, Any]:
        return {"variant": name, **more}

    scaled, plain = {"beta_m": 2.0, "tudf": 0.5, "eikonal": 0.1}, {"occupied_weight": 1.0}
    flat = variant("flat", inputs=BOTH)
    pairs = []
    for name, worlds in ELSEWHERE.items():
        there = replace(occ, name=f"occ-{name}", asks=worlds.asks, worlds=name)
        pairs += [there, unlike(there, f"proposed-{name}", "the paper's network", network={})]
    return (
        *(occ, proposed, proposed_1, columns),
        unlike(proposed, "dual", "without CrossFusion", network=variant("dual")),
        unlike(proposed_1, "dual-1", "without CrossFusion at λ_occ 1", network=variant("dual")),
        unlike(proposed, "shared", "one decoder with two heads", network=variant("shared")),
        unlike(proposed_1, "shared-1", "the same at λ_occ 1", network=variant("shared")),
        unlike(columns, "columns-observed", "without free space", network=variant("columns")),
        unlike(columns, "flat", "without the 3-D net, as in LMSCNet", network=flat),
        unlike(proposed, "proposed-scaled", "distances in truncations", loss=scaled),
        unlike(proposed, "proposed-paper", "the paper's protocol", protocol=PROTOCOLS["paper"]),
        unlike(proposed, "proposed-plain", "no symmetries", protocol={"augment": False}),
        unlike(occ, "occ-wide", "as wide as `proposed`", network=variant("occ", width=11)),
        unlike(occ, "occ-weight-1", "no class weight", loss=plain, probability=EVEN),
        unlike(proposed, "proposed-stem-1", "a finer stem", network={"stem_stride": 1}),
        unlike(proposed_1, "proposed-1-of-10", "one of 10 samples", samples=0.1),
        *pairs,
    )


ALL = (*RUNS, *_short())
COLOURS = {"confirmed": "C0", "refuted": "C3", "contradicted": "C1", "undecided": "0.5"}
CURVES = {"val_loss": "validation loss", "val_iou": "IoU", "val_near_rmse": "Near-RMSE, m"}


def draw(study: Mapping[str, Any]) -> dict[str, bytes]:
    """The study's pictures by file name, PNG."""
    drawn = {"learning.png": learning, "claims.png": claims, "choices.png": choices}
    return {name: _png(make(study)) for name, make in drawn.items()}


def learning(study: Mapping[str, Any]) -> Any:
    """Loss, IoU and Near-RMSE on validation by maps seen; runs with the whole budget."""
    figure = _figure(12, 3.6)
    shown = {name: run for name, run in study["runs"].items() if name[-3:-1] == "-s"}
    kinds = list(dict.fromkeys(name[:-3] for name in shown))
    for axes, (column, title) in zip(figure.subplots(1, len(CURVES)), CURVES.items(), strict=True):
        for name, run in shown.items():
            points = [(row["maps"], row[column]) for row in run["curve"] if column in row]
            axes.plot(
                *zip(*points, strict=True),
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


def claims(study: Mapping[str, Any]) -> Any:
    """Every claim's difference with its interval over worlds and seeds."""
    tried = [claim for claim in study["claims"] if claim["pairs"]]
    kinds = list(study["worlds"])
    most = max((sum(claim["kind"] == kind for claim in tried) for kind in kinds), default=1)
    figure = _figure(12, 1.2 + 0.3 * most)
    for axes, kind in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        rows = [claim for claim in tried if claim["kind"] == kind]
        names = [f"{_title(one['metric'])}: {one['best']} before {one['other']}" for one in rows]
        _forest(axes, names, [[one] for one in rows], [COLOURS[one["verdict"]] for one in rows])
        axes.set_title(f"{kind}: better by", fontsize="medium")
    figure.suptitle(", ".join(f"{name}: {colour}" for name, colour in COLOURS.items()))
    return figure


def choices(study: Mapping[str, Any]) -> Any:
    """What each choice of the short runs is worth against the run that lacks it."""
    rows = study["contrasts"]
    kinds, metrics = (list(dict.fromkeys(row[name] for row in rows)) for name in ("kind", "metric"))
    figure = _figure(13, 1 + 0.28 * len({row["run"] for row in rows}))
    panels = figure.subplots(1, max(len(metrics), 1), sharey=True, squeeze=False)[0]
    for axes, metric in zip(panels, metrics, strict=False):
        held = [row for row in rows if row["metric"] == metric]
        pairs = list(dict.fromkeys((row["run"], row["against"]) for row in held))
        found = [[row for row in held if row["run"] == run] for run, _ in pairs]
        names = [f"{run} against {against}" for run, against in pairs]
        _forest(axes, names, found, ["C0"] * len(names))
        axes.set(title=f"{_title(metric)}: better by ({', '.join(kinds)})")
    return figure


def _forest(
    axes: Any,
    names: Sequence[str],
    rows: Iterable[Sequence[Mapping[str, Any]]],
    colours: Sequence[str],
) -> None:
    """A line a name, from the top; a point with an interval for each of its differences."""
    for n, (found, colour) in enumerate(zip(rows, colours, strict=True)):
        for m, one in enumerate(found):
            if (mean := one["difference"]) is None:
                continue
            reach = [[0.0], [0.0]]
            if one["low"] is not None:
                reach = [[mean - one["low"]], [one["high"] - mean]]
            at = n + 0.2 * (m - (len(found) - 1) / 2)
            axes.errorbar(mean, at, xerr=reach, fmt="os"[m % 2], color=colour, markersize=4)
    axes.axvline(0, color="grey", linewidth=0.8)
    axes.set_yticks(range(len(names)), names, fontsize="small")
    axes.invert_yaxis()
    axes.grid(alpha=0.3)


def _title(metric: str) -> str:
    return (METRICS | PLAN_METRICS)[metric].label


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _png(figure: Any) -> bytes:
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=100)
    return memory.getvalue()


def main() -> None:
    """Make the study, or draw one."""
    parser = measuring.options(__doc__)
    parser.add_argument("--out", type=Path, default=Path("study"))
    parser.add_argument("--draw", type=Path)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--maps", type=int, default=20_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", action="append", default=[])
    given = measuring.parse(
        parser, scale=0.002, maps=2000, workers=1, only=["occ-short", "proposed-short"]
    )
    if given.draw is None:
        config = ReproduceConfig(scale=given.scale, maps=given.maps, only=tuple(given.only))
        study = Study(
            out=given.out, config=config, runs=ALL, worlds=ELSEWHERE, workers=given.workers
        ).make(lambda label: Progress(label, shown=True))
        folder = given.out / "figures"
    else:
        study, folder = json.loads(given.draw.read_text()), given.out
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in draw(study).items():
        (folder / name).write_bytes(picture)
        print(folder / name)


if __name__ == "__main__":
    main()
