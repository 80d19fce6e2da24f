"""What every engine keeps: poses do not see each other, and two engines see the same world."""

import json

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import Lidar, Pose, cast
from lidarsim.engines import ENGINES
from tests.command_line import beside
from tests.lidarsim.reference import unit
from tests.refusals import refuses
from tests.scenegen import cases, each_case

ASSETS = beside(__file__, "assets.xml")
SIZES = {
    "plane": "0 0 1",
    "sphere": "0.7",
    "capsule": "0.3 0.8",
    "ellipsoid": "0.3 0.8 0.5",
    "cylinder": "0.6 0.4",
    "box": "0.3 0.8 0.5",
}
PROCESSORS = "mujoco", "analytic"


def model_of(*geoms, inside="", assets=""):
    """A world of geoms, each given by its attributes, and of what else is `inside`."""
    body = inside + "".join(f"<geom {geom}/>" for geom in geoms)
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{ASSETS}{assets}</asset><worldbody>{body}</worldbody></mujoco>"
    )


def data_of(model):
    """A world as it begins."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def numbers(values):
    """Floats for an MJCF attribute, exactly."""
    return " ".join(f"{float(value):.17g}" for value in values)


SORTS = [f'type="{shape}" size="{size}"' for shape, size in SIZES.items() if shape != "plane"]


def random_model(rng):
    """Two solids of every sort on a lattice with room between them, turned at random."""
    geoms = ['type="plane" size="0 0 1" pos="0 0 -4" euler="4 7 0"']
    sorts = [*SORTS, 'type="hfield" hfield="h"', 'type="mesh" mesh="m"', 'type="mesh" mesh="n"']
    places = [(6.0 * i, 6.0 * j, 0.0) for i in range(4) for j in range(4)]
    for sort, place in zip(sorts * 2, rng.permutation(places), strict=True):
        position = numbers(place + rng.uniform(-0.5, 0.5, 3))
        geoms.append(f'{sort} pos="{position}" euler="{numbers(rng.uniform(-180, 180, 3))}"')
    return model_of(*geoms)


def random_rays(rng, poses, *shape):
    """Origins (P, 3) between the solids, and unit vectors (P, *shape, 3)."""
    origins = 6.0 * rng.integers(0, 3, (poses, 3)) + 3.0
    origins[:, 2] = rng.uniform(-2, 2, poses)
    rays = rng.normal(size=(poses, *shape, 3))
    return origins, unit(rays)


def from_mujoco(model, data, origin, rays, reach=np.inf, without=-1):
    """Ranges (n,), geoms and normals by `mj_ray`, one ray (n, 3) at a time; a body is left out."""
    ranges, geoms = np.full(len(rays), np.inf), np.full(len(rays), -1)
    normals = np.full(rays.shape, np.nan)
    for n, ray in enumerate(rays):
        geom, normal = np.zeros(1, np.int32), np.zeros(3)
        range_m = mujoco.mj_ray(model, data, origin, ray, None, True, without, geom, normal)
        if 0 <= range_m <= reach:
            ranges[n], geoms[n], normals[n] = range_m, geom[0], normal
    return ranges, geoms, normals


def made(name, model):
    return ENGINES.find(name).of(model)


@pytest.mark.parametrize("name", PROCESSORS)
def test_any_shape_and_memory_layout_of_rays_will_do(name, rng):
    """Of poses that do not see each other."""
    engine = made(name, random_model(rng))
    origins, rays = random_rays(rng, 3, 60)
    flat = engine.cast(origins, rays, 12.0)
    assert flat.shape == (3, 60)
    assert flat.dtype == np.float64
    for p in range(3):
        assert_array_equal(engine.cast(origins[p : p + 1], rays[p : p + 1], 12.0)[0], flat[p])
    shaped = engine.cast(origins, rays.reshape(3, 3, 4, 5, 3), 12.0)
    assert_array_equal(shaped, flat.reshape(3, 3, 4, 5))
    assert_array_equal(engine.cast(origins[::-1], rays[::-1, ::-2], 12.0), flat[::-1, ::-2])
    rays.setflags(write=False)
    assert_array_equal(engine.cast(origins, np.asfortranarray(rays), 12.0), flat)
    assert engine.cast(origins, np.empty((3, 0, 3)), 12.0).shape == (3, 0)
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


BAD_RAYS = np.loadtxt(sum(cases("../lidarsim/bad_rays"), ()))


@pytest.mark.parametrize("name", PROCESSORS)
def test_bad_rays_meet_nothing_and_harm_no_other(name):
    engine = made(name, model_of('size="1"', 'type="plane" size="0 0 1" pos="0 0 -3"'))
    good, down = [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]
    ranges = engine.cast(np.zeros((1, 3)), [[good, *BAD_RAYS, down]], 10.0)
    assert_array_equal(ranges, [[1.0, *[np.inf] * len(BAD_RAYS), 1.0]])
    for place in ([np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]):
        both = engine.cast([place, [0.0, 0.0, 2.0]], [[good, down]] * 2, 10.0)
        assert_array_equal(both, [[np.inf, np.inf], [np.inf, 1.0]])
    assert engine.cast([[5.0, 0.0, -3.0]], [[down]], 10.0) == 0.0  # on the plane
    assert np.isinf(made(name, model_of()).cast(np.zeros((1, 3)), [[good, down]], 10.0)).all()


@pytest.mark.parametrize("name", PROCESSORS)
@each_case("../lidarsim/ray_shapes", "origins rays reach", json.loads)
def test_rays_of_other_shapes_are_refused(name, origins, rays, reach):
    """A kernel would read beyond them, or leave ranges as the memory was."""
    case = f"{name} {origins} {rays} {reach}"
    refuses(case, made(name, model_of()).cast, np.zeros(origins), np.ones(rays), reach)
