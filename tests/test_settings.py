"""Settings that make no sense are refused by name; how, tests/lidarsim/test_parameters.py says."""

import dataclasses
import itertools
import math

import pytest

from lidarsim import Fusion, GridSpec, Lidar
from scenegen.model.config import LossConfig, NetworkConfig, PlanConfig, TrainConfig

WEIGHTS = {one.name for one in dataclasses.fields(LossConfig)} - {"objective"}
WRONG = {
    GridSpec: [
        *(("shape", (80, 0, 40)), ("shape", (80, 80.5, 40))),
        *(("voxel_m", 0.0), ("truncation_m", -1.0)),
    ],
    Lidar: [
        *(("rows", 0), ("columns", 0), ("vertical_fov_deg", 180.5), ("horizontal_fov_deg", 360.5)),
        *(("pitch_deg", 90.5), ("max_range_m", 0.0), ("mount", "gimbal")),
    ],
    Fusion: [
        *(("fusion", "average"), ("hit", 0.5), ("miss", 0.5), ("least", 0.6)),
        *(("most", math.nan), ("occupied", 0.4), ("occupied", 0.98)),
    ],
    NetworkConfig: [("variant", "both"), ("stem_stride", 3), ("heads", 5), ("width", 0)],
    TrainConfig: [
        *(("epochs", 0), ("batch", 10**9), ("lr", math.nan), ("lr", 0.0)),
        *(("clip", math.inf), ("warmup_share", 1.0)),
    ],
    LossConfig: [*itertools.product(WEIGHTS, (-0.1, math.nan, math.inf)), ("beta_m", 0.0)],
    PlanConfig: [
        *(("step_voxels", 0), ("iterations", -1), ("clearance_weight", math.inf)),
        ("field", "exact"),
    ],
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_setting_that_makes_no_sense_is_refused_by_name(kind):
    for name, value in WRONG[kind]:
        with pytest.raises(ValueError, match=rf"\b{name} (= |')"):
            kind(**{name: value})
