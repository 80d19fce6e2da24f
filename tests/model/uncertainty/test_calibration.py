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
    Given,
    UncertaintyError,
    corrected,
    corrected_logit,
)
from scenegen.model.completion.protocol import Prediction, PredictionError, check_prediction

GRID = GridSpec(shape=(8, 8, 8))
PLAIN = Calibration(
    worlds=30,
    class_weight=5.0,
    temperature=2.0,
    step_m=1.0,
    chances=(0.5,),
    risks=(0.2, 0.05),
    margins=((0.1, 0.2, 0.3, 0.4, 0.5, 0.6), (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)),
)
"""Bins of distance: below 1 m, below 2 m, and 2 m."""


def said():
    rng = np.random.default_rng(0)
    probability, tudf = rng.random(GRID.shape, np.float32), 2 * rng.random(GRID.shape, np.float32)
    return Prediction(probability, tudf, uncertainty=PLAIN, grid=GRID)


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
        return Prediction(probability, uncertainty=told, observed=seen).away.tolist()

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
    said = Prediction(probability, uncertainty=told, observed=seen)
    assert said.away.tolist() == [0, 0.7, 0.9]
    logits = corrected_logit(probability, 5) / np.reshape([2, 2**0.5, 1], (3, 1, 1, 1))
    assert_allclose(corrected_logit(said.probability, 1), logits, rtol=1e-3)


def test_a_prediction_is_read_voxel_by_voxel():
    """Against the table, one voxel after the other."""
    found = said()
    low, chance = found.low(0.06), found.probability
    for index in np.ndindex(GRID.shape):
        p, d = float(found.occupancy_probability[index]), float(found.tudf[index])
        q = p / (p + 5 * (1 - p))
        margin = PLAIN.margins[1][2 * int(d >= 1) + int(q > 0.5)]
        assert low[index] == pytest.approx(max(d - margin, 0), abs=1e-5)
        assert chance[index] == pytest.approx(1 / (1 + ((1 - q) / q) ** 0.5), abs=1e-4)
    assert_array_equal(found.tudf_low, low)
    assert (found.low(0.2) >= low).all()


def test_torch_for_torch_and_a_batch_for_a_batch():
    one = said()
    arrays = [np.stack([one.occupancy_probability] * 2), np.stack([one.tudf] * 2)]
    both = Prediction(*map(torch.from_numpy, arrays), uncertainty=PLAIN, grid=GRID)
    assert isinstance(both.tudf_low, torch.Tensor)
    assert_array_equal(both.low(0.2)[1].numpy(), one.low(0.2))
    assert_array_equal(both.probability[0].numpy(), one.probability)
    alone = Prediction(arrays[0], uncertainty=PLAIN, grid=GRID)  # distances are those of its map
    assert alone.low(0.2).shape == arrays[0].shape


def test_what_nobody_knows_is_refused_in_a_line():
    bare = Prediction(np.zeros(GRID.shape, np.float32))
    assert (bare.probability, bare.tudf_low) == (None, None)
    with pytest.raises(UncertaintyError, match="not calibrated; run `scenegen calibrate`"):
        bare.low(0.05)
    for risk, told in (
        (0.01, "30 validation worlds give down to 0.05"),
        (0, "between 0 and 1"),
        (1.5, "between"),
    ):
        with pytest.raises(UncertaintyError, match=told):
            said().low(risk)
    given = Prediction(
        np.zeros(GRID.shape, np.float32), uncertainty=Given(tudf_low=np.zeros(GRID.shape), risk=0.1)
    )
    assert given.low(0.2) is given.low(0.1)
    with pytest.raises(UncertaintyError, match=r"those of a risk of 0\.1"):
        given.low(0.05)


def test_bounds_that_somebody_gives_are_checked():
    values = np.zeros(GRID.shape, np.float32)
    for bad in ({"tudf_low": values - 1}, {"probability": values + 2}, {"tudf_low": values[0]}):
        with pytest.raises(PredictionError, match=next(iter(bad))):
            check_prediction(Prediction(values, uncertainty=Given(**bad)), GRID.shape, "mine")


def test_a_header_holds_it_whole():
    told = json.loads(json.dumps({KEY: dataclasses.asdict(PLAIN)}))
    assert Calibration.of(told, GRID) == PLAIN
    assert Calibration.of({}, GRID) is None
    with pytest.raises(ValueError, match="damaged"):
        Calibration.of({KEY: 3}, GRID)


@pytest.mark.parametrize(
    "change",
    [
        {"temperature": float("nan")},
        {"worlds": "many"},
        {"risks": [0.05, 0.2]},
        {"margins": [[0.1] * 6, [0.2] * 5]},
        {"margins": [[[1.0]] * 6] * 2},
        {"chances": [0.5] * 30_000},
        {"path_risks": [0.1]},
        {"unheard": 1},
    ],
    ids=str,
)
def test_a_strangers_calibration_that_cannot_be_is_refused(change):
    with pytest.raises(ValueError, match="calibrate it again"):
        Calibration.of({KEY: dataclasses.asdict(PLAIN) | change}, GRID)


def test_paths_are_planned_by_one_number():
    measured = dataclasses.replace(PLAIN, path_risks=(0.1, 0.04))
    assert [measured.for_paths(risk) for risk in (0.5, 0.1, 0.05, 0.04)] == [0.2, 0.2, 0.05, 0.05]
    for found, told in ((measured, r"promises down to 0\.04"), (PLAIN, "--trials 0")):
        with pytest.raises(UncertaintyError, match=told):
            found.for_paths(0.01)
