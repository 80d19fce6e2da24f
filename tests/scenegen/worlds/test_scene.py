"""A stranger's MJCF: what MuJoCo makes of it is what is archived, and harm ends in one line, soon,
without a trace."""

import os
import warnings

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

import scenegen.draw.source
from lidarsim import MujocoEngine
from scenegen.base.errors import CorruptFileError
from scenegen.draw.source import read_scenes
from scenegen.worlds.scene import load_scene
from scenegen.worlds.screen import screen
from scenegen.worlds.world import compile_world, quiet_mujoco
from tests.lidarsim.reference import unit
from tests.refusals import refuses
from tests.scenegen import cases

ONE = {"train": 1, "val": 0, "test": 0}
NOWHERE = '<mujoco><worldbody><geom size="1" pos="nan 0 0"/></worldbody></mujoco>'
ASSET = """<mujoco><asset><{kind} name="a" {attributes}/></asset>
<worldbody><geom type="{kind}" {kind}="a"/></worldbody></mujoco>"""
ATTACHED = """<mujoco><asset>{assets}<model name="robot" file="sub/robot.xml"/></asset><worldbody>
<geom type="box" size="1 2 3" pos="5 0 1.23456789"/>
<frame pos="-4 1 2" euler="10 20 30"><attach model="robot" body="arm" prefix="r/"/></frame>
</worldbody></mujoco>"""
ROBOT = """<mujoco><compiler meshdir="parts"/><asset>
<mesh name="arm" file="arm.obj" scale="1 1.2345678 1"/></asset><worldbody>
<body name="arm" pos="0 0 1"><joint name="j"/><geom type="mesh" mesh="arm"/></body>
</worldbody></mujoco>"""


SIDES = "right", "left", "up", "down", "front", "back"


