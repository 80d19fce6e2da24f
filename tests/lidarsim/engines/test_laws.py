"""What every engine keeps: poses do not see each other, and two engines see the same world."""

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import Lidar, Pose, cast
from lidarsim.engines import ENGINES
from tests.lidarsim.reference import unit
from tests.refusals import refuses

HFIELD = """<hfield name="h" nrow="3" ncol="4" size="2 1.5 1 0.3"
 elevation="0 1 0 .4 .2 .8 .1 .9 0 .3 .7 .5"/>"""
MESHES = """<mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>
<mesh name="n" vertex="-1 -1 0  1 -1 0  1 1 0  -1 1 0  0 0 1.5"/>"""
SIZES = {
    "plane": "0 0 1",
    "sphere": "0.7",
    "capsule": "0.3 0.8",
    "ellipsoid": "0.3 0.8 0.5",
    "cylinder": "0.6 0.4",
    "box": "0.3 0.8 0.5",
}
DATA = {"hfield": 'hfield="h"', "mesh": 'mesh="m"'}
PROCESSORS = "mujoco", "analytic"


def model_of(*geoms):
    """A world of geoms, each given by its attributes."""
    body = "".join(f"<geom {geom}/>" for geom in geoms)
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{HFIELD}{MESHES}</asset><worldbody>{body}</worldbody></mujoco>"
    )


SORTS = [f'type="{shape}" size="{size}"' for shape, size in SIZES.items() if shape != "plane"]


def random_model(rng):
    """Two solids of every sort on a lattice with room between them, turned at random."""
    geoms = ['type="plane" size="0 0 1" pos="0 0 -4" euler="4 7 0"']
    sorts = [*SORTS, 'type="hfield" hfield="h"', 'type="mesh" mesh="m"', 'type="mesh" mesh="n"']
    places = [(6.0 * i, 6.0 * j, 0.0) for i in range(4) for j in range(4)]
    for sort, place in zip(sorts * 2, rng.permutation(places), strict=True):
        x, y, z = place + rng.uniform(-0.5, 0.5, 3)
        turn = " ".join(f"{angle:.1f}" for angle in rng.uniform(-180, 180, 3))
        geoms.append(f'{sort} pos="{x:.3f} {y:.3f} {z:.3f}" euler="{turn}"')
    return model_of(*geoms)


def random_rays(rng, poses, *shape):
    """Origins (P, 3) between the solids, and unit vectors (P, *shape, 3)."""
    origins = 6.0 * rng.integers(0, 3, (poses, 3)) + 3.0
    origins[:, 2] = rng.uniform(-2, 2, poses)
    rays = rng.normal(size=(poses, *shape, 3))
    return origins, unit(rays)


def from_mujoco(model, data, origin, rays, reach=np.inf, without=-1):
    """Ranges (n,), geoms and normals by `mj_ray`, one ray (n, 3) at a time; a body is left out."""
    ranges, geoms, normals = np.empty(len(rays)), np.empty(len(rays), int), np.empty(rays.shape)
    for n, ray in enumerate(rays):
        geom, normal = np.zeros(1, np.int32), np.zeros(3)
        found = mujoco.mj_ray(model, data, origin, ray, None, True, without, geom, normal)
        seen = 0 <= found <= reach
        ranges[n], geoms[n], normals[n] = (found, geom[0], normal) if seen else (np.inf, -1, np.nan)
    return ranges, geoms, normals


def made(name, model):
    return ENGINES.find(name).of(model)


@pytest.mark.parametrize("name", PROCESSORS)
def test_poses_together_give_what_each_gives_alone(name, rng):
    engine = made(name, random_model(rng))
    origins, rays = random_rays(rng, 5, 3, 40)
    together = engine.cast(origins, rays, 12.0)
    assert together.shape == (5, 3, 40)
    assert together.dtype == np.float64
    for p in range(5):
        alone = engine.cast(origins[p : p + 1], rays[p : p + 1], 12.0)
        assert_array_equal(alone[0], together[p])
    order = rng.permutation(5)
    assert_array_equal(engine.cast(origins[order], rays[order], 12.0), together[order])


@pytest.mark.parametrize("name", PROCESSORS)
def test_any_shape_and_memory_layout_of_rays_will_do(name, rng):
    engine = made(name, random_model(rng))
    origins, rays = random_rays(rng, 2, 60)
    flat = engine.cast(origins, rays, 12.0)
    assert_array_equal(
        engine.cast(origins, rays.reshape(2, 3, 4, 5, 3), 12.0), flat.reshape(2, 3, 4, 5)
    )
    assert_array_equal(engine.cast(origins, rays[:, ::-2], 12.0), flat[:, ::-2])
    assert_array_equal(engine.cast(origins, np.asfortranarray(rays), 12.0), flat)
    rays.setflags(write=False)
    assert_array_equal(engine.cast(origins, rays, 12.0), flat)
    assert engine.cast(origins, np.empty((2, 0, 3)), 12.0).shape == (2, 0)
    assert engine.cast(np.empty((0, 3)), np.empty((0, 7, 3)), 12.0).shape == (0, 7)


class Odd:
    """An engine that gives whatever it is told to."""

    def __init__(self, ranges):
        self.ranges = ranges

    def cast(self, origins, directions, max_range_m):
        return self.ranges


@pytest.mark.parametrize("value", [np.nan, -1.0, 10.00001, 1e300])
def test_ranges_that_are_none_are_refused(value):
    refuses("range", cast, Odd(np.full((1, 16, 120), value)), Lidar(), Pose.level((0, 0, 0)))
    refuses("shape", cast, Odd(np.ones((16, 120))), Lidar(), Pose.level((0, 0, 0)))


BAD_RAYS = [
    [0, 0, 0],
    [np.nan, 0, 1],
    [np.inf, 0, 0],
    [-np.inf, np.nan, 0],
    [2, 0, 0],
    [1e-200, 0, 0],
    [1e200, 0, 0],
]


@pytest.mark.parametrize("name", PROCESSORS)
def test_what_is_no_direction_and_no_place_meets_nothing_and_harms_no_other_ray(name):
    engine = made(
        name, model_of('type="sphere" size="1"', 'type="plane" size="0 0 1" pos="0 0 -3"')
    )
    good, down = [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]
    found = engine.cast(np.zeros((1, 3)), [[good, *BAD_RAYS, down]], 10.0)
    assert_array_equal(found, [[1.0, *[np.inf] * len(BAD_RAYS), 1.0]])
    for place in ([np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]):
        both = engine.cast([place, [0.0, 0.0, 2.0]], [[good, down]] * 2, 10.0)
        assert_array_equal(both, [[np.inf, np.inf], [np.inf, 1.0]])
    assert engine.cast([[5.0, 0.0, -3.0]], [[down]], 10.0) == 0.0  # on the plane
    assert np.isinf(made(name, model_of()).cast(np.zeros((1, 3)), [[good, down]], 10.0)).all()


@pytest.mark.parametrize("name", PROCESSORS)
def test_rays_of_other_shapes_and_no_range_are_refused(name):
    """A kernel would read beyond them, or leave ranges as the memory was."""
    engine = made(name, model_of())
    for origins, rays, reach in (
        ((1, 3), (2, 3), 9),
        ((3,), (1, 3), 9),
        ((1, 2), (1, 3), 9),
        ((1, 3), (1, 3), np.nan),
    ):
        case = f"{name} {origins} {rays} {reach}"
        refuses(case, engine.cast, np.zeros(origins), np.ones(rays), reach)
