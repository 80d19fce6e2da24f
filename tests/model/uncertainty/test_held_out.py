"""What the bundled network promises, kept on worlds that neither training nor calibration saw."""

import numpy as np

import scenegen
from scenegen.model.completion.completer import Completer
from scenegen.model.evaluation.visibility import UNOBSERVED, classify


def test_the_bundled_network_keeps_its_bounds_on_new_worlds():
    """Of unknown voxels, as many as are promised, in the mean over worlds of both kinds; and bounds
    that are worth something: predicted distances would be too great far more often."""
    completer, kept, naive = Completer.from_pretrained(), [], []
    for kind in ("pillar", "geometric"):
        stream = scenegen.stream(kind, seed=7, split="test")
        for index in range(0, 60, 10):  # one sample a world
            sample = stream[index]
            unknown = np.isin(classify(sample, lidar=stream.lidar, grid=stream.grid), UNOBSERVED)
            prediction = completer(sample)
            kept.append((sample.tudf >= prediction.tudf_low)[unknown].mean())
            naive.append((sample.tudf >= prediction.tudf)[unknown].mean())
    assert np.mean(kept) >= 0.95
    assert np.mean(naive) < 0.8
