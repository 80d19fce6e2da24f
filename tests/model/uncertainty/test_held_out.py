"""What the bundled network promises, on worlds that neither training nor calibration saw."""

import numpy as np

import scenegen
from scenegen.model.bench.visibility import UNOBSERVED, classify
from scenegen.model.completion.completer import Completer


def negative_log_likelihood(probability, occupied):
    right = np.where(occupied, probability, 1 - probability.astype(float))
    return -np.log(np.maximum(right, 1e-7)).mean()


def test_the_bundled_network_is_better_calibrated_on_new_worlds():
    """Calibrated probabilities of unknown voxels are likelier than predicted ones, and right in
    the mean."""
    completer, predicted, calibrated, occupied = Completer.from_pretrained(), [], [], []
    for kind in ("pillar", "geometric"):
        stream = scenegen.stream(kind, seed=7, split="test")
        for index in range(0, 60, 10):  # one sample a world
            sample = stream[index]
            unknown = np.isin(classify(sample, lidar=stream.lidar, grid=stream.grid), UNOBSERVED)
            prediction = completer(sample)
            predicted.append(prediction.occupancy_probability[unknown])
            calibrated.append(prediction.probability[unknown])
            occupied.append(sample.occupancy[unknown])
    predicted, calibrated, occupied = map(np.concatenate, (predicted, calibrated, occupied))
    better = negative_log_likelihood(calibrated, occupied)
    assert better < 0.8 * negative_log_likelihood(predicted, occupied)
    assert abs(calibrated.mean() - occupied.mean()) < 0.02
