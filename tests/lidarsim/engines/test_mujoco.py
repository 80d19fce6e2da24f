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
from tests.lidarsim import reference
from tests.lidarsim.engines.test_laws import PROCESSORS, made
from tests.lidarsim.reference import Body, Geom, unit
from tests.refusals import refuses

GHOST = 'contype="0" conaffinity="0"'
"""A geom that is seen but takes no part in collisions, as visual geoms do."""
CENTRE = np.zeros((1, 3))


def model_of(*parts, **more):
    return mujoco.MjModel.from_xml_string(reference.world_xml(*parts, **more))


def seen(model, rays, data=None):
    """Ranges (n,) along rays (n, 3) from the centre, which both engines give to a micrometre."""
    found, expected = (
        engine.of(model, data).cast(CENTRE, rays[None], 30.0)[0]
        for engine in (MujocoEngine, AnalyticEngine)
    )
    assert_allclose(found, expected, rtol=0, atol=1e-6)
    return found


def test_an_engine_over_data_sees_the_configuration_of_the_data(rng):
    """A free body moved by its coordinates is seen where it went; without data it is seen where it
    began."""
    began, went = np.array([4.0, 0.0, 0.0]), np.array([-1.0, 5.0, 1.0])
    body = Body((Geom("box", (0.6, 0.9, 1.2)),), tuple(began), inner="<freejoint/>")
    model = model_of(bodies=[body])
    data = mujoco.MjData(model)
    data.qpos[:] = (*went, *reference.random_quaternion(rng))
    rays = unit(rng.normal(size=(2000, 3)))
    for engine in (MujocoEngine, AnalyticEngine):
        refuses(  # it would be an empty world
            engine.__name__, lambda of=engine.of: of(model, data).cast(CENTRE, rays[None], 30.0)
        )
    mujoco.mj_forward(model, data)
    for place, found in ((began, seen(model, rays)), (went, seen(model, rays, data))):
        towards = rays[np.isfinite(found)] @ unit(place)
        assert len(towards) >= 20
        assert towards.min() > 0.85


@pytest.mark.parametrize("owner", ["world", "body", "free body"])
def test_geoms_without_collisions_outside_their_bodys_colliding_extent_are_seen(owner, rng):
    """`mj_multiRay` never tests these: it sets bodies aside by a sphere about colliding geoms
    alone."""
    attitude, turn = (tuple(reference.random_quaternion(rng)) for _ in range(2))
    ghost = (-5.0, 1.0, 0.5)
    pair = (
        Geom("ellipsoid", (0.9, 0.7, 0.8), ghost, attitude, GHOST),
        Geom("box", (0.1, 0.1, 0.1), (4.0, 0.0, 0.0)),
    )
    joint = "<freejoint/>" if owner == "free body" else ""
    body = Body(pair, (0.2, 0.3, 0.4), turn, joint)
    model = model_of(pair) if owner == "world" else model_of(bodies=[body])
    places = model.body_pos[-1], reference.rotation(model.body_quat[-1])
    rays = places[0] + places[1].apply(ghost) + 0.8 * rng.normal(size=(300, 3))
    assert np.isfinite(seen(model, unit(rays))).sum() > 80


@pytest.mark.parametrize("name", PROCESSORS)
@pytest.mark.parametrize("colliding", ["", GHOST])
def test_geoms_and_materials_of_alpha_zero_are_not_seen(name, colliding):
    """Glass walls around the sensor, invisible in both ways, and a visible sphere behind each of
    them."""
    materials = '<material name="clear" rgba="1 0 0 0"/><material name="faint" rgba="1 0 0 0.01"/>'
    looks = {
        (1, 0, 0): ('rgba="0.5 0.5 0.5 0"', False),
        (-1, 0, 0): ('material="clear"', False),
        (0, 1, 0): ('rgba="0.5 0.5 0.5 0.01"', True),
        (0, -1, 0): ('material="faint"', True),
        (0, 0, 1): ('material="faint" rgba="0.5 0.5 0.5 0"', True),  # the material rules
        (0, 0, -1): ('material="clear" rgba="0.5 0.5 0.5 1"', False),
    }
    walls = [
        Geom("sphere", (0.5,), tuple(2.0 * np.array(side)), attributes=f"{look} {colliding}")
        for side, (look, _) in looks.items()
    ]
    behind = [Geom("sphere", (0.5,), tuple(5.0 * np.array(side))) for side in looks]
    rays = np.array(list(looks), float)
    for geoms, beyond in ((walls + behind, 4.5), (walls, np.inf)):
        engine = made(name, model_of(geoms, assets=materials))
        expected = [1.5 if seen else beyond for _, seen in looks.values()]
        assert_allclose(engine.cast(CENTRE, rays[None], 10.0)[0], expected, rtol=0, atol=1e-9)
