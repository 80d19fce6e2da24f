"""Laws of several scans in one map, and a slow reference for both rules."""

import math

import numpy as np
import pytest

from lidarsim import BeamTable, Fusion, GridSpec, Pose, Scan, fuse, voxelize
from tests.lidarsim.reference import unit

GRID = GridSpec(shape=(8, 7, 6), voxel_m=0.3)
ORIGIN = np.array([-1.2, -1.0, -0.9])


def random_scans(seed, count):
    """Scans of random rays from places near the grid's middle; a third of the rays returns
    nothing."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        rays = rng.normal(size=(40, 3))
        table = np.column_stack([unit(rays), np.zeros(40)])
        ranges = np.where(rng.random(40) < 0.33, np.inf, rng.uniform(0.1, 1.5, 40))
        ranges = ranges.astype(np.float32)
        pose = Pose.level(rng.uniform(-0.5, 0.5, 3), rng.uniform(-3, 3))
        found.append(Scan(ranges, pose, BeamTable(rays=table, max_range_m=2.0)))
    return found


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
def test_both_rules_are_those_of_a_slow_reference(rule):
    """By visibility, the order says nothing, and more scans only add."""
    odds = {name: math.log(p / (1 - p)) for name, p in vars(rule).items() if name != "fusion"}
    both = 0
    for seed in range(3):
        scans = random_scans(seed, 4)
        got = fuse(scans, GRID, ORIGIN, rule)
        seen = [voxelize(scan, GRID, ORIGIN) for scan in scans]
        for voxel in np.ndindex(*GRID.shape):
            hits = [bool(one.observed[voxel]) for one in seen]
            misses = [bool(one.free[voxel]) for one in seen]
            level = 0.0
            for hit, miss in zip(hits, misses, strict=True):
                level = min(level + odds["hit"], odds["most"]) if hit else level
                level = max(level + odds["miss"], odds["least"]) if miss else level
            observed = any(hits)
            if rule.fusion == "log-odds":
                tie = abs(level - odds["occupied"]) < 1e-9
                assert not (tie and any(hits + misses))  # nobody can tell
                observed = any(hits) and level > odds["occupied"]
            assert got.observed[voxel] == observed
            assert got.free[voxel] == (any(hits + misses) and not observed)
            both += any(hits) and any(misses)
    assert both > 25  # else hardly a voxel is hit by one scan and crossed by another