@pytest.fixture(autouse=True)
def no_trace(elsewhere, capfd):
    """Nothing is printed, nothing left in the working folder, no warning raised."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        warnings.filterwarnings(
            "ignore", r"This process .* is multi-threaded"
        )  # by pytest-xdist; Python 3.12 tells
        yield
    assert [str(warning.message) for warning in told] == []
    assert "".join(capfd.readouterr()) == ""


def write(folder, text, name="world.xml"):
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def assert_as_mujoco_compiles_it(path):
    """The archived document gives the rays of MuJoCo's own model of the file, planes infinite, from
    all around."""
    scene, plain = load_scene(path), mujoco.MjModel.from_xml_path(str(path))
    plain.geom_size[plain.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = 0
    rng = np.random.default_rng(0)
    origins = rng.uniform(-10, 10, (8, 3))
    rays = unit(rng.uniform(-6, 6, (8, 100, 3)) - origins[:, None])
    models = compile_world(scene.mjcf, scene.assets).model, plain
    ours, own = (MujocoEngine.of(model).cast(origins, rays, 100.0) for model in models)
    assert_allclose(ours, own, rtol=0, atol=1e-5)
    return scene


def test_an_attached_model_keeps_its_mesh(tmp_path):
    """Beside a namesake of the file that attaches it."""
    (tmp_path / "sub" / "parts").mkdir(parents=True)
    trimesh.creation.torus(1.0, 0.3).export(tmp_path / "sub" / "parts" / "arm.obj")
    trimesh.creation.box((3, 3, 3)).export(tmp_path / "arm.obj")
    write(tmp_path, ROBOT, "sub/robot.xml")
    for assets in ('<mesh name="other" file="arm.obj"/>', ""):
        scene = assert_as_mujoco_compiles_it(write(tmp_path, ATTACHED.format(assets=assets)))
        assert len(scene.assets) == 1
        note = "world.xml: joints (1) stay in their reference position: nothing moves"
        assert scene.notes == (note,)
        (tmp_path / "arm.obj").unlink(missing_ok=True)


def test_every_kind_of_geom_lies_where_mujoco_puts_it(tmp_path):
    trimesh.creation.torus(1.5, 0.4).export(tmp_path / "ring.stl")
    heights = np.random.default_rng(0).random((9, 7)).astype(np.float32)
    (tmp_path / "hill.bin").write_bytes(np.array([9, 7], np.int32).tobytes() + heights.tobytes())
    path = write(
        tmp_path,
        """<mujoco><compiler angle="radian" eulerseq="zyx"/>
        <default><geom rgba="1 0 0 1"/></default>
        <asset><mesh name="ring" file="ring.stl" scale="0.7 1.3 1" refpos="0.1 0.2 0.3"/>
        <hfield name="hill" file="hill.bin" size="3 2 1 0.3"/>
        <material name="glass" rgba="0 0 0 0"/></asset>
        <worldbody><geom type="plane" size="1 1 1" pos="0 0 -4" euler="0.1 0.2 0"/>
        <body pos="1 2 3" euler="0.3 0.4 0.5"><joint type="ball"/>
        <geom type="capsule" fromto="0 0 0 1 2 1" size="0.3"/>
        <body pos="-2.123456789 0 0.1" quat="1 2 3 4"><geom type="mesh" mesh="ring"/>
        <geom type="box" mesh="ring"/></body></body>
        <geom type="ellipsoid" size="1 2 0.5" pos="-5 0 0" axisangle="1 1 0 0.7"/>
        <geom type="hfield" hfield="hill" pos="0 -4 0" euler="0.2 0 0"/>
        <geom name="pane" type="sphere" size="3" pos="0 0 8" material="glass"/>
        <replicate count="5" offset="1 0 0.1"><geom type="cylinder" size="0.2 1" pos="-2 5 0"/>
        </replicate>
        </worldbody></mujoco>""",
    )
    scene = assert_as_mujoco_compiles_it(path)
    assert scene.unseen == ("pane",)
    screen(scene.mjcf, scene.assets, "what generate archives, verify takes")


def test_what_only_dresses_geoms_is_not_needed(tmp_path):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    sides = " ".join(
        f'file{side}="no.png"' for side in ["right", "left", "up", "down", "front", "back"]
    )
    text = f"""<mujoco><compiler strippath="true"/><asset>
    <mesh name="m" file="/no/such/folder/box.stl"/>
    <texture name="t" type="cube" {sides}/>
    <material name="seen" texture="t" rgba="1 1 1 0.5"/>
    <material name="hidden" texture="t" rgba="1 1 1 0"/></asset>
    <deformable><skin name="s" file="dog.skn"/></deformable>
    <worldbody><geom type="mesh" mesh="m" material="seen"/>
    <geom name="ghost" size="1" material="hidden"/></worldbody></mujoco>"""
    scene = load_scene(write(tmp_path, text))
    assert scene.unseen == ("ghost",)
    note = "world.xml: skins (1) are left out: they dress bodies, and rays do not see them"
    assert scene.notes == (note,)
    assert [name.rpartition("-")[2] for name in scene.assets] == ["m.msh"]


DRESSED = """<mujoco model="lamp"><asset>
<texture name="t" type="2d" builtin="checker" width="8" height="8"/>
<texture name="c" type="cube" builtin="flat" width="8" height="8"/>
<material name="m" texture="t"/>
<material name="layers"><layer texture="t" role="rgb"/><layer texture="c" role="normal"/></material>
<skin name="s" material="m" vertex="0 0 0 1 0 0 0 1 0" face="0 1 2">
<bone body="b" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin></asset>
<worldbody><body name="b" pos="0 1 2"><light name="l" texture="t"/>
<geom type="box" size="1 2 3" material="m"/><site name="site" size="1" material="layers"/></body>
<replicate count="3" offset="2 0 0"><geom size="0.5" material="layers"/></replicate></worldbody>
{}</mujoco>"""


@pytest.mark.parametrize("dress", ["texture t", "skin s", "material m", "light l"])
@pytest.mark.parametrize(("name", "element"), cases("worlds/referring"))
def test_what_refers_to_textures_and_skins_is_valid(tmp_path, name, element, dress):
    """Lights, tuples and sensors, in the file itself and in a model that it attaches."""
    kind, object_name = dress.split()
    text = DRESSED.format(element.format(type=kind, name=object_name))
    assert_as_mujoco_compiles_it(write(tmp_path, text))
    attached = """<mujoco><asset><model name="lamp" file="world.xml"/></asset><worldbody>
    <geom size="1" pos="9 0 0"/><attach model="lamp" body="b" prefix="x/"/></worldbody></mujoco>"""
    assert_as_mujoco_compiles_it(write(tmp_path, attached, "attached.xml"))


def test_memory_beside_geoms_is_not_taken(tmp_path):
    """MuJoCo would fill gigabytes, for as long as a reader's limits let it."""
    text = """<mujoco><size nuserdata="2000000000" nkey="100000000"/><worldbody>
    <geom size="1"/></worldbody></mujoco>"""
    assert len(compile_world(load_scene(write(tmp_path, text)).mjcf).solids) == 1


