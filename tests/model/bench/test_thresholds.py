"""IoU at every threshold at once is IoU at each of them."""

import numpy as np
import pytest

from lidarsim.grid import iou
from scenegen import Prediction
from scenegen.model.bench.methods import CANDIDATES, best_of, ious_by_threshold
from scenegen.model.config import Thresholds

SHAPE = (12, 11, 10)


@pytest.mark.parametrize(("name", "part"), [
    ("probability", "occupancy_probability"), ("distance_m", "tudf"),
])  # fmt: skip
def test_ious_are_those_of_the_masks_at_each_threshold(rng, name, part):
    values, candidates = rng.uniform(0, 1, SHAPE).astype(np.float32), CANDIDATES[name].tolist()
    values[:6] = rng.choice(CANDIDATES[name].astype(np.float32), (6, *SHAPE[1:]))  # just at one
    truth, scored = rng.random((2, *SHAPE)) < [[[[0.3]]], [[[0.7]]]]

    def iou_at(prediction, at):
        return iou(prediction.occupied(Thresholds(**{name: at}))[scored], truth[scored])

    prediction = Prediction(**{part: values})
    expected = [iou_at(prediction, at) for at in candidates]
    assert len(set(expected)) > 10
    actual = ious_by_threshold(prediction, truth, scored)
    assert actual.tolist() == expected
    usual = getattr(Thresholds(), name)
    for kind in (bool, np.float16):
        other = Prediction(**{part: values.astype(kind)})
        actual = ious_by_threshold(other, truth, scored)[candidates.index(usual)]
        assert actual == iou_at(other, usual)


def test_empty_maps_keep_the_usual_threshold():
    nothing = np.zeros(SHAPE, bool)
    ious = ious_by_threshold(Prediction(nothing.astype(np.float32)), nothing, ~nothing)
    assert (ious == 1).all()
    assert best_of("probability", ious, Thresholds()) == Thresholds()
