"""Laws of a unit's samples: what was seen is there, and what was drawn once is drawn again."""

import dataclasses
import json
from collections import Counter

import numpy as np
from scipy.spatial.distance import pdist

from tests.conftest import picky_recipe, small_recipe
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.conftest import drawn_unit, same


def test_a_unit_depends_on_its_numbers_alone(drawn):
    recipe, _ = drawn
    alone = drawn_unit(recipe, 3)
    others = [drawn_unit(recipe, unit) for unit in (5, 0, 4)]
    again = drawn_unit(recipe, 3)
    assert alone.world.mjcf == again.world.mjcf
    assert all(map(same, alone.samples, again.samples))
    others += drawn_unit(recipe, 3, seed=1), drawn_unit(recipe, 3, split="val")
    for other in others:
        assert not any(map(same, alone.samples, other.samples))
        assert alone.world.mjcf != other.world.mjcf


def test_viewpoints_are_level_apart_and_clear_of_solids(drawn):
    recipe, _ = drawn
    for unit in range(3):
        drawn = drawn_unit(recipe, unit)
        positions = np.array([sample.position for sample in drawn.samples])
        assert pdist(positions).min() >= recipe.flight.spacing_m
        low, high = drawn.world.flight_bounds
        assert ((positions >= low) & (positions <= high)).all()
        for sample in drawn.samples:
            assert sample.quaternion[1] == sample.quaternion[2] == 0
            clear = drawn.world.clearance.at(*sample.position)  # which test_clearance proves
            assert clear >= recipe.flight.robot_radius_m - 2e-3


def test_rejected_worlds_and_viewpoints_are_counted_by_reason():
    recipe = picky_recipe()
    rejected = Counter()
    for number in range(12):
        unit = drawn_unit(recipe, number)
        rejected += sum(unit.rejected.values(), Counter())
        for sample in unit.samples:
            assert sample.occupancy.mean() >= recipe.accept.min_occupied_share
            assert np.isfinite(sample.ranges).mean() >= recipe.accept.min_returned_share
    assert rejected["few_solids"] > 0
    assert rejected["few_occupied"] + rejected["few_returns"] > 0


@each_case("draw", "tables")
def test_impossible_parameters_end_and_are_named(tables):
    recipe = small_recipe(**json.loads(tables))
    accept = dataclasses.replace(recipe.accept, max_draws=4)
    refuses(tables, drawn_unit, dataclasses.replace(recipe, accept=accept))
