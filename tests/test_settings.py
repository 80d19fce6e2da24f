"""Settings that make no sense are refused by name; how, tests/lidarsim/test_parameters.py says."""

import json
import math

import pytest

from lidarsim import Fusion, GridSpec, Lidar
from scenegen.model.config import LossConfig, NetworkConfig, PlanConfig, TrainConfig
from tests.refusals import refuses
from tests.scenegen import each_case

KINDS = (GridSpec, Lidar, Fusion, NetworkConfig, TrainConfig, LossConfig, PlanConfig)
KINDS = {kind.__name__: kind for kind in KINDS}


@each_case("../settings", "kind name value")
def test_a_setting_that_makes_no_sense_is_refused_by_name(kind, name, value):
    line = refuses(f"{kind} {name} {value}", KINDS[kind], **{name: json.loads(value)})
    assert f"{name} " in line


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_no_weight_of_a_loss_is_negative_or_endless(value):
    for name in LossConfig.__dataclass_fields__.keys() - {"objective"}:
        line = refuses(f"{name} {value}", LossConfig, **{name: value})
        assert line.startswith(f"{name} = ")
