"""Laws of calibration, on worlds whose errors are known: of a world, and of its voxels."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import GridSpec
from scenegen.model.calibration import Calibration
from scenegen.model.evaluation.calibrate import (
    CHANCES,
    STEP_M,
    count_logits,
    count_scores,
    fit_margins,
    fit_temperature,
    near_bins,
    path_risks,
    shape,
)

GRID = GridSpec(shape=(8, 8, 8))
ALL = np.ones(3000, bool)


def world(rng):
    """Predicted and true distances of a world's voxels: all err together, near ones less; and some
    worlds are small."""
    count = int(rng.choice([300, 3000]))
    true = (2 * rng.random(count)).astype(np.float32)
    error = rng.normal(0, 0.2) + rng.normal(0, 0.1, count) * (0.3 + true)
    return np.clip(true + error, 0, 2).astype(np.float32), true


def bounds_of(counts, grid, *asked):
    """A calibration of nothing but bounds, by the scores of some worlds."""
    risks, margins = fit_margins(np.stack(counts), near_bins(grid, ()), *asked)
    plain = {"class_weight": 1, "temperature": None, "step_m": STEP_M, "chances": ()}
    return Calibration(worlds=len(counts), risks=risks, margins=margins, **plain)


def test_new_worlds_are_covered_as_promised_and_not_much_better(rng):
    """Over many calibrations: a mean of 20 x 40 worlds, each with the same word."""
    worlds, rows = 40, []
    for _ in range(20):
        known = (world(rng) for _ in range(worlds))
        scores = [count_scores(said, None, true, ALL[: len(said)], GRID) for said, true in known]
        found = bounds_of(scores, GRID)
        assert found.risks[-1] == 0.03  # 40 worlds promise no .975
        for said, true in (world(rng) for _ in range(40)):
            near = said < 1
            held = [true >= found.low(said, None, risk) - 1e-5 for risk in found.risks]
            rows.append([[one.mean(), one[near].mean(), one[~near].mean()] for one in held])
    covered = np.mean(rows, axis=0)
    promised = 1 - np.array(found.risks)
    assert (covered >= promised[:, None] - 0.012).all(), covered
    assert (covered.min(axis=1) <= promised + 0.1).all(), (
        "bounds that are safe because they say nothing"
    )
    assert (np.diff(covered[:, 0]) >= 0).all()


def test_a_bins_shape_is_its_quantile(rng):
    scores = rng.integers(0, 50, (4, 500))
    counts = np.stack([np.bincount(row, minlength=60) for row in scores])
    for risk in (0.5, 0.1, 0.01):
        expected = np.quantile(scores, 1 - risk, axis=1, method="inverted_cdf")
        assert_array_equal(shape(counts, risk), expected)
    assert shape(np.zeros((1, 60), int), 0.1).tolist() == [59]  # of an empty bin nothing is known


@pytest.mark.parametrize("temperature", [0.5, 2.5])
def test_the_temperature_is_found(temperature, rng):
    """Of one that is as sure again, or less, by a weight of 5; and of maps that have its root."""
    logit = rng.normal(-1, 2, 200_000)
    occupied = rng.random(len(logit)) < 1 / (1 + np.exp(-logit))
    said = (1 / (1 + np.exp(-(temperature * logit + np.log(5))))).astype(np.float32)
    counts = count_logits(said, occupied, np.ones(len(logit), bool), 5.0)
    assert counts.sum() == len(logit)
    for power in (1, 0.5):
        found = fit_temperature(counts[None], np.array([power])) ** power
        assert found == pytest.approx(temperature, rel=0.03)


def test_only_unknown_voxels_count(rng):
    said, chance, true = rng.random((3, 3000), np.float32)
    unknown = rng.random(3000) < 0.3
    assert count_scores(said, chance, true, unknown, GRID).sum() == unknown.sum()
    assert len(count_scores(said, chance, true, unknown, GRID)) == len(near_bins(GRID, CHANCES))
    assert count_logits(chance, true > 0.5, unknown, 5.0).sum() == unknown.sum()


def test_paths_of_new_worlds_collide_no_more_than_was_promised(rng):
    """Conformal risk control on losses that are not monotone; over many calibrations of 30
    worlds."""
    risks = np.linspace(0.6, 0.0, 12)

    def losses(count):
        chance = np.clip(
            risks + rng.normal(0, 0.15, (count, 1)) + rng.normal(0, 0.05, (count, 12)), 0, 1
        )
        return rng.binomial(4, chance) / 4

    asked, had = 0.2, []
    for _ in range(300):
        promised = np.array(path_risks(losses(30)))
        assert (np.diff(promised) <= 0).all()
        chosen = int((promised > asked).sum())
        had.append(losses(50)[:, chosen].mean() if chosen < len(risks) else 0.0)
    assert asked - 0.12 <= np.mean(had) <= asked + 0.01
    assert path_risks(np.zeros((9, 2))) == (0.1, 0.1)  # a new world may lose all
