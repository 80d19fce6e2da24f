"""What a calibration says of a prediction, what it refuses to say, and what a file may claim."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import GridSpec
from scenegen.model.calibration import (
    KEY,
    Calibration,
    StoredProbability,
    corrected,
    corrected_logit,
)
from scenegen.model.completion.protocol import Prediction, PredictionError, check_prediction
from tests.refusals import refuses

GRID = GridSpec(shape=(8, 8, 8))
PLAIN = Calibration(worlds=30, class_weight=5.0, temperature=2.0)


def said():
    rng = np.random.default_rng(0)
    probability, tudf = rng.random(GRID.shape, np.float32), 2 * rng.random(GRID.shape, np.float32)
    return Prediction(probability, tudf, calibration=PLAIN)


@pytest.mark.parametrize("weight", [0.2, 5.0])
def test_the_class_weight_is_inverted(weight):
    """What minimises the weighted cross-entropy of a voxel that is occupied with chance q, found
    without the formula, comes back as q."""
    p = np.linspace(0.0005, 0.9995, 2000)
    for q in (0.03, 0.4, 0.9):
        loss = -(weight * q * np.log(p) + (1 - q) * np.log(1 - p))
        least = np.array([p[loss.argmin()]], np.float32)
        assert corrected(least, weight)[0] == pytest.approx(q, abs=0.01)
        logit = corrected_logit(least, weight)
        assert 1 / (1 + np.exp(-logit)) == pytest.approx(corrected(least, weight), rel=1e-3)
    assert corrected(np.array([0, 1], np.float32), weight).tolist() == [0, 1]


def test_a_network_that_denies_what_it_sees_is_away_from_home():
    """Against counting, map by map; where nothing was seen, nothing is denied."""
    rng, home = np.random.default_rng(1), (0.3, 0.8, 0.85, 1.0)
    probability, seen = rng.random((3, *GRID.shape), np.float32), rng.random((3, *GRID.shape)) < 0.2
    seen[2] = False
    denied = [(corrected(probability[n][seen[n]], 5) <= 0.5).mean() for n in range(2)]
    told = dataclasses.replace(PLAIN, denied=home)

    def away(probability):
        return Prediction(probability, calibration=told, observed=seen).away.tolist()

    assert away(probability) == [sum(level < one for level in home) / 4 for one in denied] + [0]
    assert (away(seen.astype(np.float32)), away(1.0 - seen)) == ([0, 0, 0], [0.75, 0.75, 0])
    assert said().away is None


def test_sureness_learned_at_home_fades_away_from_it():
    """Maps that deny nothing, a quarter and nearly all of their returns, by logits: the temperature
    of home, its root, and none."""
    seen = np.full((3, *GRID.shape), True)
    probability = np.full(seen.shape, 0.99, np.float32)
    probability[1, ..., :2], probability[2, ..., :7] = 0.01, 0.01
    told = dataclasses.replace(PLAIN, denied=(0, *[0.1] * 6, 0.5, 0.6, 1))
    said = Prediction(probability, calibration=told, observed=seen)
    assert said.away.tolist() == [0, 0.7, 0.9]
    logits = corrected_logit(probability, 5) / np.reshape([2, 2**0.5, 1], (3, 1, 1, 1))
    assert_allclose(corrected_logit(said.probability, 1), logits, rtol=1e-3)


def test_probabilities_are_calibrated_voxel_by_voxel():
    prediction = said()
    for index in np.ndindex(GRID.shape):
        p = float(prediction.occupancy_probability[index])
        q = p / (p + 5 * (1 - p))
        expected = 1 / (1 + ((1 - q) / q) ** 0.5)
        assert prediction.probability[index] == pytest.approx(expected, abs=1e-4)


def test_torch_for_torch_and_a_batch_for_a_batch():
    one = said()
    arrays = [np.stack([one.occupancy_probability] * 2), np.stack([one.tudf] * 2)]
    both = Prediction(*map(torch.from_numpy, arrays), calibration=PLAIN)
    assert isinstance(both.probability, torch.Tensor)
    assert_array_equal(both.probability[0].numpy(), one.probability)


def test_without_a_calibration_there_is_no_probability():
    assert Prediction(np.zeros(GRID.shape, np.float32)).probability is None
    assert Prediction(tudf=np.zeros(GRID.shape, np.float32), calibration=PLAIN).probability is None


def test_stored_probabilities_are_checked():
    values = np.zeros(GRID.shape, np.float32)
    for bad in (values + 2, values - 1, values[0], values * np.nan):
        stored = Prediction(values, calibration=StoredProbability(probability=bad))
        refuses(bad.flat[0], check_prediction, stored, GRID.shape, "mine", error=PredictionError)


def test_a_header_holds_it_whole():
    told = json.loads(json.dumps({KEY: dataclasses.asdict(PLAIN)}))
    assert Calibration.of(told) == PLAIN
    assert Calibration.of({}) is None
    refuses("three", Calibration.of, {KEY: 3})


def test_a_header_of_earlier_versions_is_read():
    """Its bounds of distance are ignored; one of distances alone calibrates nothing."""
    older = dataclasses.asdict(PLAIN) | {"risks": [0.2], "margins": [[0.1, 0.2]], "step_m": 0.1}
    assert Calibration.of({KEY: older}) == PLAIN
    assert Calibration.of({KEY: older | {"temperature": None}}) is None


@pytest.mark.parametrize(
    "change",
    [
        {"temperature": float("nan")},
        {"worlds": "many"},
        {"class_weight": 0},
        {"temperature": -1.0},
        {"denied": [[0.5]]},
    ],
    ids=str,
)
def test_a_strangers_calibration_that_cannot_be_is_refused(change):
    refuses(change, Calibration.of, {KEY: dataclasses.asdict(PLAIN) | change})
