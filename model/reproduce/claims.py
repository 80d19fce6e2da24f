"""What the paper claims, and what a bench says of it.

Every bold cell of the paper's tables is a claim: this method is better than each other one, by this metric, on this
kind of worlds. A claim is judged seed by seed, by the difference between two methods on the same maps, with a 95 %
interval from a bootstrap over worlds.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from scenegen.model.evaluation import paper
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.run import DatasetResult
from scenegen.model.evaluation.statistics import DRAWS
from scenegen.model.reproduce.runs import Run

Verdict = Literal["confirmed", "refuted", "undecided"]
QUESTIONS = {
    "Q1": "Does learning occupancy and TUDF jointly improve reconstruction over single-task baselines?",
    "Q2": "Does the better reconstruction benefit planning in unknown environments?",
    "Q3": "Does a better reconstructed field give better trajectories?",
}
"""The paper's questions, in our words."""
ROWS = {"TUDF": "tudf", "OCC": "occ", "Proposed": "proposed"}
"""The paper's methods and the study's."""
ABOUT = {
    "Q1": ("rmse", "mae", "near_rmse", "near_mae", "iou", "f1"),
    "Q2": ("success",),
    "Q3": ("min_clearance", "avg_clearance", "length"),
}
"""The metrics by which a question is answered; other cells are judged, and answer none."""
TOLD = ("iou", "near_rmse", "success")
"""The metrics by which runs are compared that no claim is about."""


BESIDE = (("proposed-1", "proposed"), ("proposed-1", "occ"), ("columns", "occ"), ("columns", "proposed-1"))
"""What is judged beside the paper's claims, by `TOLD`: the first before the second."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """`best` is better than `other` by `metric` on worlds of `kind`: rows of the study, without their seeds."""

    kind: str
    metric: str
    best: str
    other: str

    @property
    def question(self) -> str | None:
        """The question that it helps to answer: one of `QUESTIONS`, for claims that `proposed` is best."""
        asked = [question for question, metrics in ABOUT.items() if self.metric in metrics]
        return asked[0] if asked and self.best == "proposed" else None


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """How much better `best` is than `other` by one seed's networks; positive where the claim holds."""

    seed: int
    difference: float
    low: float | None
    """Lower end of the 95 % interval; None where there is one world."""
    high: float | None

    @property
    def sign(self) -> int:
        """1 where the interval lies above 0, -1 where it lies below, 0 where it holds 0."""
        if self.low is None or self.high is None:
            return 0
        return int(self.low > 0) - int(self.high < 0)


def claims() -> tuple[Claim, ...]:
    """The claims of all bold cells, but where the paper's figures are equal."""
    return tuple(
        Claim(kind=kind, metric=metric, best=ROWS[best], other=ROWS[other])
        for tables, metrics in ((paper.RECONSTRUCTION, METRICS), (paper.PLANNING, PLAN_METRICS))
        for kind, rows in tables.items()
        for metric in metrics
        for losses in [{name: _loss(metric, row[metric][0]) for name, row in rows.items()}]
        for best in [min(losses, key=lambda name: losses[name])]
        for other in rows
        if losses[other] > losses[best]
    )


def beside() -> tuple[Claim, ...]:
    """What the study asks on its own account."""
    return tuple(
        Claim(kind=kind, metric=metric, best=best, other=other)
        for kind in paper.PLANNING
        for best, other in BESIDE
        for metric in TOLD
    )


def judge(claim: Claim, result: DatasetResult, *, seeds: Sequence[int], seed: int) -> list[Contrast]:
    """The claim's contrast for every one of `seeds` whose networks `result` holds, as rows named ``occ-s0``; `seed` is
    the bootstrap's."""
    found = []
    for number in seeds:
        best, other = f"{claim.best}-s{number}", f"{claim.other}-s{number}"
        if {best, other} <= result.methods.keys():
            difference, low, high = _gain(claim.metric, result, best, other, seed)
            found.append(Contrast(seed=number, difference=difference, low=low, high=high))
    return found


