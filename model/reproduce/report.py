"""The study for people: what it found, from what ``study.json`` holds and nothing else."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.statistics import caution
from scenegen.model.evaluation.study.report import brief, fate_lines, success_lines, threshold_lines
from scenegen.model.evaluation.tables import head, interval, line
from scenegen.model.reproduce.claims import PATIENCE, seeded

SHOWN = {"reconstruction": ("iou", "near_rmse"), "planning": ("success",)}
"""The figures of every row; all others stand in the JSON."""


def to_markdown(study: Mapping[str, Any]) -> str:
    """Verdicts, then the figures behind them."""
    settings, runs = study["settings"], study["runs"]
    devices = ", ".join(sorted({run["device"] for run in runs.values()}))
    hours = sum(run["hours"] for run in runs.values())
    lines = [
        "# The study",
        "",
        f"{len(runs)} networks at scale {settings['scale']:g}; the whole budget is "
        f"{settings['maps'] * settings['scale']:.0f} maps seen. They were trained in {hours:.1f} "
        f"hours on {devices}; "
        f"they were measured at commit {study['commit']}. Written by `scenegen reproduce`; "
        f"`study.json` holds every "
        "figure of this page, and many more.",
    ]
    if study["missing"]:
        lines += [
            "",
            f"**Not trained yet**, so that verdicts do without them: {_names(study['missing'])}.",
        ]
    lines += [
        "",
        "## Verdicts",
        "",
        "A claim is that one of the paper's methods is better than another by one metric on one "
        "kind of worlds: one "
        "for every bold cell of its tables and every other row. It is confirmed, or contradicted, "
        "where the mean "
        "difference over all seeds, two of each method at least, is told from chance in worlds "
        "and in training seeds "
        "at a level of .05 for all claims together (Holm); else it is undecided. A claim is "
        "refuted only by networks "
        f"that went on for {PATIENCE} epochs without a lower validation loss, as the paper's "
        f"early stopping asks; "
        f"contradicted by others, that may yet turn.{_epochs(runs)}",
        "",
        *head(("verdict", "claims")),
    ]
    for name, said in study["verdicts"].items():
        lines.append(
            line(f"{name}: {said['asks']}", (f"**{said['verdict']}**", _counts(said["claims"])))
        )
    for kind in study["report"]["reconstruction"]:
        lines += ["", f"## {kind}", ""]
        lines += (
            [f"**{few}.**", ""]
            if (few := caution(study["report"]["datasets"][kind]["worlds"]))
            else []
        )
        for title, claims in (
            ("The paper's claims", study["claims"]),
            ("Those about paths again, where both methods of a pair have one", study["paths"]),
            ("Beside them, judged alike", study["beside"]),
        ):
            rows = [claim for claim in claims if claim["kind"] == kind]
            tried = [claim for claim in rows if claim["pairs"]]
            lines += [f"{title}; {len(rows) - len(tried)} of {len(rows)} have no networks yet:", ""]
            lines += [
                *head(("verdict", "chance (Holm)", "better by", "pair by pair")),
                *_judged(tried),
                "",
            ]
        lines += [
            "Means over test maps and trials, with 95 % intervals:",
            "",
            *_means(study["report"], kind),
        ]
        if studied := study["report"].get("study", {}).get(kind):
            lines += [
                *success_lines(studied, "search"),
                *success_lines(studied, "clearance_weight"),
                *threshold_lines(studied),
                *fate_lines(studied),
            ]
        compared = [row for row in study["contrasts"] if row["kind"] == kind]
        if study["short"]["reconstruction"][kind]:
            lines += [
                "",
                "Runs with a part of the budget, one seed:",
                "",
                *_means(study["short"], kind),
            ]
        for name, there in study["elsewhere"].items():
            lines += [
                "",
                f"`{name}`: {there['asks']}; runs with a part of the budget, one seed:",
                "",
            ]
            lines += _means(there["report"], kind)
        if compared:
            lines += [
                "",
                "How much better than the run that they are compared with:",
                "",
                *_compared(compared),
            ]
    lines += ["", "## Runs", "", *head(("what for", "maps, hours", "weights"))]
    for name, run in runs.items():
        spent = f"{run['maps']:.0f} of {run['samples']}, {run['hours']:.1f}"
        lines.append(line(f"`{name}`", (run["asks"], spent, f"{run['sha256'][:12]}…")))
    return "\n".join(lines) + "\n"


def _means(report: Mapping[str, Any], kind: str) -> list[str]:
    columns = [(table, name) for table, names in SHOWN.items() for name in names]
    titles = head([_label(name) for _, name in columns])
    rows = report["reconstruction"][kind]
    return [
        *titles,
        *(
            line(row, (brief(report[table][kind][row][name]) for table, name in columns))
            for row in rows
        ),
    ]


def _judged(claims: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    for claim in claims:
        name = f"{_label(claim['metric'])}: {claim['best']} before {claim['other']}"
        chance = "" if claim["holm"] is None else f"{claim['holm']:.4f}"
        yield line(
            name,
            (
                claim["verdict"],
                chance,
                _gain(claim),
                "; ".join(_signed(one) for one in claim["pairs"]),
            ),
        )


def _compared(rows: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    found: dict[str, list[str]] = {}
    for row in rows:
        found.setdefault(f"{row['run']} than {row['against']}", []).append(_gain(row))
    metrics = dict.fromkeys(row["metric"] for row in rows)
    yield from head([_label(name) for name in metrics])
    for name, cells in found.items():
        yield line(name, cells)


def _label(metric: str) -> str:
    return (METRICS | PLAN_METRICS)[metric].label


def _names(runs: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in runs)


def _counts(claims: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {said}" for said, count in sorted(claims.items()))


def _gain(found: Mapping[str, Any]) -> str:
    return f"{_signed(found)} {interval(found, '+.3f')}"


def _signed(found: Mapping[str, Any]) -> str:
    return "–" if found["difference"] is None else f"{found['difference']:+.3f}"


def _epochs(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """How many epochs the runs of which verdicts are had."""
    counts = sorted(
        {run["maps"] // run["samples"] for name, run in runs.items() if seeded(name)[1] is not None}
    )
    return (
        f" Those with the whole budget saw {' to '.join(f'{count:g}' for count in counts)} epochs."
        if counts
        else ""
    )
