"""Laws of several scans in one map, and a slow reference for both rules."""

import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import BeamTable, Fusion, GridSpec, Pose, Scan, fuse, voxelize
from tests.lidarsim.reference import unit

GRID = GridSpec(shape=(8, 7, 6), voxel_m=0.3)
ORIGIN = np.array([-1.2, -1.0, -0.9])


def random_scans(seed, count):
    """Scans of random rays from places near the grid's middle; a third of the rays returns
    nothing."""
    rng, scans = np.random.default_rng(seed), []
    for _ in range(count):
        table = np.pad(unit(rng.normal(size=(40, 3))), ((0, 0), (0, 1)))
        ranges = np.where(rng.random(40) < 0.33, np.inf, rng.uniform(0.1, 1.5, 40))
        pose = Pose.level(rng.uniform(-0.5, 0.5, 3), rng.uniform(-3, 3))
        scans.append(Scan(ranges.astype(np.float32), pose, BeamTable(rays=table, max_range_m=2.0)))
    return scans


def random_rule(rng):
    return Fusion(
        fusion="log-odds",
        hit=rng.uniform(0.51, 0.99),
        miss=rng.uniform(0.01, 0.49),
        least=rng.uniform(0.01, 0.49),
        most=rng.uniform(0.8, 0.99),
        occupied=rng.uniform(0.5, 0.79),
    )


RNG = np.random.default_rng(3)
BOUNDED = Fusion(fusion="log-odds", hit=0.95, miss=0.05, least=0.2, most=0.8, occupied=0.5)
"""A hit and a miss each reach a bound, from which the next one leads across."""
RULES = [Fusion(), Fusion(fusion="log-odds"), BOUNDED, *(random_rule(RNG) for _ in range(3))]


@pytest.mark.parametrize("rule", RULES)
def test_both_rules_are_those_of_a_reference(rule):
    """By visibility, the order says nothing, and more scans only add."""
    odds = {name: math.log(p / (1 - p)) for name, p in vars(rule).items() if name != "fusion"}
    both = 0
    for seed in range(3):
        scans = random_scans(seed, 4)
        fused = fuse(scans, GRID, ORIGIN, rule)
        seen = [voxelize(scan, GRID, ORIGIN) for scan in scans]
        hit, missed = (np.any([getattr(g, n) for g in seen], axis=0) for n in ("observed", "free"))
        level = np.zeros(GRID.shape)
        for grids in seen:
            raised = np.minimum(level + odds["hit"], odds["most"])
            level = np.where(grids.observed, raised, level)
            lowered = np.maximum(level + odds["miss"], odds["least"])
            level = np.where(grids.free, lowered, level)
        observed = hit
        if rule.fusion == "log-odds":
            # else nobody can tell
            assert (abs(level - odds["occupied"]) > 1e-9)[hit | missed].all()
            observed = hit & (level > odds["occupied"])
        assert_array_equal(fused.observed, observed)
        assert_array_equal(fused.free, (hit | missed) & ~observed)
        both += (hit & missed).sum()
    assert both > 25  # else hardly a voxel is hit by one scan and crossed by another
