"""The traps of MuJoCo's many-ray function, against the analytic engine, which knows nothing of it,
and which `test_adversarial` holds to intervals worked out in longer floats.

Facts found in MuJoCo 4.0.0: `mj_multiRay` looks at a body's geoms only if the ray meets the
bounding sphere of the body's *colliding* geoms, so that geoms with contype = conaffinity = 0 are
lost where they lie outside of that sphere; a body, the world body too, without any colliding geom
is searched in full. Its cutoff sets far geoms aside, except planes and those of bodies without
colliding geoms, and limits no distance.
"""

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim import AnalyticEngine, MujocoEngine
from lidarsim.engines import ENGINES
from tests.lidarsim import reference
from tests.lidarsim.engines.test_laws import PROCESSORS, made, model_of, numbers
from tests.lidarsim.reference import unit
from tests.refusals import refuses
from tests.scenegen import cases

GHOST = 'contype="0" conaffinity="0"'
"""A geom that is seen but takes no part in collisions, as visual geoms do."""
CENTRE = np.zeros((1, 3))


def seen(model, rays, data=None):
    """Ranges (n,) along rays (n, 3) from the centre, which both engines give to a micrometre."""
    engines = MujocoEngine.of(model, data), AnalyticEngine.of(model, data)
    ranges, expected = (engine.cast(CENTRE, rays[None], 30.0)[0] for engine in engines)
    assert_allclose(ranges, expected, rtol=0, atol=1e-6)
    return ranges


def test_an_engine_sees_the_configuration_of_its_data(rng):
    """A free body moved by its coordinates is seen where it went; without data it is seen where it
    began."""
    places = np.array([[4.0, 0.0, 0.0], [-1.0, 5.0, 1.0]])
    body = '<body pos="4 0 0"><freejoint/><geom type="box" size="0.6 0.9 1.2"/></body>'
    model, rays = model_of(inside=body), unit(rng.normal(size=(2000, 3)))
    data = mujoco.MjData(model)
    data.qpos[:] = (*places[1], *reference.random_quaternion(rng))
    for name in PROCESSORS:  # it would be an empty world
        engine = ENGINES.find(name)
        refuses(name, lambda engine: engine.of(model, data).cast(CENTRE, [rays], 30.0), engine)
    mujoco.mj_forward(model, data)
    for place, ranges in zip(places, (seen(model, rays), seen(model, rays, data)), strict=True):
        towards = rays[np.isfinite(ranges)] @ unit(place)
        assert len(towards) >= 20
        assert towards.min() > 0.85


@pytest.mark.parametrize("owner", ["world", "body", "free body"])
def test_geoms_beyond_their_bodys_colliding_extent_are_seen(owner, rng):
    """`mj_multiRay` never tests these: it sets bodies aside by a sphere about colliding geoms
    alone."""
    attitude, turn = (reference.random_quaternion(rng) for _ in range(2))
    ghost, place = np.array([-5.0, 1.0, 0.5]), np.array([0.2, 0.3, 0.4])
    pair = f"""<geom type="ellipsoid" size="0.9 0.7 0.8" pos="-5 1 0.5" quat="{numbers(attitude)}"
    {GHOST}/><geom type="box" size="0.1 0.1 0.1" pos="4 0 0"/>"""
    if owner != "world":
        joint = "<freejoint/>" if owner == "free body" else ""
        pair = f'<body pos="{numbers(place)}" quat="{numbers(turn)}">{joint}{pair}</body>'
        ghost = place + reference.rotation(turn).apply(ghost)
    rays = ghost + 0.8 * rng.normal(size=(300, 3))
    assert np.isfinite(seen(model_of(inside=pair), unit(rays))).sum() > 80


PLACES, LOOKS, VERDICTS = zip(*cases("../lidarsim/looks"), strict=True)
"""Where a wall stands, what it looks like, and whether it is seen; its material rules."""


@pytest.mark.parametrize("name", PROCESSORS)
@pytest.mark.parametrize("colliding", ["", GHOST])
def test_geoms_and_materials_of_alpha_zero_are_not_seen(name, colliding):
    """Glass walls around the sensor, invisible in both ways, and a visible sphere behind each of
    them."""
    assets = '<material name="clear" rgba="1 0 0 0"/><material name="faint" rgba="1 0 0 0.01"/>'
    sides = np.loadtxt(PLACES)
    walls = [
        f'size="0.5" pos="{numbers(2 * side)}" {look} {colliding}'
        for side, look in zip(sides, LOOKS, strict=True)
    ]
    behind = [f'size="0.5" pos="{numbers(5 * side)}"' for side in sides]
    for geoms, beyond in ((walls + behind, 4.5), (walls, np.inf)):
        ranges = made(name, model_of(*geoms, assets=assets)).cast(CENTRE, sides[None], 10.0)[0]
        expected = [1.5 if verdict == "seen" else beyond for verdict in VERDICTS]
        assert_allclose(ranges, expected, rtol=0, atol=1e-9)
