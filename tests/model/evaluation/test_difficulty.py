"""Descriptors on maps whose answer is plain."""

import dataclasses

import numpy as np
import pytest

from lidarsim import GridSpec
from scenegen.draw import draw_unit
from scenegen.model.evaluation.config import PlanConfig
from scenegen.model.evaluation.visibility import DESCRIPTORS, describe
from scenegen.sample import Sample
from scenegen.source import DrawnWorlds
from scenegen.truth import distance_field
from tests.conftest import small_recipe

GRID = GridSpec(shape=(24, 24, 12))


def described(occupancy: np.ndarray, observed: np.ndarray | None = None) -> dict[str, float]:
    recipe = small_recipe()
    some = draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="train", unit=0).samples[0]
    sample: Sample = dataclasses.replace(
        some,
        occupancy=occupancy,
        observed=np.zeros_like(occupancy) if observed is None else observed,
        tudf=distance_field(occupancy, GRID),
    )
    return dict(zip(DESCRIPTORS, describe(sample, grid=GRID, config=PlanConfig()), strict=True))


def test_a_corridor_is_as_wide_as_it_is() -> None:
    occupancy = np.zeros(GRID.shape, bool)
    occupancy[:, 8], occupancy[:, 16] = True, True
    assert described(occupancy)["gap_m"] == pytest.approx(1.6)


def test_what_a_wall_cuts_off_cannot_be_reached() -> None:
    occupancy = np.zeros(GRID.shape, bool)
    assert described(occupancy)["traversable"] == 1.0
    occupancy[18] = True  # a plane of nodes, and those behind it
    assert described(occupancy)["traversable"] == pytest.approx(6 / 8)
    occupancy[:] = True
    assert described(occupancy)["traversable"] == 0.0


def test_hidden_is_what_holds_no_return() -> None:
    occupancy = np.zeros(GRID.shape, bool)
    occupancy[2, 2, :8] = True
    observed = occupancy.copy()
    observed[2, 2, 2:] = False
    assert described(occupancy, observed)["hidden"] == 0.75
    assert np.isnan(described(np.zeros(GRID.shape, bool))["hidden"])
