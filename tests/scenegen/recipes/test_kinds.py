"""What every kind of world keeps."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from scenegen.recipes.geometric import Geometric
from scenegen.recipes.kind import WorldKind
from scenegen.recipes.pillar import Pillar
from tests.scenegen.recipes import Geom, draw

KINDS = pytest.mark.parametrize("kind", [Pillar, Geometric])


@KINDS
def test_a_world_depends_on_the_state_of_the_generator_alone(kind: type[WorldKind]) -> None:
    first, again, other = (draw(kind(), seed) for seed in (5, 5, 6))
    for name in ("size", "position", "quaternion"):
        values = [
            np.array([getattr(solid, name) for solid in found[1:50]])
            for found in (first, again, other)
        ]
        np.testing.assert_array_equal(values[0], values[1])
        assert not np.array_equal(values[0], values[2])


@KINDS
def test_the_floor_is_a_slab_over_the_plan_with_its_top_at_0(kind: type[WorldKind]) -> None:
    size: Any = {"size_m": (12.0, 30.0, 5.0)}
    floor, *others = draw(kind(**size, ground=True, ground_m=0.6))
    assert floor.shape == Geom.mjGEOM_BOX
    np.testing.assert_allclose(floor.size, [6.0, 15.0, 0.3])
    np.testing.assert_allclose(floor.position, [6.0, 15.0, -0.3])
    assert floor.upright
    assert len(draw(kind(**size, ground=False))) == len(others)


def wrong(value: Any) -> list[Any]:
    """Values that no parameter like this one can have."""
    if isinstance(value, tuple):
        pair = [(value[1] + 1, value[0])] if len(value) == 2 else []
        return [(float("nan"), *value[1:]), (-1, *value[1:]), *pair]
    return [float("nan"), -0.1]


@KINDS
def test_bad_values_are_named(kind: type[WorldKind]) -> None:
    for field in dataclasses.fields(kind):
        for value in wrong(field.default) if field.name != "ground" else ["yes"]:
            with pytest.raises(ValueError, match=field.name):
                kind(**{field.name: value})


@pytest.mark.parametrize(
    ("kind", "given"),
    [
        (Pillar, {"round_share": 0.95}),
        (Pillar, {"oblong_share": 0.4}),
        (Pillar, {"oblong_ratio": 0.9}),
        (Pillar, {"half_width_m": (0.0, 0.2)}),
        (Geometric, {"standing_share": 0.9}),
        (Geometric, {"stacked_share": 0.6}),
        (Geometric, {"density": (0.0, 0.1)}),
        (Geometric, {"scale": (0.0, 1.0)}),
        (Geometric, {"clutter_spread_m": 0.0}),
    ],
)
def test_bounds_that_a_name_does_not_tell_are_kept(
    kind: type[WorldKind], given: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match=next(iter(given))):
        kind(**given)
