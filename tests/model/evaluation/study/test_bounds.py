"""Sparsification against a slow reference, and bounds that hold, or do not."""

import numpy as np
import pytest

from scenegen.model.calibration import Given
from scenegen.model.completion.protocol import Prediction
from scenegen.model.evaluation.study.calibration import PARTS, SHARES, ause, judge_bounds


def test_sparsification() -> None:
    rng = np.random.default_rng(0)
    error = rng.random(400)
    assert ause(error, error) == pytest.approx(0, abs=1e-9)
    assert ause(error, -error) > ause(error, rng.random(400)) > 0.2
    doubt = rng.random(400)
    shares = [
        np.mean(error[np.argsort(doubt)][: int(s * 400)]) - np.mean(np.sort(error)[: int(s * 400)])
        for s in SHARES
    ]
    assert ause(error, doubt) == pytest.approx(np.mean(shares) / error.mean())
    flat = [error.mean() - np.mean(np.sort(error)[: int(s * 400)]) for s in SHARES]
    assert ause(error, np.ones(400)) == pytest.approx(np.mean(flat) / error.mean()), (
        "equal doubt orders nothing"
    )
    assert ause(np.zeros(4), np.arange(4)) == 0


def test_coverage_and_width_are_counted_by_region() -> None:
    shape, rng = (6, 6, 6), np.random.default_rng(0)
    true, distance = 2 * rng.random(shape, np.float32), 2 * rng.random(shape, np.float32)
    low = (distance * rng.random(shape, np.float32)).astype(np.float32)
    bits = rng.integers(0, 32, shape).astype(np.uint8)  # none of the last region
    said = Prediction(tudf=distance, uncertainty=Given(tudf_low=low, risk=0.1))
    found, _ = judge_bounds(said, distance, true, bits)
    for p in range(len(PARTS) - 1):
        inside = (bits >> (p + 1) & 1).astype(bool)
        assert found[0, p, 0] == pytest.approx((true >= low)[inside].mean())
        assert found[0, p, 1] == pytest.approx((distance - low)[inside].mean(), rel=1e-5)
    assert np.isnan(found[0, -1]).all()
