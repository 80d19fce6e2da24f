"""Closed forms, against arithmetic that needs none."""

import numpy as np
import pytest

from lidarsim import AnalyticEngine
from tests.lidarsim.engines.test_laws import model_of


def test_hits_where_arithmetic_says() -> None:
    ahead = np.array([[1.0, 0.0, 0.0]])
    for geom, distance in (
        ('type="sphere" size="1" pos="5 0 0"', 4.0),
        ('type="sphere" size="5" pos="5 3 0"', 1.0),
        ('type="box" size="1 2 3" pos="5 0 0"', 4.0),
        ('type="box" size="1 1 1" pos="5 0 0" euler="0 0 45"', 5 - 2**0.5),
        ('type="cylinder" size="1 4" pos="5 0.6 3.9"', 4.2),
        ('type="cylinder" size="2 0.5" pos="5 1 0" euler="0 90 0"', 4.5),
        ('type="capsule" size="1 2" pos="5 0 2.6"', 5 - 0.8),
        ('type="ellipsoid" size="2 1 1" pos="5 0.6 0"', 5 - 1.6),
        ('type="plane" size="0 0 1" pos="3 0 0" euler="0 -90 0"', 3.0),
        ('type="sphere" size="1" pos="-5 0 0"', np.inf),
        ('type="sphere" size="1" pos="12 0 0"', np.inf),
        ('type="plane" size="0 0 1" pos="-3 0 0" euler="0 -90 0"', np.inf),
        ('type="sphere" size="1" pos="5 0 0" rgba="1 1 1 0"', np.inf),
    ):
        found = AnalyticEngine.of(model_of(geom)).cast(np.zeros((1, 3)), ahead[None], 10.0)[0, 0]
        assert found == pytest.approx(distance, abs=1e-12), geom
