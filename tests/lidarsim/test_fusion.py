"""Laws of several scans in one map, and a slow reference for both rules."""

import itertools
import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import BeamTable, Fusion, GridSpec, Pose, Scan, fuse, voxelize

GRID = GridSpec(shape=(8, 7, 6), voxel_m=0.3)
ORIGIN = np.array([-1.2, -1.0, -0.9])


def random_scans(seed, count):
    """Scans of random rays from places near the grid's middle; a third of the rays returns
    nothing."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        rays = rng.normal(size=(40, 3))
        table = np.column_stack([rays / np.linalg.norm(rays, axis=1, keepdims=True), np.zeros(40)])
        ranges = np.where(rng.random(40) < 0.33, np.inf, rng.uniform(0.1, 1.5, 40)).astype(
            np.float32
        )
        pose = Pose.level(rng.uniform(-0.5, 0.5, 3), rng.uniform(-3, 3))
        found.append(Scan(ranges, pose, BeamTable(rays=table, max_range_m=2.0)))
    return found


def equal(one, other):
    return np.array_equal(one.observed, other.observed) and np.array_equal(one.free, other.free)


RULES = [
    Fusion(),
    Fusion(fusion="log-odds"),
    Fusion(fusion="log-odds", hit=0.6, miss=0.3, least=0.05, most=0.9, occupied=0.7),
]


@pytest.mark.parametrize("rule", RULES)
def test_both_rules_are_those_of_a_slow_reference(rule):
    odds = {name: math.log(p / (1 - p)) for name, p in vars(rule).items() if name != "fusion"}
    both = 0
    for seed in range(6):
        scans = random_scans(seed, 4)
        got = fuse(scans, GRID, ORIGIN, rule)
        seen = [voxelize(scan, GRID, ORIGIN) for scan in scans]
        for voxel in np.ndindex(*GRID.shape):
            hits, misses = (
                [bool(one.observed[voxel]) for one in seen],
                [bool(one.free[voxel]) for one in seen],
            )
            if rule.fusion == "visibility":
                observed = any(hits)
            else:
                level = 0.0
                for hit, miss in zip(hits, misses, strict=True):
                    level = min(level + odds["hit"], odds["most"]) if hit else level
                    level = max(level + odds["miss"], odds["least"]) if miss else level
                assert abs(level - odds["occupied"]) > 1e-9 or not any(hits + misses), (
                    "a tie: nobody can tell"
                )
                observed = any(hits) and level > odds["occupied"]
            assert got.observed[voxel] == observed
            assert got.free[voxel] == (any(hits + misses) and not observed)
            both += any(hits) and any(misses)
    assert both > 50, (
        "hardly a voxel is hit by one scan and crossed by another: the test shows nothing"
    )


def test_by_visibility_the_order_says_nothing_and_more_scans_only_add():
    scans = random_scans(2, 5)
    whole = fuse(scans, GRID, ORIGIN)
    for order in ((4, 3, 2, 1, 0), (2, 0, 4, 1, 3)):
        assert equal(fuse([scans[n] for n in order], GRID, ORIGIN), whole)
    grown = [fuse(scans[:count], GRID, ORIGIN) for count in range(1, 6)]
    for less, more in itertools.pairwise(grown):
        assert (less.observed <= more.observed).all()
        assert ((less.observed | less.free) <= (more.observed | more.free)).all()
        assert less.observed.sum() < more.observed.sum()


def test_only_what_returned_something_is_observed_whatever_the_parameters():
    rng, differing = np.random.default_rng(3), 0
    for seed in range(40):
        scans = random_scans(seed, 5)
        rule = Fusion(
            fusion="log-odds",
            hit=rng.uniform(0.51, 0.99),
            miss=rng.uniform(0.01, 0.49),
            least=rng.uniform(0.01, 0.49),
            most=rng.uniform(0.8, 0.99),
            occupied=rng.uniform(0.5, 0.79),
        )
        got, every = fuse(scans, GRID, ORIGIN, rule), fuse(scans, GRID, ORIGIN)
        assert (got.observed <= every.observed).all()
        assert_array_equal(got.observed | got.free, every.observed | every.free)
        assert not (got.observed & got.free).any()
        differing += not equal(got, every)
    assert differing > 10


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"fusion": "average"}, "fusion = 'average': expected 'visibility' or 'log-odds'"),
        ({"hit": 0.5}, "hit = 0.5: expected"),
        ({"hit": 1.0}, "hit = 1.0: expected"),
        ({"miss": 0.5}, "miss = 0.5: expected"),
        ({"miss": 0.0}, "miss = 0.0: expected"),
        ({"least": 0.6}, "least = 0.6: expected"),
        ({"most": float("nan")}, "most = nan: expected"),
        ({"occupied": 0.4}, "occupied = 0.4: expected"),
        ({"occupied": 0.98}, "occupied = 0.98: expected at most `most`, 0.971"),
    ],
)
def test_bad_values_are_named(values, named):
    with pytest.raises(ValueError, match="^" + named.replace("(", r"\(")):
        Fusion(**values)
