"""IoU at every threshold at once is IoU at each of them."""

import numpy as np
import pytest

from lidarsim.grid import iou
from scenegen.model.bench.methods import CANDIDATES, best_of, ious_by_threshold
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds

SHAPE = (12, 11, 10)


@pytest.mark.parametrize(("name", "part"), [
    ("probability", "occupancy_probability"), ("distance_m", "tudf"),
])  # fmt: skip
def test_ious_are_those_of_the_masks_at_each_threshold(rng, name, part):
    values = rng.uniform(0, 1, SHAPE).astype(np.float32)
    edges = CANDIDATES[name].astype(np.float32)
    values[:6] = rng.choice(edges, (6, *SHAPE[1:]))  # just at a threshold
    prediction = Prediction(**{part: values})
    truth, scored = rng.random((2, *SHAPE)) < [[[[0.3]]], [[[0.7]]]]
    expected = [
        iou(prediction.occupied(Thresholds(**{name: at}))[scored], truth[scored])
        for at in CANDIDATES[name].tolist()
    ]
    found = ious_by_threshold(prediction, truth, scored)
    assert found.tolist() == expected
    for kind in (bool, np.float16):
        other = Prediction(**{part: values.astype(kind)})
        usual = Thresholds()
        at = CANDIDATES[name].tolist().index(getattr(usual, name))
        reached = ious_by_threshold(other, truth, scored)[at]
        assert reached == iou(other.occupied(usual)[scored], truth[scored])
    assert len(set(expected)) > 10
    best = best_of(name, found, Thresholds())
    assert iou(prediction.occupied(best)[scored], truth[scored]) == max(expected)


def test_an_empty_map_of_nothing_scores_one_and_keeps_the_usual_threshold():
    nothing = np.zeros(SHAPE, bool)
    prediction = Prediction(occupancy_probability=np.zeros(SHAPE, np.float32))
    found = ious_by_threshold(prediction, nothing, ~nothing)
    assert (found == 1).all()
    assert best_of("probability", found, Thresholds()) == Thresholds()
