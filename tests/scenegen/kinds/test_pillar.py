"""Every parameter of pillar worlds does what it says."""

import numpy as np
import pytest

from scenegen.worlds.kinds.pillar import Pillar
from tests.scenegen.kinds import Geom, draw, looks_like_share, looks_uniform

MANY = {"size_m": (100.0, 60.0, 10.0), "density": (0.1, 0.1)}
"""600 pillars."""


def gaps(pillars):
    """(n, n): metres between the least upright cylinders around pillars; inf where the other one is
    no earlier one."""
    plan = np.array([pillar.position[:2] for pillar in pillars])
    sizes = np.array([pillar.size[:2] for pillar in pillars])
    is_round = np.array([pillar.shape == Geom.mjGEOM_CYLINDER for pillar in pillars])
    hulls = np.where(is_round, sizes[:, 0], np.hypot(*sizes.T))
    apart = np.linalg.norm(plan[:, None] - plan, axis=2) - hulls[:, None] - hulls
    apart[np.triu_indices(len(pillars))] = np.inf
    return apart


@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_passages_come_in_their_share(share):
    """Set beside one that is itself set beside another, and so on, each passage is exactly as wide
    as asked for."""
    shares = {"passage_share": share, "round_share": 0.4, "oblong_share": 0.3}
    pillars = draw(Pillar(**MANY, **shares, passage_m=(0.77, 0.77)))
    exact = (np.abs(gaps(pillars) - 0.77) < 1e-9)[1:]
    assert looks_like_share(int(exact.any(axis=1).sum()), len(exact), share)
    if share == 1.0:
        # which of the earlier ones, from first to last
        chosen = exact.argmax(axis=1) / np.arange(1, len(exact) + 1)
        assert looks_uniform(chosen[20:], 0.0, 1.0)
