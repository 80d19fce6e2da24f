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
from scenegen.draw.source import read_scenes
from scenegen.worlds.scene import load_scene
from scenegen.worlds.screen import screen
from scenegen.worlds.world import compile_world, quiet_mujoco
from tests.command_line import beside
from tests.lidarsim.reference import unit
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.truth.test_occupancy import punctured_ball, touching_blocks

ONE = {"train": 1, "val": 0, "test": 0}
NOWHERE = '<mujoco><worldbody><geom size="1" pos="nan 0 0"/></worldbody></mujoco>'
ASSET = """<mujoco><asset><{kind} name="a" {attributes}/></asset>
<worldbody><geom type="{kind}" {kind}="a"/></worldbody></mujoco>"""


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


def document(name):
    """A file beside the tests."""
    return beside(__file__, f"mjcf/{name}.xml")


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
    write(tmp_path, document("robot"), "sub/robot.xml")
    (tmp_path / "sub" / "parts").mkdir()
    trimesh.creation.torus(1.0, 0.3).export(tmp_path / "sub" / "parts" / "arm.obj")
    trimesh.creation.box((3, 3, 3)).export(tmp_path / "arm.obj")
    for assets in ('<mesh name="other" file="arm.obj"/>', ""):
        path = write(tmp_path, document("attaching").format(assets=assets))
        scene = assert_as_mujoco_compiles_it(path)
        assert len(scene.assets) == 1
        note = "world.xml: joints (1) stay in their reference position: nothing moves"
        assert scene.notes == (note,)
        (tmp_path / "arm.obj").unlink(missing_ok=True)


def test_every_kind_of_geom_lies_where_mujoco_puts_it(tmp_path):
    trimesh.creation.torus(1.5, 0.4).export(tmp_path / "ring.stl")
    heights = np.random.default_rng(0).random((9, 7)).astype(np.float32)
    (tmp_path / "hill.bin").write_bytes(np.array([9, 7], np.int32).tobytes() + heights.tobytes())
    scene = assert_as_mujoco_compiles_it(write(tmp_path, document("every_kind")))
    assert scene.unseen == ("pane",)
    screen(scene.mjcf, scene.assets, "what generate archives, verify takes")


def test_what_only_dresses_geoms_is_not_needed(tmp_path):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    scene = load_scene(write(tmp_path, document("dressing")))
    assert scene.unseen == ("ghost",)
    note = "world.xml: skins (1) are left out: they dress bodies, and rays do not see them"
    assert scene.notes == (note,)
    assert [name.rpartition("-")[2] for name in scene.assets] == ["m.msh"]


@pytest.mark.parametrize("dress", ["texture t", "skin s", "material m", "light l"])
@each_case("worlds/referring", "name element")
def test_what_refers_to_textures_and_skins_is_valid(tmp_path, name, element, dress):
    """Lights, tuples and sensors, in the file itself and in a model that it attaches."""
    kind, object_name = dress.split()
    text = document("lamp").format(element.format(type=kind, name=object_name))
    assert_as_mujoco_compiles_it(write(tmp_path, text, "lamp.xml"))
    assert_as_mujoco_compiles_it(write(tmp_path, document("attaching_lamp")))


def test_memory_beside_geoms_is_not_taken(tmp_path):
    """MuJoCo would fill gigabytes, for as long as a reader's limits let it."""
    text = """<mujoco><size nuserdata="2000000000" nkey="100000000"/><worldbody>
    <geom size="1"/></worldbody></mujoco>"""
    assert len(compile_world(load_scene(write(tmp_path, text)).mjcf).solids) == 1


def test_plugins_that_move_things_are_left_out(tmp_path):
    path = write(tmp_path, document("plugin"))
    (scene,) = read_scenes(path, ONE, seed=0).scenes["train"]
    screen(scene.mjcf, scene.assets, "taken")
    assert b"plugin" not in scene.mjcf


def test_open_meshes_are_noted(tmp_path):
    """Boxes that share an edge are closed."""
    touching_blocks().export(tmp_path / "touching.obj")
    punctured_ball().export(tmp_path / "open.obj")
    scene = load_scene(write(tmp_path, document("meshes")))
    solids = compile_world(scene.mjcf, scene.assets).solids
    assert solids.mesh_filled.tolist() == [True, False]
    (note,) = scene.notes
    assert "mesh open is not closed" in note


@each_case("worlds/no_world", "kind element")
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


@each_case("worlds/scene", "element")
def test_the_screen_refuses_what_generate_refuses(element):
    assets = {"f.bin": np.array([65536, 65536, 0], np.int32).tobytes()}
    document = f"<mujoco>{element}</mujoco>".encode()
    refuses(element, screen, document, assets, "w")


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