def verdict(contrasts: Sequence[Contrast]) -> Verdict:
    """Confirmed where every seed's interval lies on the claim's side of 0, refuted where every one lies on the other
    side; undecided otherwise, and where there are fewer than two seeds."""
    signs = {contrast.sign for contrast in contrasts}
    if len(contrasts) < 2 or signs not in ({1}, {-1}):
        return "undecided"
    return "confirmed" if signs == {1} else "refuted"


def judged(
    result: DatasetResult, asked: Sequence[Claim], *, seeds: Sequence[int], seed: int = 0
) -> list[dict[str, Any]]:
    """Those claims of `asked` that are about `result`'s kind, as JSON: what each says, its question, its verdict, and
    each seed's contrast."""
    found = []
    for claim in asked:
        if claim.kind == result.kind:
            contrasts = judge(claim, result, seeds=seeds, seed=seed)
            said = {"question": claim.question, "verdict": verdict(contrasts)}
            found.append(vars(claim) | said | {"seeds": [vars(contrast) for contrast in contrasts]})
    return found


def answers(found: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """What `judged` claims, of all kinds, say to each question: how many are confirmed, refuted and undecided, and the
    verdict on which all of them agree, or else "undecided"."""
    answered = {}
    for question, text in QUESTIONS.items():
        said = Counter(claim["verdict"] for claim in found if claim["question"] == question)
        agreed = next(iter(said)) if len(said) == 1 else "undecided"
        answered[question] = {"asks": text, "verdict": agreed, "claims": dict(said)}
    return answered


def _loss(metric: str, value: Any) -> Any:
    """What is the smaller the better."""
    better = (METRICS | PLAN_METRICS)[metric].better
    return -value if better == "higher" else value if better == "lower" else np.abs(value)


def contrasts(result: DatasetResult, runs: Sequence[Run], *, seed: int) -> list[dict[str, Any]]:
    """How much better each of `runs` is than the one that it is compared with, by `TOLD`, as JSON: one seed, so that
    no verdict follows."""
    return [
        {"run": run.name, "against": run.against, "kind": result.kind, "metric": metric}
        | dict(zip(("difference", "low", "high"), _gain(metric, result, run.name, run.against, seed), strict=True))
        for run in runs
        if run.against in result.methods
        for metric in TOLD
    ]


def _gain(
    metric: str, result: DatasetResult, best: str, other: str, seed: int
) -> tuple[float, float | None, float | None]:
    """By how much row `best` of `result` is better than row `other`, and the interval's ends, as in `Contrast`.

    Each method's mean is over its own values, as in the tables; worlds are drawn with replacement for both alike.
    """
    rows = [result.methods[name] for name in (best, other)]
    if metric in METRICS:
        column, worlds = list(METRICS).index(metric), result.worlds
        pair = [row.reconstruction[:, 0, column] for row in rows]
    else:
        of, worlds = PLAN_METRICS[metric].of, result.trial_worlds
        pair = [np.array([of(trial) for trial in row.trials], np.float64) for row in rows]
    names, member = np.unique(worlds, return_inverse=True)
    drawn = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1 / len(names)), DRAWS)
    weights = np.vstack([np.ones(len(names)), drawn])
    losses = []
    for values in pair:
        held = np.isfinite(values)
        sums, counts = (
            np.bincount(member[held], weights=part[held], minlength=len(names))
            for part in (values, np.ones(len(values)))
        )
        with np.errstate(invalid="ignore"):  # a draw of worlds without a path says nothing
            losses.append(_loss(metric, (weights @ sums) / (weights @ counts)))
    gains = losses[1] - losses[0]
    if len(names) < 2 or not np.isfinite(gains[1:]).any():
        return float(gains[0]), None, None
    low, high = np.nanpercentile(gains[1:], [2.5, 97.5])
    return float(gains[0]), float(low), float(high)
