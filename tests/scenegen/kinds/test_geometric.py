"""Every parameter of geometric worlds does what it says."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from scenegen.worlds.kinds.geometric import Geometric
from tests.scenegen.kinds import Geom, draw, looks_like_share, looks_uniform

AREA = {"size_m": (60.0, 40.0, 9.0), "ground": False}
NOTHING = {"density": (1e-9, 1e-9), "wall_density": (0.0, 0.0), "clutter_density": (0.0, 0.0)}
"""Not one of anything in 2400 square metres."""
SHAPES = {Geom.mjGEOM_SPHERE: 1, Geom.mjGEOM_CYLINDER: 2, Geom.mjGEOM_BOX: 3}
"""How many sizes a shape has."""


def only(density):
    """A function that draws nothing but what has this density."""

    def draw_some(seed=0, count=600, **parameters):
        share = count / 2400.0
        return draw(Geometric(**AREA, **NOTHING | {density: (share, share)} | parameters), seed)

    return draw_some


solids, walls, heaps = only("density"), only("wall_density"), only("clutter_density")


def used_sizes(found):
    """The sizes that matter, of all solids."""
    return np.concatenate([solid.size[: SHAPES[solid.shape]] for solid in found])


def roles(found):
    """Whether each solid stands, is stacked right on the middle of an earlier one, or floats."""
    low, high = np.array([solid.span for solid in found]).T
    plan = np.array([solid.position[:2] for solid in found])
    said = []
    for n in range(len(found)):
        under = (plan[:n] == plan[n]).all(axis=1) & (np.abs(high[:n] - low[n]) < 1e-5)
        said.append("standing" if abs(low[n]) < 1e-5 else "stacked" if under.any() else "floating")
    return said


def test_the_logarithm_of_the_density_is_uniform():
    counts = [len(solids(seed, density=(0.01, 0.15))) for seed in range(120)]
    assert looks_uniform(
        np.log(np.array(counts) / 2400.0), np.log(0.01) - 0.02, np.log(0.15) + 0.02
    )


@pytest.mark.parametrize(
    ("some", "more"),
    [
        (solids, {"stacked_share": 0.0}),
        (walls, {}),
        (heaps, {"clutter_count": (1, 1), "clutter_spread_m": 1e-6}),
    ],
)
def test_all_spread_over_the_plan(some, more):
    x, y, _ = np.transpose([solid.position for solid in some(count=300, **more)])
    assert looks_uniform(x, -1e-4, 60.0 + 1e-4)
    assert looks_uniform(y, -1e-4, 40.0 + 1e-4)


def test_sizes_are_drawn_axis_by_axis_between_their_bounds():
    found = solids(half_size_m=(0.2, 1.7), scale=(1.0, 1.0))
    assert looks_uniform(used_sizes(found), 0.2, 1.7)
    boxes = np.array([solid.size for solid in found if solid.shape == Geom.mjGEOM_BOX])
    assert np.abs(np.corrcoef(boxes.T) - np.eye(3)).max() < 0.25


def test_the_scale_is_a_factor_on_half_sizes_drawn_once_a_world():
    factors = []
    for seed in range(100):
        sizes = used_sizes(solids(seed, count=12, half_size_m=(0.5, 0.5), scale=(0.6, 1.8)))
        assert np.ptp(sizes) < 1e-12
        factors.append(sizes[0] / 0.5)
    assert looks_uniform(factors, 0.6, 1.8)


@pytest.mark.parametrize(
    ("standing", "stacked"), [(0.5, 0.2), (0.1, 0.8), (1.0, 0.0), (0.0, 0.0), (0.0, 1.0)]
)
@pytest.mark.parametrize("tilted", [0.0, 1.0])
def test_solids_stand_are_stacked_or_float_in_their_shares(standing, stacked, tilted):
    found = solids(standing_share=standing, stacked_share=stacked, tilted_share=tilted, count=400)
    said = roles(found)
    assert len({solid.shape for solid in found}) == 3
    if stacked == 1.0:
        assert said == ["floating"] + ["stacked"] * 399  # the first has nothing to stand on
        return
    shares = {"standing": standing, "stacked": stacked, "floating": 1 - standing - stacked}
    for name, share in shares.items():
        assert looks_like_share(said.count(name), len(said), share), (name, said.count(name))


def test_solids_are_stacked_on_any_earlier_one():
    found = solids(standing_share=0.0, stacked_share=1.0, count=400)
    tops = np.array([solid.span[1] for solid in found])
    under = [int(np.abs(tops[:n] - found[n].span[0]).argmin()) for n in range(400)[1:]]
    assert looks_uniform(np.array(under[20:]) / np.arange(21, 400), 0.0, 1.0)


def test_floating_solids_have_their_centres_at_any_height():
    found = solids(standing_share=0.0, stacked_share=0.0)
    assert looks_uniform([solid.position[2] for solid in found], 0.0, 9.0)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_tilted_solids_come_in_their_share_and_at_any_attitude(share):
    found = solids(tilted_share=share)
    tilted = [solid for solid in found if not solid.upright]
    assert looks_like_share(len(tilted), len(found), share)
    if tilted:
        # of a direction drawn evenly over the sphere, every component is uniform (Archimedes)
        for component in np.reshape([solid.rotation for solid in tilted], (-1, 9)).T:
            assert looks_uniform(component, -1.0, 1.0)
    if len(tilted) < len(found):
        assert looks_uniform([solid.yaw for solid in found if solid.upright], 0.0, 2 * np.pi)


@pytest.mark.parametrize(
    ("name", "some", "more"),
    [("wall_density", walls, {}), ("clutter_density", heaps, {"clutter_count": (1, 1)})],
)
def test_densities_are_drawn_once_a_world_between_their_bounds(name, some, more):
    counts = [len(some(seed, **{name: (0.01, 0.06)}, **more)) for seed in range(50)]
    assert looks_uniform(np.array(counts) / 2400.0, 0.01 - 3e-4, 0.06 + 3e-4)


def test_walls_are_upright_slabs_on_the_ground_within_their_ranges():
    ranges = {"wall_length_m": (3.0, 6.5), "wall_height_m": (1.0, 4.0)}
    found = walls(count=300, **ranges, wall_half_thickness_m=(0.05, 0.25))
    assert {solid.shape for solid in found} == {Geom.mjGEOM_BOX}
    assert all(solid.upright for solid in found)
    sizes = np.array([solid.size for solid in found])
    assert looks_uniform(2 * sizes[:, 0], *ranges["wall_length_m"])
    assert looks_uniform(sizes[:, 1], 0.05, 0.25)
    low, high = np.array([solid.span for solid in found]).T
    assert_allclose(low, 0.0, rtol=0, atol=1e-9)
    assert looks_uniform(high, *ranges["wall_height_m"])


def test_a_heap_has_a_count_of_solids_with_both_bounds_included():
    counts = np.bincount(
        [len(heaps(seed, count=1, clutter_count=(4, 8))) for seed in range(250)], minlength=10
    )
    assert counts[4:9].sum() == 250
    assert stats.chisquare(counts[4:9]).pvalue > 1e-3


def test_a_heap_is_small_tilted_solids_on_the_ground_about_its_place():
    found = heaps(
        count=1, clutter_count=(900, 900), clutter_spread_m=0.8, clutter_half_size_m=(0.05, 0.45)
    )
    assert looks_uniform(used_sizes(found), 0.05, 0.45)
    for shape in SHAPES:
        assert looks_like_share(sum(solid.shape == shape for solid in found), len(found), 1 / 3)
    assert looks_uniform([solid.rotation[2, 2] for solid in found], -1.0, 1.0)
    plan = np.array([solid.position[:2] for solid in found])
    for axis in range(2):
        away = plan[:, axis] - plan[:, axis].mean()
        assert stats.kstest(away, stats.norm(scale=0.8).cdf).pvalue > 1e-3
    lift = np.array([solid.span[0] for solid in found])
    assert lift.min() > -1e-5
    assert stats.kstest(lift, stats.halfnorm(scale=0.8).cdf).pvalue > 1e-3
