"""Laws of ray casting: MuJoCo worlds against intersections worked out in numpy, and the engine's
known traps.

`reference.ranges` knows nothing of MuJoCo but the meaning of its geoms' sizes. Where a world has
meshes or height fields, MuJoCo's own one-ray function `mj_ray` is the reference: it tests every
geom, whereas the many-ray function `mj_multiRay` first sets geoms aside by bounding volumes.

Facts found in MuJoCo 4.0.0: `mj_multiRay` looks at a body's geoms only if the ray meets the
bounding sphere of the body's *colliding* geoms, so that geoms with contype = conaffinity = 0 are
lost where they lie outside of that sphere; a body, the world body too, without any colliding geom
is searched in full. Its cutoff sets far geoms aside, except planes and those of bodies without
colliding geoms, and limits no distance.
"""

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import Lidar, MujocoEngine, Pose, cast
from tests.lidarsim import reference
from tests.lidarsim.engines.test_laws import PROCESSORS, made
from tests.lidarsim.reference import Body, Geom, unit

SOLIDS = ("sphere", "box", "cylinder", "capsule", "ellipsoid")
GHOST = 'contype="0" conaffinity="0"'
"""A geom that is seen but takes no part in collisions, as visual geoms do."""


def engine_of(xml):
    """The engine of a world given as MJCF."""
    return MujocoEngine.of(mujoco.MjModel.from_xml_string(xml))


def ranges_of(engine, position, rays, reach):
    """Ranges from one position."""
    return engine.cast(np.asarray(position)[None], np.asarray(rays)[None], reach)[0]


def assert_same_ranges(got, expected, returns_at_least=1):
    """Equal to a micrometre, inf exactly where the reference is inf, and enough returns to mean
    something."""
    assert got.shape == expected.shape
    assert got.dtype == np.float64
    assert not np.isnan(got).any()
    wrong = np.isinf(got) != np.isinf(expected)
    assert not wrong.any(), (
        f"{wrong.sum()} rays: cast {got[wrong][:5]}, reference {expected[wrong][:5]}"
    )
    seen = np.isfinite(expected)
    assert seen.sum() >= returns_at_least, f"only {seen.sum()} returns: this world tests nothing"
    assert_allclose(got[seen], expected[seen], rtol=0, atol=1e-6)


def random_world(rng):
    """Planes and solids of the world body, and bodies at random attitudes, some of them free to
    move."""
    geoms = [
        reference.random_geom(rng, (*SOLIDS, "plane"), 7, largest=3.5)
        for _ in range(rng.integers(6, 14))
    ]
    bodies = []
    for _ in range(rng.integers(3, 7)):
        inside = tuple(reference.random_geom(rng, SOLIDS, 3) for _ in range(rng.integers(1, 4)))
        joint = "<freejoint/>" if rng.random() < 0.5 else ""
        place, attitude = rng.uniform(-6, 6, 3), reference.random_quaternion(rng)
        bodies.append(Body(inside, tuple(place), tuple(attitude), joint))
    return geoms, bodies


