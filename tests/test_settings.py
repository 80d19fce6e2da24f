"""Settings that make no sense are refused by name; how, tests/lidarsim/test_parameters.py says."""

import json
import math

import pytest

from lidarsim import Fusion, GridSpec, Lidar
from scenegen.model.config import LossConfig, NetworkConfig, PlanConfig, TrainConfig
from tests.command_line import rows
from tests.refusals import refuses

KINDS = (GridSpec, Lidar, Fusion, NetworkConfig, TrainConfig, LossConfig, PlanConfig)
KINDS = {kind.__name__: kind for kind in KINDS}
WRONG = """
GridSpec      → shape              → [80, 0, 40]
GridSpec      → shape              → [80, 80.5, 40]
GridSpec      → voxel_m            → 0.0
GridSpec      → truncation_m       → -1.0
Lidar         → rows               → 0
Lidar         → columns            → 0
Lidar         → vertical_fov_deg   → 180.5
Lidar         → horizontal_fov_deg → 360.5
Lidar         → pitch_deg          → 90.5
Lidar         → max_range_m        → 0.0
Lidar         → mount              → "gimbal"
Fusion        → fusion             → "average"
Fusion        → hit                → 0.5
Fusion        → miss               → 0.5
Fusion        → least              → 0.6
Fusion        → most               → NaN
Fusion        → occupied           → 0.4
Fusion        → occupied           → 0.98
NetworkConfig → variant            → "both"
NetworkConfig → heads              → 5
NetworkConfig → width              → 0
TrainConfig   → epochs             → 0
TrainConfig   → batch              → 1000000000
TrainConfig   → lr                 → NaN
TrainConfig   → lr                 → 0.0
TrainConfig   → clip               → Infinity
TrainConfig   → warmup_share       → 1.0
LossConfig    → beta_m             → 0.0
PlanConfig    → step_voxels        → 0
PlanConfig    → iterations         → -1
PlanConfig    → clearance_weight   → Infinity
PlanConfig    → field              → "exact"
"""


@pytest.mark.parametrize(("kind", "name", "value"), rows(WRONG))
def test_a_setting_that_makes_no_sense_is_refused_by_name(kind, name, value):
    line = refuses(f"{kind} {name} {value}", KINDS[kind], **{name: json.loads(value)})
    assert f"{name} " in line


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_no_weight_of_a_loss_is_negative_or_endless(value):
    for name in LossConfig.__dataclass_fields__.keys() - {"objective"}:
        line = refuses(f"{name} {value}", LossConfig, **{name: value})
        assert line.startswith(f"{name} = ")
