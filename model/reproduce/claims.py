"""What the paper claims, and what a bench says of it.

Every bold cell of the paper's tables is a claim: this method is better than each other one, by this metric, on this
kind of worlds. A claim is judged by every pair of seeds, one of each method: by the difference on the same maps, and by
a bootstrap over worlds, which gives its 95 % interval and the probability of so large a difference where there is none.
All claims together are held to one level (S. Holm, "A simple sequentially rejective multiple test procedure",
Scandinavian Journal of Statistics 6, 1979).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scenegen.model.evaluation import paper
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.run import DatasetResult
from scenegen.model.evaluation.statistics import holm, resamples
from scenegen.model.reproduce.runs import Run

Verdict = Literal["confirmed", "refuted", "undecided"]
DRAWS = 10_000
"""Resamples of the bootstrap: Holm's rule needs probabilities of a thousandth."""
LEVEL = 0.05
"""The probability that any verdict is decided where all differences are chance."""
QUESTIONS = {
    "Q1": "Does learning occupancy and TUDF jointly improve reconstruction over single-task baselines?",
    "Q2": "Does the better reconstruction benefit planning in unknown environments?",
    "Q3": "Does a better reconstructed field give better trajectories?",
}
"""The paper's questions, in our words."""
ROWS = {"TUDF": "tudf", "OCC": "occ", "Proposed": "proposed"}
"""The paper's methods and the study's."""
ABOUT = {
    "Q1": tuple(METRICS),
    "Q2": ("success",),
    "Q3": ("min_clearance", "avg_clearance", "length"),
}
"""The metrics by which a question is answered; other cells are judged, and answer none."""
TOLD = ("iou", "near_rmse", "success")
"""The metrics by which runs of a part of the budget are compared."""
BESIDE = (
    ("proposed-1", "proposed"),
    ("proposed-1", "occ"),
    ("proposed-1", "tudf"),
    ("no-eikonal", "proposed"),
    ("no-eikonal", "occ"),
    ("columns", "occ"),
    ("columns", "proposed"),
    ("columns", "proposed-1"),
)
"""What is judged beside the paper's claims, by `BESIDE_BY`: the first before the second."""
BESIDE_BY = ("rmse", "mae", "near_rmse", "near_mae", "iou", "f1", "success")


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
    """How much better one network is than another; positive where the first is."""

    difference: float
    low: float | None
    """Lower end of the 95 % interval; None where there is one world."""
    high: float | None
    chance: float | None
    """Two-sided probability of a difference so far from 0 where there is none; None where there is one world."""


def claims() -> tuple[Claim, ...]:
    """The claims of all bold cells. Two methods with equal figures are both bold, and neither is better than the
    other."""
    return tuple(
        Claim(kind=kind, metric=metric, best=ROWS[best], other=ROWS[other])
        for tables, metrics in ((paper.RECONSTRUCTION, METRICS), (paper.PLANNING, PLAN_METRICS))
        for kind, rows in tables.items()
        for metric in metrics
        for losses in [{name: _loss(metric, row[metric][0]) for name, row in rows.items()}]
        for best, other in product(rows, rows)
        if losses[best] == min(losses.values()) < losses[other]
    )


def beside() -> tuple[Claim, ...]:
    """What the study asks on its own account."""
    return tuple(
        Claim(kind=kind, metric=metric, best=best, other=other)
        for kind in paper.PLANNING
        for best, other in BESIDE
        for metric in BESIDE_BY
    )


def of_paths() -> tuple[Claim, ...]:
    """The claims about paths, which the tables answer by the paths that each method has. A method that has none in the
    tight trials has the better ones for it: so they are judged again on those trials where both have a path."""
    return tuple(claim for claim in claims() if claim.metric in ABOUT["Q3"])


def judged(
    drawn: Sequence["Draws"], asked: Sequence[Claim], seeds: Sequence[int], *, common: bool = False
) -> list[dict[str, Any]]:
    """Each of `asked` as JSON: what it says, its question, its verdict, its probability by Holm, and its contrast for
    every pair of `seeds` whose networks are there, as rows named ``occ-s0``.

    A claim is confirmed where every pair has it so, refuted where every pair has it the other way, and the least of its
    pairs is still told from chance at `LEVEL` among all claims that can be decided; it is undecided otherwise, and
    where a method has fewer than two seeds. Means are over what each method has a value for, as in the tables; with
    `common`, over what both of a pair have one for.
    """
    by_kind = {one.result.kind: one for one in drawn}
    found = [_pairs(claim, by_kind[claim.kind], seeds, common) for claim in asked if claim.kind in by_kind]
    chances = {number: chance for number, (_, pairs) in enumerate(found) if (chance := _least_sure(pairs)) is not None}
    adjusted = dict(zip(chances, holm(list(chances.values())).tolist(), strict=True))
    return [
        vars(claim)
        | {"question": claim.question, "verdict": _verdict(pairs, adjusted.get(number)), "holm": adjusted.get(number)}
        | {"pairs": [{"best_seed": ours, "other_seed": theirs} | vars(one) for (ours, theirs), one in pairs.items()]}
        for number, (claim, pairs) in enumerate(found)
    ]


