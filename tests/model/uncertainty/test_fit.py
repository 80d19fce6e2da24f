"""The fit of a temperature, on logits whose temperature is known."""

import numpy as np
import pytest

from scenegen.model.bench.calibrate import count_logits, fit_temperature


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
    chance, true = rng.random((2, 3000), np.float32)
    unknown = rng.random(3000) < 0.3
    assert count_logits(chance, true > 0.5, unknown, 5.0).sum() == unknown.sum()
