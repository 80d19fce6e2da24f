"""Every parameter of geometric worlds does what it says."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenegen.worlds.kinds.geometric import Geometric
from tests.scenegen.kinds import Geom, draw, looks_like_share, looks_uniform

AREA = {"size_m": (60.0, 40.0, 9.0), "ground": False}
NOTHING = {"density": (1e-9, 1e-9), "wall_density": (0.0, 0.0), "clutter_density": (0.0, 0.0)}
"""Not one of anything in 2400 square metres."""


def only(density):
    """A function that draws nothing but what has this density."""

    def draw_some(seed=0, count=600, **parameters):
        share = count / 2400.0
        return draw(Geometric(**AREA, **NOTHING | {density: (share, share)} | parameters), seed)

    return draw_some


solids, walls, heaps = only("density"), only("wall_density"), only("clutter_density")


def roles(found):
    """Whether each solid stands, is stacked right on the middle of an earlier one, or floats."""
    low, high = np.array([solid.span for solid in found]).T
    plan = np.array([solid.position[:2] for solid in found])
    said = []
    for n in range(len(found)):
        under = (plan[:n] == plan[n]).all(axis=1) & (np.abs(high[:n] - low[n]) < 1e-5)
        said.append("standing" if abs(low[n]) < 1e-5 else "stacked" if under.any() else "floating")
    return said


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
