"""What the paper claims, what a bench says of it, and the study's claims as a table.

Every bold cell of the paper's tables is a claim: this method is better than each other one, by this
metric, on this kind of worlds. A claim is judged by the mean difference over all seeds of both
methods, on the same maps. Its variance is that over worlds and that over training seeds, which is
pooled over methods, since each has two or three; both have few degrees of freedom, which are joined
as by F. E. Satterthwaite, "An approximate distribution of estimates of variance components",
Biometrics Bulletin 2, 1946. All claims together are held to one level (S. Holm, "A simple
sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6, 1979).
"""

import csv
import io
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from lidarsim.grid import Floats
from scenegen.base.files import Json
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS
from scenegen.model.bench.report import PAPER, summaries
from scenegen.model.bench.run import DatasetResult
from scenegen.model.bench.statistics import (
    Estimate,
    estimate,
    holm,
)
from scenegen.model.config import TrainConfig

QUESTIONS = {
    "Q1": (
        "Does learning occupancy and TUDF jointly improve reconstruction over single-task "
        "baselines?",
        [
            "rmse",
            "mae",
            "near_rmse",
            "near_mae",
            "bias",
            "near_bias",
            "iou",
            "f1",
            "precision",
            "recall",
        ],
    ),
    "Q2": ("Does the better reconstruction benefit planning in unknown environments?", ["success"]),
    "Q3": (
        "Does a better reconstructed field give better trajectories?",
        ["min_clearance", "avg_clearance", "length"],
    ),
}
"""The paper's questions, in our words, and the metrics by which claims that `proposed` is best
answer each; other cells of the paper's tables are judged, and answer none."""
BESIDE_METRICS = "rmse", "mae", "near_rmse", "near_mae", "iou", "f1", "success"
BESIDE_PAIRS = (
    ("proposed-1", "proposed"),
    ("proposed-1", "occ"),
    ("proposed-1", "tudf"),
    ("no-eikonal", "proposed"),
    ("no-eikonal", "occ"),
    ("columns", "occ"),
    ("columns", "proposed"),
    ("columns", "proposed-1"),
)
"""Comparisons that the paper does not make: is the first of each pair better than the second?"""
PATIENCE = TrainConfig().patience
"""Epochs without a lower validation loss after which the paper stops. What networks show that did
not train so long may be the other way round later: a claim is contradicted by them, and not
refuted."""
LEVEL = 0.05
"""The probability that any verdict is decided where all differences are chance."""
ROWS = {"TUDF": "tudf", "OCC": "occ", "Proposed": "proposed"}
"""The paper's methods and the study's."""
ALL = METRICS | PLAN_METRICS


def means(result: DatasetResult) -> dict[str, Json]:
    """Every metric of every row, {mean, std, low, high, n}."""
    return {name: summaries(row, result, ALL) for name, row in result.methods.items()}


@dataclass(frozen=True, kw_only=True)
class Claim:
    """`best` is better than `other` by `metric` on worlds of `kind`: rows of the study, without
    their seeds."""

    kind: str
    metric: str
    best: str
    other: str

    @property
    def question(self) -> str | None:
        """The question that it helps to answer, for claims that `proposed` is best."""
        asked = (name for name, (_, metrics) in QUESTIONS.items() if self.metric in metrics)
        return next(asked, None) if self.best == "proposed" else None


def claims() -> tuple[Claim, ...]:
    """The claims of all bold cells. Two methods with equal figures are both bold, and neither is
    better than the other."""
    found: list[Claim] = []
    for kinds in PAPER.values():
        for kind, rows in kinds.items():
            for metric in next(iter(rows.values())):
                losses = {name: _loss(metric, row[metric][0]) for name, row in rows.items()}
                least = min(losses.values())
                found += [
                    Claim(kind=kind, metric=metric, best=ROWS[best], other=ROWS[other])
                    for best, other in product(rows, rows)
                    if losses[best] == least < losses[other]
                ]
    return tuple(found)


def asked(measured: Sequence[DatasetResult]) -> dict[str, list[Json]]:
    """What is known of all claims, as `compared` tells it: the paper's ``claims``; what the study
    asks ``beside`` them; and ``paths``, those about paths again. The tables answer these by the
    paths that each method has, so that a method that has none in the tight trials has the better
    ones for it: here, on those trials where both of a pair have one."""
    beside = [
        Claim(kind=kind, metric=metric, best=best, other=other)
        for kind, (best, other), metric in product(PAPER["planning"], BESIDE_PAIRS, BESIDE_METRICS)
    ]
    paths = [claim for claim in claims() if claim.metric in QUESTIONS["Q3"][1]]
    parts = {"claims": claims(), "beside": beside, "paths": paths}
    return {
        part: [
            compared(claim, one, common=part == "paths")
            for claim in some
            for one in measured
            if one.kind == claim.kind
        ]
        for part, some in parts.items()
    }


