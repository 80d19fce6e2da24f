"""The objective is the weighted sum of its parts, with the paper's weights."""

import dataclasses

import pytest

torch = pytest.importorskip("torch")

from lidarsim import GridSpec  # noqa: E402
from scenegen.model.config import LossConfig  # noqa: E402
from scenegen.model.losses import Coupled  # noqa: E402
from scenegen.model.network import Output  # noqa: E402
from tests.model.test_losses import (  # noqa: E402
    SPACES,
    cross_entropy,
    eikonal,
    lovasz_hinge,
    random_case,
    value,
    weighted_smooth_l1,
)

# The objective and its weights.

CONFIGS = [
    LossConfig(),
    LossConfig(
        **{"occupancy": 0.3, "tudf": 0.7, "eikonal": 0.9, "lovasz": 0.6, "occupied_weight": 3},
        **{"near_weight": 4, "near_m": 0.8, "beta_m": 0.2},
    ),
    LossConfig(tudf=5.0, eikonal=0.0),
]


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("heads", ["both", "logits", "tudf"])
def test_the_objective_is_the_weighted_sum(config, heads):
    """L = l_occ L_occ + l_tudf (L_reg + l_eik L_eik), of what the output has."""
    voxel_m, truncation_m = SPACES[1]
    logits, occupancy, predicted, tudf = random_case(11, voxel_m=voxel_m, truncation_m=truncation_m)
    output = Output(
        logits=None if heads == "tudf" else torch.from_numpy(logits),
        tudf=None if heads == "logits" else torch.from_numpy(predicted),
    )
    wanted, loss = {}, 0.0
    if output.logits is not None:
        wanted["occupancy"] = cross_entropy(logits, occupancy, config.occupied_weight)
        if config.lovasz:
            wanted["lovasz"] = lovasz_hinge(logits, occupancy)
        loss += config.occupancy * (wanted["occupancy"] + config.lovasz * wanted.get("lovasz", 0))
    if output.tudf is not None:
        near = (config.near_m, config.near_weight, config.beta_m)
        wanted["regression"] = weighted_smooth_l1(predicted, tudf, *near)
        if config.eikonal:
            wanted["eikonal"] = eikonal(predicted, tudf, voxel_m, truncation_m)
        slope = config.eikonal * wanted.get("eikonal", 0)
        loss += config.tudf * (wanted["regression"] + slope)
    batch = {"occupancy": torch.from_numpy(occupancy), "tudf": torch.from_numpy(tudf)}
    found = Coupled(config, GridSpec(voxel_m=voxel_m, truncation_m=truncation_m))(output, batch)
    assert {name: value(part) for name, part in found.items()} == pytest.approx(
        {**wanted, "loss": loss}, rel=1e-6
    )


def test_the_default_weights_are_the_papers():
    wanted = {
        "occupancy": 0.1,
        "tudf": 1.0,
        "eikonal": 0.05,
        "occupied_weight": 5,
        "near_weight": 2,
        "near_m": 0.5,
    }
    assert dataclasses.asdict(LossConfig()) == {
        **wanted,
        "beta_m": 1.0,
        "lovasz": 0.0,
        "objective": "coupled",
    }
