"""The study for people: what it found, from what ``study.json`` holds and nothing else."""

from collections.abc import Mapping
from typing import Any

from scenegen.model.evaluation.statistics import brief, caution, head, interval, line
from scenegen.model.study.claims import ALL, PATIENCE

SHOWN = ("iou", "near_rmse", "success")
"""The figures of every row; all others stand in the JSON."""
RULE = f"""
A claim says that one of the paper's methods is better than another, by one metric, on one kind of
worlds. Each bold cell of the paper's tables makes one against every other row. It is confirmed, or
contradicted, if the mean difference over all seeds (two of each method at least) is told from
chance, in worlds and in training seeds, at a level of .05 for all claims together (Holm). Otherwise
it is undecided. Only networks that trained for {PATIENCE} epochs without a lower validation loss,
as the paper's early stopping asks, can refute a claim; others can contradict it.
""".strip().replace("\n", " ")


def to_markdown(study: Mapping[str, Any]) -> str:
    """Verdicts, then the figures behind them."""
    settings, runs = study["settings"], study["runs"]
    devices = ", ".join(sorted({run["device"] for run in runs.values()}))
    hours = sum(run["hours"] for run in runs.values())
    lines = [
        "# The study",
        "",
        f"{len(runs)} networks at scale {settings['scale']:g}. The whole budget is "
        f"{settings['maps'] * settings['scale']:.0f} maps seen. Training took {hours:.1f} hours on "
        f"{devices}. Measured at commit {study['commit']} by `scenegen reproduce`; `study.json` "
        f"holds every figure of this page.",
        "",
    ]
    if study["missing"]:
        names = ", ".join(f"`{name}`" for name in study["missing"])
        lines += [f"**Not trained**, so that verdicts do without them: {names}.", ""]
    lines += ["## Verdicts", "", RULE, "", *head(("verdict", "claims"))]
    for name, said in study["verdicts"].items():
        counts = ", ".join(f"{count} {said}" for said, count in sorted(said["claims"].items()))
        lines.append(line(f"{name}: {said['asks']}", (f"**{said['verdict']}**", counts)))
    for kind in study["worlds"]:
        lines += _of_kind(study, kind)
    lines += ["", "## Runs", "", *head(("what for", "maps, hours", "weights"))]
    for name, run in runs.items():
        spent = f"{run['maps']:.0f} of {run['samples']}, {run['hours']:.1f}"
        lines.append(line(f"`{name}`", (run["asks"], spent, f"{run['sha256'][:12]}…")))
    return "\n".join(lines) + "\n"


def _of_kind(study: Mapping[str, Any], kind: str) -> list[str]:
    lines = ["", f"## {kind}", ""]
    if few := caution(study["worlds"][kind]):
        lines += [f"**{few}.**", ""]
    for title, claims in (
        ("The paper's claims", study["claims"]),
        ("Those about paths again, where both methods of a pair have one", study["paths"]),
        ("Beside them, judged alike", study["beside"]),
    ):
        rows = [claim for claim in claims if claim["kind"] == kind]
        tried = [claim for claim in rows if claim["pairs"]]
        lines += [f"{title}; {len(rows) - len(tried)} of {len(rows)} have no networks yet:", ""]
        lines += head(("verdict", "chance (Holm)", "better by", "pair by pair"))
        lines += [*map(_judged, tried), ""]
    lines += ["Means over test maps and trials, with 95 % intervals:", ""]
    lines += head([ALL[name].label for name in SHOWN])
    lines += [
        line(row, (brief(figures[name]) for name in SHOWN))
        for row, figures in study["means"][kind].items()
    ]
    return lines


def _judged(claim: Mapping[str, Any]) -> str:
    name = f"{ALL[claim['metric']].label}: {claim['best']} before {claim['other']}"
    chance = "" if claim["holm"] is None else f"{claim['holm']:.4f}"
    pairs = "; ".join(_signed(one) for one in claim["pairs"])
    return line(name, (claim["verdict"], chance, _gain(claim), pairs))


def _gain(found: Mapping[str, Any]) -> str:
    return f"{_signed(found)} {interval(found, '+.3f')}"


def _signed(found: Mapping[str, Any]) -> str:
    return "–" if found["difference"] is None else f"{found['difference']:+.3f}"
