"""A world's digest sees its solids and nothing else."""

import mujoco
import pytest

from lidarsim.solids import solids_of
from scenegen.worlds.world import geometry_digest
from tests.lidarsim.engines.test_laws import SIZES

FIELD = '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1" elevation="0 {} 0 1"/>'
ASSETS = '<asset><mesh name="m" vertex="{}"/>' + FIELD + "</asset>"


def digest(body, *, vertices="0 0 0 1 0 0 0 1 0 0 0 1", height=0.5):
    assets = ASSETS.format(vertices, height)
    world = f"<mujoco>{assets}<worldbody>{body}</worldbody></mujoco>"
    return geometry_digest(solids_of(mujoco.MjModel.from_xml_string(world)))


PLACE = 'pos="1 2 3"'
A = f'type="box" size="1 2 3" quat="0.8 0.6 0 0" {PLACE}'
B = 'type="cylinder" size="1 2" pos="4 0 0"'
HINGE = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint axis="0 0 1" ref="40"/>'
"""A geom stands where its body does in the reference configuration."""
SAME = f"""
<geom {B}/> <geom {A}/>
<geom name="x" rgba="1 0 0 1" {A}/> <geom {B}/>
<geom {A.replace("0.8 0.6", "-0.8 -0.6")}/> <geom {B}/>
<body pos="1 0 0">{HINGE}<body pos="0 2 3"><geom {A.replace(PLACE, "")}/></body></body><geom {B}/>
<geom {A}/> <body pos="4 0 0"><freejoint/><geom {B.replace("4 0 0", "0 0 0")}/></body>
<geom type="box" size="2 1 3" xyaxes="0 0.28 0.96 -1 0 0" {PLACE}/> <geom {B}/>
<geom {A}/> <geom {B} euler="180 0 77"/>
<geom {A}/> <geom {B}/> <geom type="sphere" size="9" rgba="1 1 1 0"/>
"""
OTHERS = f"""
<geom {A}/>
<geom {A}/> <geom {B}/> <geom {B}/>
<geom {A.replace(PLACE, 'pos="1 2 3.001"')}/> <geom {B}/>
<geom {A}/> <geom {B.replace("cylinder", "capsule")}/>
<geom {A.replace("0.8 0.6", "0.6 0.8")}/> <geom {B}/>
<geom {A.replace("0.8 0.6", "0.8 -0.6")}/> <geom {B}/>
<geom {A}/> <geom {B.replace("4 0 0", "4 0 0.001")}/>
"""


@pytest.mark.parametrize("same", SAME.strip().splitlines())
def test_names_order_bodies_colours_and_placings_do_not_matter(same):
    assert digest(f"<geom {A}/><geom {B}/>") == digest(same)


@pytest.mark.parametrize("other", OTHERS.strip().splitlines())
def test_other_solids_have_another_digest(other):
    assert digest(f"<geom {A}/><geom {B}/>") != digest(other)


def test_every_number_of_a_size_counts():
    for shape, size in SIZES.items():
        for n in range(len(size.split())):
            other = size.split()
            other[n] += "001"
            one, two = (f'<geom type="{shape}" size="{its}"/>' for its in (size, " ".join(other)))
            assert (digest(one) == digest(two)) == (shape == "plane"), (shape, n)


def test_meshes_and_height_fields_count_by_what_they_are():
    body = '<geom type="mesh" mesh="m"/><geom type="hfield" hfield="h"/>'
    swapped = '<geom type="hfield" hfield="h"/><geom type="mesh" mesh="m"/>'
    assert digest(body) == digest(swapped)
    assert digest(body) == digest(body, vertices="1 0 0 0 0 0 0 1 0 0 0 1")
    assert digest(body) != digest(body, vertices="0 0 0 1 0 0 0 1 0 0 0 1.01")
    assert digest(body) != digest(body, height=0.51)


def test_turned_cubes_and_spheres(rng):
    def box(size, turn):
        return digest(f'<geom type="box" size="{size}" euler="{turn}"/>')

    assert box("1 1 1", "0 0 90") == box("1 1 1", "90 180 0") != box("1 1 1", "0 0 45")
    for _ in range(20):
        turn = " ".join(map(str, rng.normal(size=4).round(6)))
        sphere = f'<geom type="sphere" size="1" quat="{turn}"/>'
        assert digest(sphere) == digest('<geom type="sphere" size="1"/>')