def judged(study: Json) -> Json:
    """`study`, what ``study.json`` holds or will hold, with all verdicts, and the answers to the
    questions: from its ``runs``, its ``means``, and what `asked` found."""
    spreads = {
        (kind, metric): seed_variance(losses(rows, metric))
        for kind, rows in study["means"].items()
        for metric in ALL
    }
    long = [name for name, run in study["runs"].items() if waited(run) >= PATIENCE]
    parts = {name: decided(study[name], spreads, long) for name in ("claims", "beside", "paths")}
    return {**study, "verdicts": answers(parts["claims"]), **parts}


def compared(claim: Claim, measured: DatasetResult, *, common: bool = False) -> Json:
    """What is known of a claim, as JSON: what it says and its question; the difference of every
    pair of networks, rows named ``occ-s0``, one of each method, and of all of them, positive where
    the claim has it so; and the error of that over worlds, with its degrees of freedom. Means are
    over what each method has a value for, as in the tables; with `common`, over what both of a pair
    have one for."""
    rows = defaultdict[str, dict[int, str]](dict)  # by method and seed
    for row in measured.methods:
        method, seed = seeded(row)
        if seed is not None:
            rows[method][seed] = row
    best, other = rows[claim.best], rows[claim.other]
    pairs = {(i, j): (best[i], other[j]) for i, j in product(best, other)}
    gain_of = partial(gain, measured, claim.metric, common=common)
    overall = gain_of(list(pairs.values())) if pairs else None
    singles = {seeds: gain_of([pair]) for seeds, pair in pairs.items()}
    return {
        **vars(claim),
        "question": claim.question,
        "difference": overall and overall.value,
        "worlds_error": overall and overall.error,
        "worlds_freedom": overall and overall.freedom,
        "pairs": [
            {
                "best_seed": i,
                "other_seed": j,
                "difference": single.value,
                "low": single.ends[0],
                "high": single.ends[1],
            }
            for (i, j), single in singles.items()
        ],
    }


def decided(
    found: Sequence[Json],
    spreads: Mapping[tuple[str, str], tuple[float, int]],
    long: Collection[str],
) -> list[Json]:
    """What `compared` found, each with its interval over worlds and seeds, its probability by Holm,
    and its verdict.

    `spreads` are the variances of a seed and their degrees of freedom by kind and metric, and
    `long` the runs that trained for as long as the paper's early stopping asks. A claim is decided
    where chance in worlds and seeds has so large a difference with a probability of `LEVEL` at
    most, among all claims that can be decided. Nothing can be of one world, or of a method with one
    seed.
    """
    estimates = [_over_seeds(one, *spreads[one["kind"], one["metric"]]) for one in found]
    chances = {n: one.chance for n, one in enumerate(estimates) if one and one.chance is not None}
    adjusted = dict(zip(chances, holm(list(chances.values())).tolist(), strict=True))
    results = []
    for n, (claim, overall) in enumerate(zip(found, estimates, strict=True)):
        low, high = overall.ends if overall else (None, None)
        chance = adjusted.get(n)
        verdict = _verdict(claim, chance, long)
        results.append({**claim, "low": low, "high": high, "holm": chance, "verdict": verdict})
    return results


def _verdict(claim: Json, chance: float | None, long: Collection[str]) -> str:
    """What the networks say to a claim, whose difference has a probability of `chance` by Holm."""
    if chance is None or chance > LEVEL:
        return "undecided"
    if claim["difference"] > 0:
        return "confirmed"
    runs = {
        f"{claim[side]}-s{pair[f'{side}_seed']}"
        for pair in claim["pairs"]
        for side in ("best", "other")
    }
    return "refuted" if runs <= set(long) else "contradicted"


def _over_seeds(one: Json, variance: float, freedom: int) -> Estimate | None:
    """The difference with its error over worlds and seeds; None where that is unknown."""
    counts = [len({pair[side] for pair in one["pairs"]}) for side in ("best_seed", "other_seed")]
    if min(counts) < 2 or not freedom or None in (one["difference"], one["worlds_error"]):
        return None
    parts = (
        (one["worlds_error"] ** 2, one["worlds_freedom"]),
        (variance * sum(1 / count for count in counts), freedom),
    )
    total = sum(part for part, _ in parts)
    joined = total**2 / sum(part**2 / of for part, of in parts) if total else freedom
    return Estimate(value=one["difference"], error=total**0.5, freedom=joined)


