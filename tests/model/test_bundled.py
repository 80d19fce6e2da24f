"""What each bundled network promises, on worlds that neither training nor calibration saw: any
change of a layer, of an input or of what reads the files shows here."""

from functools import cache

import numpy as np
import pytest

import scenegen
from lidarsim.grid import iou
from scenegen import Completer
from scenegen.model.bench.visibility import UNOBSERVED, classify
from scenegen.model.config import Thresholds, bundled
from tests.scenegen import cases

FIGURES = {name: list(map(float, figures)) for name, *figures in cases("../model/bundled")}
"""IoU and mean error of distances in metres, of pillars and of geometric worlds."""


@cache
def held_out():
    """A sample of each kind, and the voxels of it that were not seen."""
    streams = [scenegen.stream(kind, seed=7, split="test") for kind in ("pillar", "geometric")]
    return [
        (one[0], np.isin(classify(one[0], lidar=one.lidar, grid=one.grid), UNOBSERVED))
        for one in streams
    ]


@pytest.mark.parametrize("name", bundled())
def test_a_bundled_network_completes_new_worlds_as_ever(name):
    completer, at, figures = Completer.from_pretrained(name), Thresholds(), []
    for sample, unseen in held_out():
        said = completer(sample)
        figures.append(iou(said.occupied(at), sample.occupancy))
        figures.append(np.abs(said.distance(at, completer.grid) - sample.tudf).mean())
        assert (said.probability is None) == (name == "tudf")
        if said.probability is not None:
            parts = np.array([said.occupancy_probability, said.probability], float)
            right = np.where(sample.occupancy, parts, 1 - parts)[:, unseen]
            raw, calibrated = -np.log(np.maximum(right, 1e-7)).mean(axis=1)
            assert calibrated < 0.9 * raw
    assert figures == pytest.approx(FIGURES[name], abs=0.005)
