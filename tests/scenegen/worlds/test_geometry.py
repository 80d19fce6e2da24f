"""A world's digest sees its solids and nothing else."""

import mujoco
import numpy as np
import pytest

from lidarsim.solids.model import solids_of
from scenegen.worlds.world import geometry_digest

FIELD = '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1" elevation="0 {} 0 1"/>'
ASSETS = '<asset><mesh name="m" vertex="{}"/>' + FIELD + "</asset>"


def digest(body, *, vertices="0 0 0 1 0 0 0 1 0 0 0 1", height=0.5):
    assets = ASSETS.format(vertices, height)
    world = f"<mujoco>{assets}<worldbody>{body}</worldbody></mujoco>"
    return geometry_digest(solids_of(mujoco.MjModel.from_xml_string(world)))


PLACE = ' pos="1 2 3"'
A = f'<geom type="box" size="1 2 3"{PLACE} quat="0.8 0.6 0 0"/>'
B = '<geom type="cylinder" size="1 2" pos="4 0 0"/>'


HINGE = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint axis="0 0 1" ref="40"/>'
"""A geom stands where its body does in the reference configuration."""


@pytest.mark.parametrize(
    "same",
    [
        B + A,
        A.replace("<geom", '<geom name="x" rgba="1 0 0 1"') + B,
        A.replace("0.8 0.6 0 0", "-0.8 -0.6 0 0") + B,
        f'<body pos="1 0 0">{HINGE}<body pos="0 2 3">{A.replace(PLACE, "")}</body></body>{B}',
        f'{A}<body pos="4 0 0"><freejoint/>{B.replace("4 0 0", "0 0 0")}</body>',
        A.replace('size="1 2 3"', 'size="2 1 3"').replace(
            'quat="0.8 0.6 0 0"', 'xyaxes="0 0.28 0.96 -1 0 0"'
        )
        + B,
        A + B.replace("/>", ' euler="180 0 77"/>'),
        A + B + '<geom type="sphere" size="9" rgba="1 1 1 0"/>',
    ],
)
def test_names_order_bodies_colours_and_placings_do_not_matter(same):
    assert digest(A + B) == digest(same)


@pytest.mark.parametrize(
    "other",
    [
        A,
        A + B + B,
        A.replace("1 2 3", "1 2 3.0001") + B,
        A + B.replace("cylinder", "capsule"),
        A.replace("0.8 0.6", "0.6 0.8") + B,
        A.replace("0.8 0.6", "0.8 -0.6") + B,
        A + B.replace("4 0 0", "4 0 0.001"),
    ],
)
def test_other_solids_have_another_digest(other):
    assert digest(A + B) != digest(other)


def test_meshes_and_height_fields_count_by_what_they_are():
    body = '<geom type="mesh" mesh="m"/><geom type="hfield" hfield="h"/>'
    swapped = '<geom type="hfield" hfield="h"/><geom type="mesh" mesh="m"/>'
    assert digest(body) == digest(swapped)
    assert digest(body) == digest(body, vertices="1 0 0 0 0 0 0 1 0 0 0 1")
    assert digest(body) != digest(body, vertices="0 0 0 1 0 0 0 1 0 0 0 1.01")
    assert digest(body) != digest(body, height=0.51)


def test_turned_cubes_and_spheres():
    def box(size, turn):
        return digest(f'<geom type="box" size="{size}" euler="{turn}"/>')

    assert box("1 1 1", "0 0 90") == box("1 1 1", "90 180 0") != box("1 1 1", "0 0 45")
    rng = np.random.default_rng(0)
    for _ in range(20):
        turn = " ".join(map(str, rng.normal(size=4).round(6)))
        sphere = f'<geom type="sphere" size="1" quat="{turn}"/>'
        assert digest(sphere) == digest('<geom type="sphere" size="1"/>')
