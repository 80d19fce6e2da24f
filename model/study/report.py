"""The study for people: what it found, from what ``study.json`` holds and nothing else."""

from collections.abc import Sequence

from scenegen.files import Json
from scenegen.model.evaluation.statistics import brief, caution, interval, table
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


def to_markdown(study: Json) -> str:
    """Verdicts, then the figures behind them."""
    settings, runs = study["settings"], study["runs"]
    devices = ", ".join(sorted({run["device"] for run in runs.values()}))
    hours = sum(run["hours"] for run in runs.values())
    blocks = [
        "# The study",
        f"{len(runs)} networks at scale {settings['scale']:g}. The whole budget is "
        f"{settings['maps'] * settings['scale']:.0f} maps seen. Training took {hours:.1f} hours on "
        f"{devices}. Measured at commit {study['commit']} by `scenegen reproduce`; `study.json` "
        f"holds every figure of this page.",
    ]
    if study["missing"]:
        names = ", ".join(f"`{name}`" for name in study["missing"])
        blocks.append(f"**Not trained**, so that verdicts do without them: {names}.")
    verdicts = []
    for name, said in study["verdicts"].items():
        counts = ", ".join(f"{count} {said}" for said, count in sorted(said["claims"].items()))
        verdicts.append((f"{name}: {said['asks']}", (f"**{said['verdict']}**", counts)))
    blocks += ["## Verdicts", RULE, table(("verdict", "claims"), verdicts)]
    for kind in study["worlds"]:
        blocks += _of_kind(study, kind)
    spent = []
    for name, run in runs.items():
        maps = f"{run['maps']:.0f} of {run['samples']}, {run['hours']:.1f}"
        spent.append((f"`{name}`", (run["asks"], maps, f"{run['sha256'][:12]}…")))
    blocks += ["## Runs", table(("what for", "maps, hours", "weights"), spent)]
    return "\n\n".join(blocks) + "\n"


def _of_kind(study: Json, kind: str) -> list[str]:
    blocks = [f"## {kind}"]
    if few := caution(study["worlds"][kind]):
        blocks.append(f"**{few}.**")
    for title, claims in (
        ("The paper's claims", study["claims"]),
        ("Those about paths again, where both methods of a pair have one", study["paths"]),
        ("Beside them, judged alike", study["beside"]),
    ):
        rows = [claim for claim in claims if claim["kind"] == kind]
        tried = [claim for claim in rows if claim["pairs"]]
        heads = ("verdict", "chance (Holm)", "better by", "pair by pair")
        blocks += [
            f"{title}; {len(rows) - len(tried)} of {len(rows)} have no networks yet:",
            table(heads, map(_judged, tried)),
        ]
    means = [
        (row, [brief(figures[name]) for name in SHOWN])
        for row, figures in study["means"][kind].items()
    ]
    return [
        *blocks,
        "Means over test maps and trials, with 95 % intervals:",
        table([ALL[name].label for name in SHOWN], means),
    ]


def _judged(claim: Json) -> tuple[str, Sequence[str]]:
    """A claim's row."""
    name = f"{ALL[claim['metric']].label}: {claim['best']} before {claim['other']}"
    chance = "" if claim["holm"] is None else f"{claim['holm']:.4f}"
    better = f"{_signed(claim)} {interval(claim, '+.3f')}"
    pairs = "; ".join(_signed(one) for one in claim["pairs"])
    return name, (claim["verdict"], chance, better, pairs)


def _signed(found: Json) -> str:
    return "–" if found["difference"] is None else f"{found['difference']:+.3f}"
