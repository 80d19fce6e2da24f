"""Every parameter of pillar worlds does what it says."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenegen.worlds.kinds.pillar import Pillar
from tests.scenegen.kinds import Geom, draw, looks_like_share, looks_uniform

MANY = {"size_m": (100.0, 60.0, 10.0), "density": (0.1, 0.1)}
"""600 pillars."""
PAIR = {"size_m": (20.0, 10.0, 10.0), "density": (0.01, 0.01), "passage_share": 1.0}
"""Two pillars, of which the second is set beside the first."""


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


def test_the_density_is_drawn_once_a_world_between_its_bounds():
    kind = Pillar(size_m=(50.0, 80.0, 10.0), density=(0.01, 0.05))
    counts = [len(draw(kind, seed)) for seed in range(80)]
    assert looks_uniform(np.array(counts) / 4000.0, 0.01, 0.05)


def test_a_world_too_small_for_its_density_has_one_pillar():
    assert len(draw(Pillar(size_m=(1.0, 1.0, 1.0), density=(0.0, 0.01)))) == 1


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


def test_oblong_pillars_are_up_to_the_ratio_as_long_as_wide():
    given = {"oblong_share": 1.0, "oblong_ratio": 4.0, "half_width_m": (0.2, 0.4)}
    pillars = draw(Pillar(**MANY, round_share=0.0, **given))
    assert looks_uniform([p.size[1] / p.size[0] for p in pillars], 1.0, 4.0)
    assert looks_uniform([p.size[0] for p in pillars], 0.2, 0.4)


@pytest.mark.parametrize("round_share", [0.0, 1.0])
def test_pillars_stand_upright_on_the_ground_as_wide_and_tall_as_they_are_drawn(round_share):
    given = {"half_width_m": (0.15, 0.9), "height_m": (2.0, 7.0)}
    pillars = draw(Pillar(**MANY, round_share=round_share, oblong_share=0.0, **given))
    assert looks_uniform([p.size[0] for p in pillars], 0.15, 0.9)
    low, high = np.array([p.span for p in pillars]).T
    assert_allclose(low, 0.0, rtol=0, atol=1e-9)
    assert looks_uniform(high, 2.0, 7.0)
    assert all(p.upright for p in pillars)


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


def test_passages_are_drawn_between_their_bounds_in_every_direction():
    widths, angles = [], []
    for seed in range(200):
        first, second = draw(Pillar(**PAIR, passage_m=(0.3, 1.9)), seed)
        widths.append(gaps([first, second])[1, 0])
        angles.append(np.arctan2(*(second.position - first.position)[1::-1]) % (2 * np.pi))
    assert looks_uniform(widths, 0.3, 1.9)
    assert looks_uniform(angles, 0.0, 2 * np.pi)