Pairs = Mapping[tuple[int, int], Contrast]
"""Contrasts by the seeds of the better and of the other method."""


def _pairs(claim: Claim, drawn: "Draws", seeds: Sequence[int], common: bool) -> tuple[Claim, Pairs]:
    ours, theirs = ({seed: f"{name}-s{seed}" for seed in seeds} for name in (claim.best, claim.other))
    rows = drawn.result.methods.keys()
    return claim, {
        (first, second): drawn.gain(claim.metric, ours[first], theirs[second], common=common)
        for first, second in product(seeds, seeds)
        if {ours[first], theirs[second]} <= rows
    }


def _least_sure(pairs: Pairs) -> float | None:
    """The largest probability of chance among the pairs, 1 where they differ to both sides; None where they cannot
    decide."""
    if any(len({pair[place] for pair in pairs}) < 2 for place in (0, 1)):
        return None
    if len({one.difference > 0 for one in pairs.values()}) > 1:
        return 1.0
    chances = [one.chance for one in pairs.values() if one.chance is not None]
    return max(chances) if len(chances) == len(pairs) else None


def _verdict(pairs: Pairs, chance: float | None) -> Verdict:
    if chance is None or chance > LEVEL:
        return "undecided"
    return "confirmed" if all(one.difference > 0 for one in pairs.values()) else "refuted"


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


def contrasts(drawn: "Draws", runs: Sequence[Run]) -> list[dict[str, Any]]:
    """How much better each of `runs` is than the one that it is compared with, by `TOLD`, as JSON: one seed, so that
    no verdict follows."""
    return [
        {"run": run.name, "against": run.against, "kind": drawn.result.kind, "metric": metric}
        | vars(drawn.gain(metric, run.name, run.against))
        for run in runs
        if run.against in drawn.result.methods
        for metric in TOLD
    ]


class Draws:
    """The means of a bench's rows over resamples of its worlds, the same resamples for all of them."""

    def __init__(self, result: DatasetResult, seed: int):
        """`seed` is the bootstrap's."""
        self.result = result
        self._of_maps, self._of_trials = _Worlds(result.worlds, seed), _Worlds(result.trial_worlds, seed)
        self._losses: dict[tuple[str, str, str], NDArray[np.float64]] = {}

    def gain(self, metric: str, best: str, other: str, *, common: bool = False) -> Contrast:
        """By how much row `best` is better than row `other`: each by its own values, as in the tables, or, with
        `common`, by what both have a value for."""
        gains = self._loss(metric, other, best if common else other) - self._loss(
            metric, best, other if common else best
        )
        difference, resampled = float(gains[0]), gains[1:][np.isfinite(gains[1:])]
        if self._of_maps.count < 2 or not len(resampled):
            return Contrast(difference=difference, low=None, high=None, chance=None)
        low, high = np.percentile(resampled, [2.5, 97.5])
        beyond = min(np.count_nonzero(resampled <= 0), np.count_nonzero(resampled >= 0))
        chance = min(2 * (beyond + 1) / (len(resampled) + 1), 1.0)
        return Contrast(difference=difference, low=float(low), high=float(high), chance=chance)

    def _loss(self, metric: str, name: str, also: str) -> NDArray[np.float64]:
        """The mean of row `name`, where `also` has values, too, as something to be small, (1 + DRAWS,): of all worlds
        first, then of each resample."""
        key = metric, name, also
        if key not in self._losses:
            values = self._values(metric, name)
            there = np.isfinite(self._values(metric, also))
            worlds = self._of_maps if metric in METRICS else self._of_trials
            self._losses[key] = _loss(metric, worlds.means(np.where(there, values, np.nan)))
        return self._losses[key]

    def _values(self, metric: str, name: str) -> NDArray[np.float64]:
        """The metric of every map, or of every trial."""
        row = self.result.methods[name]
        if metric in METRICS:
            return np.asarray(row.reconstruction[:, 0, list(METRICS).index(metric)])
        of = PLAN_METRICS[metric].of
        return np.array([of(trial) for trial in row.trials], np.float64)


class _Worlds:
    """Resamples of worlds with replacement, for values that belong to them."""

    def __init__(self, worlds: NDArray[np.int64], seed: int):
        """`worlds` (N,) names the world of every value."""
        names, self._member = np.unique(worlds, return_inverse=True)
        self.count = len(names)
        self._weights = np.vstack([np.ones(self.count), resamples(self.count, np.random.default_rng(seed), DRAWS)])

    def means(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The mean of `values` (N,) that are finite: of all worlds first, then of each resample, (1 + DRAWS,)."""
        held = np.isfinite(values)
        sums, counts = (
            np.bincount(self._member[held], weights=part[held], minlength=self.count)
            for part in (values, np.ones(len(values)))
        )
        with np.errstate(invalid="ignore"):  # a draw of worlds without a path says nothing
            return np.asarray((self._weights @ sums) / (self._weights @ counts))