def test_plugins_that_move_things_are_left_out_of_what_is_archived(tmp_path):
    text = """<mujoco><extension><plugin plugin="mujoco.pid"/></extension>
    <compiler settotalmass="3"/><worldbody><body><joint name="j"/><geom size="1"/></body>
    </worldbody><actuator><plugin joint="j" plugin="mujoco.pid"/></actuator></mujoco>"""
    (scene,) = read_scenes(write(tmp_path, text), ONE, seed=0).scenes["train"]
    screen(scene.mjcf, scene.assets, "taken")
    assert b"plugin" not in scene.mjcf


def test_open_meshes_are_noted(tmp_path):
    """Boxes that share an edge are closed."""
    box, other = trimesh.creation.box((2, 2, 2)), trimesh.creation.box((2, 2, 2))
    other.apply_translation((2, 2, 0))
    touching = trimesh.util.concatenate([box, other])
    touching.merge_vertices()
    touching.export(tmp_path / "touching.obj")
    trimesh.Trimesh(box.vertices, box.faces[2:]).export(tmp_path / "open.obj")
    text = """<mujoco><asset><mesh name="touching" file="touching.obj"/>
    <mesh name="open" file="open.obj" inertia="shell"/></asset><worldbody>
    <geom type="mesh" mesh="touching"/><geom type="mesh" mesh="open" pos="9 0 0"/></worldbody>
    </mujoco>"""
    scene = load_scene(write(tmp_path, text))
    solids = compile_world(scene.mjcf, scene.assets).solids
    assert solids.mesh_filled.tolist() == [True, False]
    (note,) = scene.notes
    assert "mesh open is not closed" in note


@pytest.mark.parametrize(("kind", "element"), cases("worlds/no_world"))
def test_what_no_world_can_have_is_refused(tmp_path, monkeypatch, kind, element):
    """Soon, and whatever memory it asks for, for MuJoCo reads it in a process with limits."""
    heights = np.zeros((16, 16), np.float32)
    heights[3, 3] = np.nan
    for name, edge in (("nan", 16), ("huge", 65536)):
        content = np.array([edge, edge], np.int32).tobytes() + heights.tobytes()
        (tmp_path / f"{name}.bin").write_bytes(content)
    for name in ("pipe.xml", "pipe.stl"):
        os.mkfifo(tmp_path / name)
    monkeypatch.setattr(scenegen.draw.source, "SCENE_BYTES", 1 << 30)
    if "pipe.stl" in element:
        monkeypatch.setattr(scenegen.draw.source, "SCENE_SECONDS", 1.0)
    text = f"<mujoco><worldbody>{element}</worldbody></mujoco>"
    if kind != "world":
        text = ASSET.format(kind=kind, attributes=element)
    refuses(f"{kind} {element}", read_scenes, write(tmp_path, text), ONE, seed=0)


def test_parts_of_a_folder_are_no_worlds(tmp_path):
    folder = tmp_path / "worlds"
    write(folder, '<mujocoinclude><geom size="1"/></mujocoinclude>', "part.xml")
    write(folder, '<mujoco><asset><material name="m"/></asset></mujoco>', "assets.xml")
    for n in range(2):
        body = f'<include file="part.xml"/><geom size="1" material="m" pos="{n + 3} 0 0"/>'
        text = f'<mujoco><include file="assets.xml"/><worldbody>{body}</worldbody></mujoco>'
        write(folder, text, f"world{n}.xml")
    source = read_scenes(folder, {"train": 1, "val": 0, "test": 1}, seed=0)
    names = [scene.name for scenes in source.scenes.values() for scene in scenes]
    assert sorted(names) == ["world0.xml", "world1.xml"]
    note = f"{folder}: assets.xml, part.xml left out: parts, which other files include"
    assert source.notes == (note,)
    refuses("parts alone", read_scenes, folder / "part.xml", ONE, seed=0)


@pytest.mark.parametrize("element", [element for (element,) in cases("worlds/scene")])
def test_the_screen_refuses_what_generate_refuses(element):
    assets = {"f.bin": np.array([65536, 65536, 0], np.int32).tobytes()}
    document = f"<mujoco>{element}</mujoco>".encode()
    refuses(element, screen, document, assets, "w", error=CorruptFileError)


def test_a_users_handler_of_warnings_comes_back():
    before, own = mujoco.get_mju_user_warning(), []
    mujoco.set_mju_user_warning(own.append)
    try:
        with quiet_mujoco() as messages:
            with quiet_mujoco():
                pass
            mujoco.MjModel.from_xml_string(NOWHERE)
        assert messages
        assert own == []
        mujoco.MjModel.from_xml_string(NOWHERE)
        assert own
    finally:
        mujoco.set_mju_user_warning(before)
