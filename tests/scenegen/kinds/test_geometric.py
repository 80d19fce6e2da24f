"""Every parameter of geometric worlds does what it says."""

import numpy as np
import pytest

from scenegen.worlds.kinds.geometric import Geometric
from tests.scenegen.kinds import draw, looks_like_share


def roles(solids):
    """Whether each solid stands, is stacked right on the middle of an earlier one, or floats."""
    low, high = np.array([solid.span for solid in solids]).T
    plan, names = np.array([solid.position[:2] for solid in solids]), []
    for n in range(len(solids)):
        under = (plan[:n] == plan[n]).all(axis=1) & (np.abs(high[:n] - low[n]) < 1e-5)
        standing = abs(low[n]) < 1e-5
        names.append("standing" if standing else "stacked" if under.any() else "floating")
    return names


@pytest.mark.parametrize(
    ("standing", "stacked"), [(0.5, 0.2), (0.1, 0.8), (1.0, 0.0), (0.0, 0.0), (0.0, 1.0)]
)
@pytest.mark.parametrize("tilted", [0.0, 1.0])
def test_solids_stand_are_stacked_or_float(standing, stacked, tilted):
    """In their shares. There is hardly a wall, and no clutter, in 2400 square metres."""
    area = {"size_m": (60.0, 40.0, 9.0), "ground": False, "density": (1 / 6, 1 / 6)}
    others = {"wall_density": (0.0, 0.0), "clutter_density": (0.0, 0.0)}
    shares = {"standing": standing, "stacked": stacked, "tilted": tilted}
    shares = {f"{name}_share": share for name, share in shares.items()}
    solids = draw(Geometric(**area, **others, **shares))
    names = roles(solids)
    assert len({solid.shape for solid in solids}) == 3
    if stacked == 1.0:
        assert names == ["floating"] + ["stacked"] * 399  # the first has nothing to stand on
        return
    expected = {"standing": standing, "stacked": stacked, "floating": 1 - standing - stacked}
    for name, share in expected.items():
        assert looks_like_share(names.count(name), len(names), share), name