def losses(means: Mapping[str, Json], metric: str) -> dict[str, float]:
    """The mean of every network that has a seed, as something to be small, from `means`
    or what a file holds of them: a file older than the metric holds none."""
    return {
        row: _loss(metric, figures[metric]["mean"])
        for row, figures in means.items()
        if seeded(row)[1] is not None and metric in figures and figures[metric]["n"]
    }


def seed_variance(found: Mapping[str, float]) -> tuple[float, int]:
    """The variance of a figure over training seeds, pooled over methods, and its degrees of
    freedom; `found` are the figures of rows named ``occ-s0``."""
    by_method: dict[str, list[float]] = {}
    for row, value in found.items():
        by_method.setdefault(seeded(row)[0], []).append(value)
    freedom = sum(len(values) - 1 for values in by_method.values())
    squares = sum(float(np.var(values)) * len(values) for values in by_method.values())
    return (squares / freedom if freedom else math.nan), freedom


def waited(run: Json) -> float:
    """For how many epochs a run went on after the lowest loss in validation."""
    best = min(run["curve"], key=lambda row: row["val_loss"])
    return float((run["curve"][-1]["maps"] - best["maps"]) / run["samples"])


def seeded(row: str) -> tuple[str, int | None]:
    """The method and the seed of a row named ``occ-s0``; no seed where it has another name, as
    ``occ-short``."""
    name, _, seed = row.rpartition("-s")
    return (name, int(seed)) if name and seed.isdecimal() else (row, None)


def answers(found: Sequence[Json]) -> dict[str, Json]:
    """What `judged` claims, of all kinds, say to each question: how many are confirmed, refuted and
    undecided, and the verdict on which all of them agree, or else "undecided"."""
    answered = {}
    for question, (asks, _) in QUESTIONS.items():
        said = Counter(claim["verdict"] for claim in found if claim["question"] == question)
        agreed = next(iter(said)) if len(said) == 1 else "undecided"
        answered[question] = {"asks": asks, "verdict": agreed, "claims": dict(said)}
    return answered


def _loss(metric: str, value: Any) -> Any:
    """What is the smaller the better."""
    better = ALL[metric].better
    return -value if better == "higher" else value if better == "lower" else np.abs(value)


def gain(
    measured: DatasetResult, metric: str, pairs: Sequence[tuple[str, str]], *, common: bool = False
) -> Estimate:
    """By how much the first of each of `pairs` of rows is better than the second, in the mean of
    all pairs: each by its own values, as in the tables, or, with `common`, by what both have a
    value for."""
    values = np.array([[measured.methods[row].values(metric) for row in pair] for pair in pairs])
    held = np.isfinite(values)
    if common:
        held &= held.all(axis=1, keepdims=True)
    sums = np.stack([np.where(held, values, 0.0), held]).reshape(-1, values.shape[-1]).T

    def of(sums: Floats) -> Floats:
        total, count = np.moveaxis(sums.reshape(len(sums), 2, len(pairs), 2), 1, 0)
        with np.errstate(invalid="ignore"):  # worlds without a path say nothing
            lost = _loss(metric, total / count)
        return (lost[..., 1] - lost[..., 0]).mean(axis=1)

    return estimate(sums, measured.worlds_of(metric), of)


TABLES = {
    "claims": "the paper's claims",
    "paths": "claims about paths, over trials where both methods have a path",
}
"""Parts of a study that stand in its file of claims, and what each is called there."""


def to_csv(study: Json) -> str:
    """Every claim that was tested, as CSV: its verdict, the mean difference over seeds (positive if
    the claim is right) and its 95 % interval over worlds and seeds."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("table", "kind", "claim", "verdict", "difference", "low", "high"))
    for part, title in TABLES.items():
        for claim in study[part]:
            if claim["pairs"]:
                name = f"{ALL[claim['metric']].label}: {claim['best']} beats {claim['other']}"
                values = (
                    "" if claim[key] is None else f"{claim[key]:+.3f}"
                    for key in ("difference", "low", "high")
                )
                writer.writerow((title, claim["kind"], name, claim["verdict"], *values))
    return text.getvalue()
