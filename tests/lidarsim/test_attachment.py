"""A sensor on a body follows it, and sees what MuJoCo's own rays see of the same data."""

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import Lidar, Pose, attach
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import Fault
from tests.command_line import example
from tests.lidarsim import reference
from tests.lidarsim.engines.test_laws import HFIELD, MESHES, from_mujoco
from tests.refusals import refuses

WORLD = f"""<mujoco><asset>{HFIELD}{MESHES}</asset><worldbody>
<geom type="plane" size="0 0 1"/>
<geom type="hfield" hfield="h" pos="-3 0 0"/>
<geom type="mesh" mesh="m" pos="3 3 0.2"/>
<body name="robot" pos="0 0 2.5"><freejoint/><geom name="hull" type="box" size=".3 .2 .1"/>
  <body name="arm" pos=".4 0 .2"><joint axis="0 1 0"/>
   <geom name="arm" type="capsule" size=".05 .3"/></body></body>
<body name="ball" pos="1.5 .2 4"><freejoint/><geom type="sphere" size=".4"/></body>
<body name="stone" pos="1 2 3" euler="20 30 40"><freejoint/><geom type="mesh" mesh="n"/></body>
<body name="drum" pos="2 -1.5 3" euler="50 0 20"><freejoint/>
  <geom type="cylinder" size=".5 .3"/></body>
</worldbody></mujoco>"""
LIDAR = Lidar(rows=12, columns=40, vertical_fov_deg=150.0)


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string(WORLD)


@pytest.fixture
def data(model):
    """As the world begins."""
    found = mujoco.MjData(model)
    mujoco.mj_forward(model, found)
    return found


def test_a_falling_robot_sees_what_mujocos_rays_see_of_the_same_data(model):
    data, offset = mujoco.MjData(model), Pose.level((0.1, 0.05, 0.15), 0.4)
    mounted = attach(model, "robot", LIDAR, offset=offset)
    body, heights, met = model.body("robot").id, [], set()
    rays_body = np.array(LIDAR.directions_body.reshape(-1, 3))
    for _ in range(12):
        mujoco.mj_step(model, data, 40)
        pose = Pose(
            data.xpos[body] + data.xmat[body].reshape(3, 3) @ offset.position,
            mounted.poses(data)[0].quaternion,
        )
        rays = reference.rotation(pose.quaternion).apply(rays_body)
        found = from_mujoco(model, data, pose.position, rays, LIDAR.max_range_m, without=body)
        hits, (also, named) = mounted.hits(data), mounted.cast(data)
        ranges, geoms, normals = (a.reshape(*LIDAR.shape, *a.shape[1:]) for a in found)
        assert_allclose(hits.ranges[0], ranges, rtol=0, atol=1e-6)
        assert_array_equal(hits.geoms[0], geoms)
        seen = geoms >= 0
        assert_allclose(hits.normals[0][seen], normals[seen], rtol=0, atol=1e-4)
        assert_array_equal((also, named), (hits.ranges, hits.geoms))
        scan = mounted.scan(data)
        assert_array_equal(scan.ranges, hits.ranges[0].astype(np.float32))
        assert_allclose(scan.points(), hits.points[0][seen], rtol=0, atol=1e-5)
        heights.append(pose.position[2])
        met |= set(geoms.ravel().tolist())
    assert heights[0] - heights[-1] > 1.0
    assert met >= set(range(model.ngeom)) - {model.geom("hull").id}


def test_sensors_on_several_bodies_give_what_each_gives_alone(model):
    data, names = mujoco.MjData(model), ["robot", "ball", "drum"]
    offsets = [Pose.level((0, 0, 0.1 * n), 0.5 * n) for n in range(3)]
    together = attach(model, names, LIDAR, offset=offsets)
    alone = [attach(model, names[n], LIDAR, offset=offsets[n]) for n in range(3)]
    for _ in range(3):
        mujoco.mj_step(model, data, 60)
        for scan, one in zip(together.scans(data), alone, strict=True):
            assert_array_equal(scan.ranges, one.scan(data).ranges)
    refuses("several", together.scan, data)


@pytest.mark.parametrize(
    ("unseen", "missing"), [("nothing", set()), ("body", {"hull"}), ("tree", {"hull", "arm"})]
)
def test_a_sensor_sees_of_its_carrier_what_it_is_to_see(model, data, unseen, missing):
    offset = Pose.level((0.0, 0.0, 0.3))
    hits = attach(model, "robot", LIDAR, offset=offset, unseen=unseen).hits(data)
    own = {name for name in ("hull", "arm") if (hits.geoms == model.geom(name).id).any()}
    assert own == {"hull", "arm"} - missing


def test_what_cannot_be_attached_is_told_in_one_line(model):
    data = mujoco.MjData(model)
    poses = [Pose.level((0, 0, 0))] * 3
    for body, more in (
        ("robto", {}),
        (["robot", "ball"], {"offset": poses}),
        ("robot", {"unseen": "me"}),
        ("robot", {"sensor": "os1"}),
    ):
        refuses(f"{body} {[*more]}", attach, model, body, **more)
    scan = attach(model, "robot").scan
    refuses("never forwarded", scan, data)
    refuses("another model", scan, mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>")))
    mujoco.mj_forward(model, data)
    data.geom_xpos[4] = np.nan
    refuses("no place", scan, data)


@dataclass(frozen=True)
class Anew(Fault):
    """A stage of one's own, which gives the engine the range by its name."""

    def apply(self, returns, view, *, rng):
        rays, reach = (view.pose.position[None], returns.directions[None]), view.sensor.max_range_m
        return returns.but(ranges=view.engine.cast(*rays, max_range_m=reach))


OWN = Noise((Anew(),))


@pytest.mark.parametrize("unseen", ["nothing", "tree"])
def test_noise_sees_what_the_sensor_does_and_passes_the_carrier_as_its_rays_do(model, data, unseen):
    offsets = [Pose.level((0.0, 0.0, h)) for h in (0.15, 0.4)]
    mounted = attach(model, "robot", LIDAR, offset=offsets, unseen=unseen)
    rng, hits, scans = np.random.default_rng, mounted.hits(data), mounted.scans(data)
    # a motion of nothing casts anew, and intensity asks for surfaces
    light = mounted.observe(data, Noise.parse("motion:0:corrected=true,intensity"), rng=rng(0))
    for n, (anew,) in enumerate(one.ranges for one in mounted.observe(data, OWN, rng=rng(0))):
        assert_allclose(anew, hits.ranges[n], rtol=0, atol=1e-5)
    for n, one in enumerate(light):
        assert_allclose(one.ranges[0], hits.ranges[n], rtol=0, atol=1e-5)
        normal = np.nan_to_num(hits.normals[n])
        cosine = np.abs((normal * scans[n].directions).sum(axis=-1))
        assert_allclose(
            one.intensity[0], np.where(hits.geoms[n] >= 0, 0.5 * cosine, 0.0), atol=1e-5
        )
    first, second = mounted.observe(data, Noise.parse("dropout:0.5"), rng=rng(0))
    both = np.isfinite(hits.ranges).all(axis=0)
    assert (np.isfinite(first.ranges[0]) != np.isfinite(second.ranges[0]))[both].any()


def test_the_documented_example_runs():
    names = {}
    exec(example("simulation.md", "import Lidar, Pose, attach"), names)
    assert np.isfinite(names["scan"].ranges).sum() > 300
    assert set(np.unique(names["hits"].geoms)) == {-1, 0, 1}
