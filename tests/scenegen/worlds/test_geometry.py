"""A world's digest sees its solids and nothing else."""

import mujoco
import pytest

from lidarsim.solids import solids_of
from scenegen.worlds.world import geometry_digest
from tests.lidarsim.engines.test_laws import SIZES
from tests.scenegen import cases

FIELD = '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1" elevation="0 {} 0 1"/>'
ASSETS = '<asset><mesh name="m" vertex="{}"/>' + FIELD + "</asset>"


def digest(body, *, vertices="0 0 0 1 0 0 0 1 0 0 0 1", height=0.5):
    assets = ASSETS.format(vertices, height)
    world = f"<mujoco>{assets}<worldbody>{body}</worldbody></mujoco>"
    return geometry_digest(solids_of(mujoco.MjModel.from_xml_string(world)))


A = 'type="box" size="1 2 3" quat="0.8 0.6 0 0" pos="1 2 3"'
B = 'type="cylinder" size="1 2" pos="4 0 0"'
SAME, OTHERS = (
    [element.format(a=A, b=B) for (element,) in cases(f"worlds/{table}")]
    for table in ("same", "others")
)


@pytest.mark.parametrize("same", SAME)
def test_only_solids_and_their_places_matter(same):
    """No names, order, bodies, colours or ways to place; a geom stands where its body does in the
    reference configuration."""
    assert digest(f"<geom {A}/><geom {B}/>") == digest(same)


@pytest.mark.parametrize("other", OTHERS)
def test_other_solids_have_another_digest(other):
    assert digest(f"<geom {A}/><geom {B}/>") != digest(other)


def test_every_number_of_a_size_counts():
    for shape, size in SIZES.items():
        numbers, geom = size.split(), f'<geom type="{shape}" size="{{}}"/>'.format
        for n in range(len(numbers)):
            other = " ".join([*numbers[:n], f"{numbers[n]}001", *numbers[n + 1 :]])
            assert (digest(geom(size)) == digest(geom(other))) == (shape == "plane"), (shape, n)


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
