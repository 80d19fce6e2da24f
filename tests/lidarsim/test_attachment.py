"""A sensor on a body follows it, and sees what MuJoCo's own rays see of the same data."""

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import Lidar, Pose, attach
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import Fault
from tests.command_line import beside
from tests.lidarsim import reference
from tests.lidarsim.engines.test_laws import ASSETS, data_of, from_mujoco
from tests.refusals import refuses

WORLD = beside(__file__, "carrier.xml").format(assets=ASSETS)
LIDAR = Lidar(rows=12, columns=40, vertical_fov_deg=150.0)


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string(WORLD)


@pytest.fixture
def data(model):
    return data_of(model)


def test_a_falling_robot_sees_what_mujocos_rays_see(model):
    data, offset = mujoco.MjData(model), Pose.level((0.1, 0.05, 0.15), 0.4)
    mounted = attach(model, "robot", LIDAR, offset=offset)
    body, heights, met = model.body("robot").id, [], set()
    for _ in range(12):
        mujoco.mj_step(model, data, 40)
        position = data.xpos[body] + data.xmat[body].reshape(3, 3) @ offset.position
        turn = reference.rotation(data.xquat[body]) * reference.rotation(offset.quaternion)
        rays = turn.apply(np.array(LIDAR.directions_body.reshape(-1, 3)))
        expected = from_mujoco(model, data, position, rays, LIDAR.max_range_m, without=body)
        hits, scan = mounted.hits(data), mounted.scan(data)
        ranges, geoms, normals = (a.reshape(*LIDAR.shape, *a.shape[1:]) for a in expected)
        assert_allclose(hits.ranges[0], ranges, rtol=0, atol=1e-6)
        assert_array_equal(hits.geoms[0], geoms)
        seen = geoms >= 0
        assert_allclose(hits.normals[0][seen], normals[seen], rtol=0, atol=1e-4)
        assert_array_equal(mounted.cast(data), (hits.ranges, hits.geoms))
        assert_array_equal(scan.ranges, hits.ranges[0].astype(np.float32))
        assert_allclose(scan.points(), hits.points[0][seen], rtol=0, atol=1e-5)
        heights.append(position[2])
        met |= set(geoms.ravel().tolist())
    assert heights[0] - heights[-1] > 1.0
    assert met >= set(range(model.ngeom)) - {model.geom("hull").id}


def test_sensors_on_several_bodies_scan_as_alone(model, data):
    names = ["robot", "ball", "drum"]
    offsets = [Pose.level((0, 0, 0.1 * n), 0.5 * n) for n in range(3)]
    together = attach(model, names, LIDAR, offset=offsets)
    for name, offset, scan in zip(names, offsets, together.scans(data), strict=True):
        alone = attach(model, name, LIDAR, offset=offset).scan(data)
        assert_array_equal(scan.ranges, alone.ranges)
    refuses("several", together.scan, data)


@pytest.mark.parametrize(
    ("unseen", "seen"), [("nothing", {"hull", "arm"}), ("body", {"arm"}), ("tree", set())]
)
def test_a_sensor_may_not_see_its_carrier(model, data, unseen, seen):
    offset = Pose.level((0.0, 0.0, 0.3))
    hits = attach(model, "robot", LIDAR, offset=offset, unseen=unseen).hits(data)
    assert {name for name in ("hull", "arm") if model.geom(name).id in hits.geoms} == seen


def test_what_cannot_be_attached_is_refused(model, data):
    poses = [Pose.level((0, 0, 0))] * 3
    for body, options in (
        ("robto", {}),
        (["robot", "ball"], {"offset": poses}),
        ("robot", {"unseen": "me"}),
        ("robot", {"sensor": "os1"}),
    ):
        refuses(f"{body} {[*options]}", attach, model, body, **options)
    scan = attach(model, "robot").scan
    refuses("never forwarded", scan, mujoco.MjData(model))
    refuses("another model", scan, mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>")))
    data.geom_xpos[4] = np.nan
    refuses("no place", scan, data)


@dataclass(frozen=True)
class Anew(Fault):
    """A stage of one's own, which gives the engine the range by its name."""

    def apply(self, returns, view, *, rng):
        rays, reach = (view.pose.position[None], returns.directions[None]), view.sensor.max_range_m
        return returns.but(ranges=view.engine.cast(*rays, max_range_m=reach))


@pytest.mark.parametrize("unseen", ["nothing", "tree"])
def test_noise_sees_what_the_sensor_does(model, data, unseen):
    """And passes the carrier as its rays do."""
    offsets = [Pose.level((0.0, 0.0, h)) for h in (0.15, 0.4)]
    mounted = attach(model, "robot", LIDAR, offset=offsets, unseen=unseen)
    hits, scans = mounted.hits(data), mounted.scans(data)

    def observed(noise):
        return mounted.observe(data, noise, rng=np.random.default_rng(0))

    # a motion of nothing casts anew, and intensity asks for surfaces
    lights = observed(Noise.parse("motion:0:corrected=true,intensity"))
    for n, (again, light) in enumerate(zip(observed(Noise((Anew(),))), lights, strict=True)):
        for returns in (again, light):
            assert_allclose(returns.ranges[0], hits.ranges[n], rtol=0, atol=1e-5)
        cosine = np.abs((np.nan_to_num(hits.normals[n]) * scans[n].directions).sum(axis=-1))
        expected = np.where(hits.geoms[n] >= 0, 0.5 * cosine, 0.0)
        assert_allclose(light.intensity[0], expected, atol=1e-5)
    first, second = (np.isfinite(its.ranges[0]) for its in observed(Noise.parse("dropout:0.5")))
    assert (first != second)[np.isfinite(hits.ranges).all(axis=0)].any()
