"""What a calibration says of a prediction, what it refuses to say, and what a file may claim."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from scenegen.model.calibration import (
    KEY,
    Calibration,
    StoredProbability,
    corrected,
    corrected_logit,
)
from scenegen.model.completion.protocol import Prediction, check_prediction
from tests.refusals import refuses
from tests.scenegen import each_case

SHAPE = (8, 8, 8)
PLAIN = Calibration(worlds=30, class_weight=5.0, temperature=2.0)


@pytest.mark.parametrize("weight", [0.2, 5.0])
def test_the_class_weight_is_inverted(weight):
    """What minimises the weighted cross-entropy of a voxel that is occupied with chance q comes
    back as q."""
    q = np.linspace(0.0, 1.0, 11)
    best = (weight * q / (weight * q + 1 - q)).astype(np.float32)
    assert_allclose(corrected(best, weight), q, atol=1e-6)
    logits = corrected_logit(best, weight)
    assert_allclose(1 / (1 + np.exp(-logits)), q, atol=1e-5)
    assert np.isfinite(logits).all()


def test_networks_that_deny_returns_are_away(rng):
    """Against counting, map by map; where nothing was seen, nothing is denied."""
    home = dataclasses.replace(PLAIN, denied=(0.3, 0.8, 0.85, 1.0))
    probability, seen = rng.random((3, *SHAPE), np.float32), rng.random((3, *SHAPE)) < 0.2
    seen[2] = False
    denied = [(corrected(probability[n][seen[n]], 5) <= 0.5).mean() for n in range(2)]
    levels = [sum(level < share for level in home.denied) / 4 for share in denied]
    for maps, expected in (
        (probability, [*levels, 0]),
        (1.0 - seen, [0.75, 0.75, 0]),
    ):
        assert Prediction(maps, calibration=home, observed=seen).away.tolist() == expected
    assert Prediction(probability, calibration=PLAIN, observed=seen).away is None


def test_sureness_fades_away_from_home(rng):
    """Maps that deny nothing, a quarter and nearly all of their returns, by logits: the temperature
    of home, its root, and none."""
    probability = rng.uniform(0.9, 0.99, (3, *SHAPE)).astype(np.float32)
    probability[1, ..., :2], probability[2, ..., :7] = 0.01, 0.01
    home = dataclasses.replace(PLAIN, denied=(0, *[0.1] * 6, 0.5, 0.6, 1))
    seen = np.ones_like(probability, bool)
    prediction = Prediction(probability, calibration=home, observed=seen)
    assert prediction.away.tolist() == [0, 0.7, 0.9]
    logits = corrected_logit(probability, 5) / np.reshape([2, 2**0.5, 1], (3, 1, 1, 1))
    assert_allclose(corrected_logit(prediction.probability, 1), logits, rtol=1e-3)
    tensors = Prediction(*map(torch.from_numpy, [probability] * 2), calibration=PLAIN)
    assert isinstance(tensors.probability, torch.Tensor)
    assert_array_equal(tensors.probability[0], prediction.probability[0])


def test_probabilities_need_calibration_and_occupancy():
    zeros = np.zeros(SHAPE, np.float32)
    assert Prediction(zeros).probability is None
    assert Prediction(tudf=zeros, calibration=PLAIN).probability is None


@pytest.mark.parametrize("bad", [2, -1, np.nan, np.zeros(3)], ids=str)
def test_stored_probabilities_are_checked(bad):
    zeros = np.zeros(SHAPE, np.float32)
    probability = bad if np.ndim(bad) else zeros + bad
    stored = Prediction(zeros, calibration=StoredProbability(probability=probability))
    refuses(bad, check_prediction, stored, SHAPE, "mine")


HEADER = json.loads(json.dumps(dataclasses.asdict(PLAIN)))


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ({KEY: HEADER}, PLAIN),
        ({}, None),
        # of earlier versions, with bounds of distance, which alone calibrate nothing
        ({KEY: HEADER | {"risks": [0.2], "margins": [[0.1, 0.2]], "step_m": 0.1}}, PLAIN),
        ({KEY: HEADER | {"risks": [0.2], "temperature": None}}, None),
    ],
)
def test_headers_hold_calibrations(header, expected):
    assert Calibration.of(header) == expected


@each_case("../model/calibrations", "change")
def test_impossible_calibrations_are_refused(change):
    entry = json.loads(change)
    refuses(change, Calibration.of, {KEY: HEADER | entry if isinstance(entry, dict) else entry})