@pytest.mark.parametrize("level", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_a_scan_of_a_random_world_matches_the_analytic_ranges(seed, level):
    """The whole way from pose to float32 ranges; layout and intersections both come from the
    reference."""
    rng = np.random.default_rng(1000 + seed)
    geoms, bodies = random_world(rng)
    position, yaw = rng.uniform(-4, 4, 3), float(rng.uniform(-4, 4))
    quaternion = reference.level_quaternion(yaw) if level else reference.random_quaternion(rng)
    pose = Pose.level(position, yaw) if level else Pose(position=position, quaternion=quaternion)
    scan = cast(engine_of(reference.world_xml(geoms, bodies)), Lidar(), pose)
    rays = reference.lidar_directions(quaternion)
    expected = reference.ranges(geoms, bodies, position, rays, 10.0)
    assert scan.ranges.dtype == np.float32
    assert scan.ranges.shape == (16, 120)
    seen = np.isfinite(expected)
    assert seen.sum() >= 50
    assert_array_equal(np.isfinite(scan.ranges), seen)
    assert np.all(np.isposinf(scan.ranges[~seen]))
    # a micrometre, and half a float32's last bit at 10 m
    assert_allclose(scan.ranges[seen], expected[seen], rtol=0, atol=1.5e-6)
    points = position + expected[seen][:, None] * rays[seen]
    assert_allclose(scan.points(), points, rtol=0, atol=2e-6)


def test_the_maximum_range_divides_returns_from_infinity():
    """A wall 4 m ahead: seen with more range than that, not with less, along slanted rays farther
    away."""
    wall = Geom("box", (0.5, 20.0, 20.0), (4.5, 0.0, 0.0))
    engine = engine_of(reference.world_xml([wall]))
    angles = np.radians(np.arange(0, 80, 5))
    rays = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    for reach in (3.999999, 4.000001, 4.5, 6.0, 15.0):
        got = ranges_of(engine, np.zeros(3), rays, reach)
        exact = 4.0 / np.cos(angles)
        assert_array_equal(np.isfinite(got), exact <= reach)
        assert_allclose(got[exact <= reach], exact[exact <= reach], rtol=0, atol=1e-9)


def test_an_engine_over_data_sees_the_configuration_of_the_data():
    """A free body moved by its coordinates is seen where it went; without data it is seen where it
    began."""
    rng = np.random.default_rng(12)
    shape = Geom("box", (0.6, 0.9, 1.2), (0.3, -0.2, 0.1), tuple(reference.random_quaternion(rng)))
    started = Body((shape,), (4.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "<freejoint/>")
    moved = Body((shape,), (-1.0, 5.0, 1.0), tuple(reference.random_quaternion(rng)))
    model = mujoco.MjModel.from_xml_string(reference.world_xml([], [started]))
    data = mujoco.MjData(model)
    data.qpos[:] = (*moved.position, *moved.quaternion)
    mujoco.mj_forward(model, data)
    rays = unit(rng.normal(size=(2000, 3)))
    for engine, body in ((MujocoEngine.of(model, data), moved), (MujocoEngine.of(model), started)):
        expected = reference.ranges([], [body], np.zeros(3), rays, 10.0)
        assert_same_ranges(
            ranges_of(engine, np.zeros(3), rays, 10.0), expected, returns_at_least=20
        )


# ------------------------------------------------------------------------------------- traps of
# mj_multiRay


@pytest.mark.parametrize("seed", range(2))
def test_rays_just_inside_a_boxs_edges_hit_it_in_every_direction_of_view(seed):
    """Edges reach beyond the angles that the corners span, most near the zenith; azimuth wraps
    behind."""
    rng = np.random.default_rng(seed)
    aims = [
        (0.3, 0.1, 4.0),
        (0.2, -0.4, -3.0),
        (-4.0, 0.0, 0.3),
        (-3.0, 0.4, -2.0),
        (3.0, 3.0, 0.0),
    ]
    for aim in aims:
        geom = reference.random_geom(rng, ("box",), 0.0, largest=2.0)
        geom = Geom("box", geom.size, tuple(np.add(aim, 0.3 * rng.normal(size=3))), geom.quaternion)
        on_edges = rng.uniform(-1, 1, size=(400, 3))
        fixed = rng.permuted(np.tile([True, True, False], (400, 1)), axis=1)
        on_edges = np.where(fixed, np.sign(on_edges) * (1 - 1e-4), on_edges) * np.array(geom.size)
        rays = unit(reference.rotation(geom.quaternion).apply(on_edges) + np.array(geom.position))
        expected = reference.ranges([geom], [], np.zeros(3), rays, 30.0)
        got = ranges_of(engine_of(reference.world_xml([geom])), np.zeros(3), rays, 30.0)
        assert_same_ranges(got, expected, returns_at_least=400)


@pytest.mark.parametrize("owner", ["world", "body", "free body"])
def test_geoms_without_collisions_outside_their_bodys_colliding_extent_are_seen(owner):
    """`mj_multiRay` never tests these: it sets bodies aside by a sphere about colliding geoms
    alone."""
    rng = np.random.default_rng(21)
    attitude = tuple(reference.random_quaternion(rng))
    pair = (
        Geom("ellipsoid", (0.9, 0.7, 0.8), (-5.0, 1.0, 0.5), attitude, GHOST),
        Geom("box", (0.1, 0.1, 0.1), (4.0, 0.0, 0.0)),
    )
    joint = "<freejoint/>" if owner == "free body" else ""
    yawed = tuple(reference.level_quaternion(0.1))
    geoms, bodies = pair, []
    if owner != "world":
        geoms, bodies = [], [Body(pair, (0.2, 0.3, 0.4), yawed, joint)]
    position, around = np.array([0.1, 0.0, 0.2]), rng.normal(size=(800, 3))
    around[:300] = pair[0].position + 0.8 * around[:300] - position
    rays = unit(around)
    expected = reference.ranges(geoms, bodies, position, rays, 10.0)
    got = ranges_of(engine_of(reference.world_xml(geoms, bodies)), position, rays, 10.0)
    assert_same_ranges(got, expected, returns_at_least=80)


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
    rays = np.array(list(looks), dtype=np.float64)
    for geoms, beyond in ((walls + behind, 4.5), (walls, np.inf)):
        xml = reference.world_xml(geoms, assets=materials)
        engine = made(name, mujoco.MjModel.from_xml_string(xml))
        expected = [1.5 if seen else beyond for _, seen in looks.values()]
        assert_allclose(ranges_of(engine, np.zeros(3), rays, 10.0), expected, rtol=0, atol=1e-9)
