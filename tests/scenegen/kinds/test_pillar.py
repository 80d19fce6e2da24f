"""Every parameter of pillar worlds does what it says."""

import numpy as np
import pytest

from scenegen.worlds.kinds.pillar import Pillar
from tests.scenegen.kinds import Geom, draw, looks_like_share, looks_uniform

MANY = {"size_m": (100.0, 60.0, 10.0), "density": (0.1, 0.1)}
"""600 pillars."""


def hull(pillar):
    """Radius of the least upright cylinder around a pillar."""
    round_ = pillar.shape == Geom.mjGEOM_CYLINDER
    return pillar.size[0] if round_ else float(np.hypot(*pillar.size[:2]))


def gaps(pillars):
    """(n, n): metres between the round hulls, seen from above; inf where the other one is no
    earlier one."""
    plan, hulls = np.array([p.position[:2] for p in pillars]), np.array([hull(p) for p in pillars])
    apart = np.linalg.norm(plan[:, None] - plan, axis=2) - hulls[:, None] - hulls
    apart[np.triu_indices(len(pillars))] = np.inf
    return apart


@pytest.mark.parametrize(
    ("round_share", "oblong_share"), [(0.7, 0.1), (0.2, 0.5), (0.0, 1.0), (1.0, 0.0), (0.0, 0.0)]
)
def test_sections_come_in_their_shares(round_share, oblong_share):
    pillars = draw(Pillar(**MANY, round_share=round_share, oblong_share=oblong_share))
    counted = {"round": 0, "square": 0, "oblong": 0}
    for pillar in pillars:
        if pillar.shape == Geom.mjGEOM_CYLINDER:
            counted["round"] += 1
        else:
            assert pillar.shape == Geom.mjGEOM_BOX
            counted["square" if pillar.size[0] == pillar.size[1] else "oblong"] += 1
    shares = {"round": round_share, "oblong": oblong_share}
    for name, share in (shares | {"square": 1 - sum(shares.values())}).items():
        assert looks_like_share(counted[name], len(pillars), share), (name, counted)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_pillars_of_a_passage_come_in_their_share_its_width_from_an_earlier_ones_hull(share):
    """Set beside one that is itself set beside another, and so on, each passage is exactly as wide
    as asked for."""
    kind = Pillar(
        **MANY, passage_share=share, passage_m=(0.77, 0.77), round_share=0.4, oblong_share=0.3
    )
    exact = (np.abs(gaps(draw(kind)) - 0.77) < 1e-9)[1:]
    assert looks_like_share(int(exact.any(axis=1).sum()), len(exact), share)
    if share == 1.0:
        # which of the earlier ones, from first to last
        chosen = exact.argmax(axis=1) / np.arange(1, len(exact) + 1)
        assert looks_uniform(chosen[20:], 0.0, 1.0)
