"""The second intersector, against arithmetic that needs none; and MuJoCo's rays against it, on every shape."""

import mujoco
import numpy as np
import pytest
from scenegen.verify.intersect import cast as intersect

from lidarsim import Lidar, MujocoCaster, Pose, cast
from lidarsim.solids.shapes import Solids
from scenegen.verify.archive import compile_solids
from scenegen.verify.rays import audit, disagrees, ray_directions

HFIELD = '<hfield name="h" nrow="3" ncol="4" size="2 1.5 1 0.3" elevation="0 1 0 .4 .2 .8 .1 .9 0 .3 .7 .5"/>'
MESH = '<mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'
SHAPES = {
    "plane": 'type="plane" size="0 0 1" euler="10 20 0" pos="0 0 -1"',
    "sphere": 'type="sphere" size="0.7"',
    "capsule": 'type="capsule" size="0.3 0.8" euler="30 40 50"',
    "ellipsoid": 'type="ellipsoid" size="0.3 0.8 0.5" euler="30 40 50"',
    "cylinder": 'type="cylinder" size="0.6 0.4" euler="30 40 50"',
    "box": 'type="box" size="0.3 0.8 0.5" euler="30 40 50"',
    "hfield": 'type="hfield" hfield="h" pos="0.3 0.2 -0.5"',
    "mesh": 'type="mesh" mesh="m" euler="30 40 50"',
}


def document(*geoms: str) -> bytes:
    body = "".join(f"<geom {geom}/>" for geom in geoms)
    return f"<mujoco><asset>{HFIELD}{MESH}</asset><worldbody>{body}</worldbody></mujoco>".encode()


def solids(*geoms: str) -> Solids:
    return compile_solids(document(*geoms), {}, "w")


def test_hits_where_arithmetic_says() -> None:
    ahead = np.array([[1.0, 0.0, 0.0]])
    for geom, distance in (
        ('type="sphere" size="1" pos="5 0 0"', 4.0),
        ('type="sphere" size="5" pos="5 3 0"', 1.0),
        ('type="box" size="1 2 3" pos="5 0 0"', 4.0),
        ('type="box" size="1 1 1" pos="5 0 0" euler="0 0 45"', 5 - 2**0.5),
        ('type="cylinder" size="1 4" pos="5 0.6 3.9"', 4.2),
        ('type="cylinder" size="2 0.5" pos="5 1 0" euler="0 90 0"', 4.5),
        ('type="capsule" size="1 2" pos="5 0 2.6"', 5 - 0.8),
        ('type="ellipsoid" size="2 1 1" pos="5 0.6 0"', 5 - 1.6),
        ('type="plane" size="0 0 1" pos="3 0 0" euler="0 -90 0"', 3.0),
        ('type="sphere" size="1" pos="-5 0 0"', np.inf),
        ('type="sphere" size="1" pos="12 0 0"', np.inf),
        ('type="plane" size="0 0 1" pos="-3 0 0" euler="0 -90 0"', np.inf),
        ('type="sphere" size="1" pos="5 0 0" rgba="1 1 1 0"', np.inf),
    ):
        found = intersect(np.zeros(3), ahead, solids(geom), 10.0)[0]
        assert found == pytest.approx(distance, abs=1e-12), geom


@pytest.mark.parametrize("shape", list(SHAPES))
def test_mujocos_rays_agree_on_every_shape(shape: str) -> None:
    model = mujoco.MjModel.from_xml_string(document(SHAPES[shape]).decode())
    lidar = Lidar(rows=40, columns=60, vertical_fov_deg=180.0, max_range_m=6.0)
    hits = 0
    for n, yaw in enumerate(np.linspace(0.0, 6.0, 12)):
        pose = Pose.level(
            [2.2 * np.cos(yaw), 2.2 * np.sin(yaw), 0.3 * n - 0.9 + 1.5 * (shape in ("plane", "hfield"))], yaw
        )
        scan = cast(MujocoCaster(model), lidar, pose)
        _, found, gap = audit(
            scan.ranges, pose.position, pose.quaternion, solids(SHAPES[shape]), lidar, rng=np.random.default_rng(0)
        )
        assert not disagrees(gap, found, lidar.max_range_m).any()
        hits += np.isfinite(found).sum()
    assert hits > 100


@pytest.mark.parametrize("mount", ["tilt", "band"])
@pytest.mark.parametrize("fov", [(60.0, 360.0), (30.0, 90.0)])
@pytest.mark.parametrize("size", [(16, 120), (1, 1)])
def test_directions_are_the_sensors(mount: str, fov: tuple[float, float], size: tuple[int, int]) -> None:
    lidar = Lidar(rows=size[0], columns=size[1], vertical_fov_deg=fov[0], horizontal_fov_deg=fov[1], mount=mount)  # type: ignore[arg-type]
    quaternion = np.array([0.5, -0.1, 0.7, 0.5])
    quaternion /= np.linalg.norm(quaternion)
    np.testing.assert_allclose(ray_directions(lidar, quaternion), lidar.directions(quaternion), atol=1e-14)


def test_a_micrometre_and_a_half_is_too_much() -> None:
    gap = np.array([0.9e-6, 2.5e-6, 0.01, np.nan])
    assert disagrees(gap, np.array([1.0, 1.0, 10.0, 1.0]), 10.0).tolist() == [False, True, True, True]
