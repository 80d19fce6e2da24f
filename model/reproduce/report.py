"""The study for people: what it found, from what ``study.json`` holds and nothing else."""

from collections.abc import Mapping, Sequence
from typing import Any

from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.study.report import brief
from scenegen.model.evaluation.tables import head, interval, line

SHOWN = {"reconstruction": ("iou", "near_rmse"), "planning": ("success",)}
"""The figures of every row; all others stand in the JSON."""


def to_markdown(study: Mapping[str, Any]) -> str:
    """Verdicts, then the figures behind them."""
    settings = study["settings"]
    lines = [
        "# The study",
        "",
        f"{len(study['runs'])} networks, each trained on {settings['maps'] * settings['scale']:.0f} maps seen, scale "
        f"{settings['scale']:g}, on {study['device']}, at commit {study['commit']}. Written by `scenegen reproduce`; "
        "every figure here stands in `study.json`, with many more.",
        "",
        "## Verdicts",
        "",
        "A claim is that one of the paper's methods is better than another by one metric on one kind of worlds: one "
        "for every bold cell of its tables and every other row. It is confirmed, or refuted, where the 95 % interval "
        "of the difference lies on one side of 0 for two seeds or more; else it is undecided.",
        "",
        *head(("verdict", "claims")),
    ]
    for name, said in study["verdicts"].items():
        lines.append(line(f"{name}: {said['asks']}", (f"**{said['verdict']}**", _counts(said["claims"]))))
    for kind, report in study["reports"].items():
        lines += ["", f"## {kind}", "", "How much better by each seed, with 95 % intervals:", ""]
        lines += head(("verdict", "seeds"))
        for claim in study["claims"]:
            if claim["kind"] == kind:
                name = f"{claim['metric']}: {claim['best']} before {claim['other']}"
                lines.append(line(name, (claim["verdict"], _seeds(claim["seeds"]))))
        columns = [(table, name) for table, names in SHOWN.items() for name in names]
        lines += ["", "Means over test maps and trials, with 95 % intervals:", ""]
        lines += head([(METRICS | PLAN_METRICS)[name].label for _, name in columns])
        for row in report["reconstruction"][kind]:
            lines.append(line(row, (brief(report[table][kind][row][name]) for table, name in columns)))
    lines += ["", "## Runs", "", *head(("asks", "weights"))]
    lines += [line(f"`{name}`", (run["asks"], f"{run['sha256'][:12]}…")) for name, run in study["runs"].items()]
    return "\n".join(lines) + "\n"


def _counts(claims: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {said}" for said, count in sorted(claims.items()))


def _seeds(contrasts: Sequence[Mapping[str, Any]]) -> str:
    return "; ".join(f"{one['difference']:+.3f} {interval(one, '+.3f')}" for one in contrasts) or "–"
