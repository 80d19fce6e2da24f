"""Archives of worlds are read by the numbers in their members' names, however many worlds there
are; and a world taken out of one is what it was in there."""

import zipfile

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal
from PIL import Image

from scenegen.dataset.archive import DOCUMENT, open_archive, write_extracted
from scenegen.worlds.scene import load_scene
from tests.command_line import beside
from tests.refusals import refuses
from tests.scenegen.conftest import names


def members_of(path, name):
    """The members of an archive at `path` that has one, a world of this name."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, "<mujoco/>")
    with open(path, "rb") as file, open_archive(file, "a.zip") as members:
        return members.world(name)


def test_a_world_is_found_by_its_number_written_in_one_way(tmp_path):
    for number in ("000000", "000017", "999999", "1000000", "199999999"):
        assert members_of(tmp_path / "a.zip", f"{number}.xml") == (b"<mujoco/>", {})
    for number in (".hidden", "17", "0000017", "1234567890", "00001a", "٠٠٠٠١٧"):
        refuses(number, members_of, tmp_path / "a.zip", f"{number}.xml")


MODEL = "geom_pos geom_quat geom_size mesh_vert mesh_face hfield_data"


@pytest.fixture
def files(tmp_path):
    """A world with a mesh and a height field, as `Dataset.world` gives it."""
    meshes = tmp_path / "scene" / "meshes"
    meshes.mkdir(parents=True)
    (meshes.parent / "scene.xml").write_text(beside(__file__, "archived.xml"))
    trimesh.creation.box((1.0, 2.0, 3.0)).export(meshes / "m.obj")
    heights = np.random.default_rng(0).integers(0, 255, (8, 8, 1), dtype=np.uint8)
    Image.fromarray(np.repeat(heights, 3, axis=2)).save(meshes / "h.png")
    scene = load_scene(meshes.parent / "scene.xml")
    return {DOCUMENT: scene.mjcf, **scene.assets}


def test_its_files_go_into_a_folder_of_their_own_and_it_compiles_to_the_same(files, tmp_path):
    output = tmp_path / "new" / "my world.xml"
    elsewhere = files[DOCUMENT].replace(b"</mujoco>", b'<compiler meshdir="x"/></mujoco>')
    for _ in range(2):  # what is there already, and the same, is no hindrance
        write_extracted(files | {DOCUMENT: elsewhere}, output)
    assert names(output.parent) == {"my world.xml", "my world.files"}
    document = files.pop(DOCUMENT).decode()
    assert names(output.with_suffix(".files")) == files.keys()
    archived = mujoco.MjModel.from_xml_string(document, files)
    taken = mujoco.MjModel.from_xml_path(str(output))
    for name in MODEL.split():
        assert_array_equal(getattr(archived, name), getattr(taken, name), strict=True)


def test_what_stands_beside_the_output_is_left_alone(files, tmp_path):
    """Archived files may have any name, such as that of the user's script."""
    theirs, within = {**files, "train.py": b"theirs"}, tmp_path / "world.files" / "train.py"
    (tmp_path / "train.py").write_text("mine")
    write_extracted(theirs, tmp_path / "world.xml")
    assert (tmp_path / "train.py").read_text() == "mine"
    assert within.read_bytes() == b"theirs"
    within.write_text("mine")
    refuses("another file", write_extracted, theirs, tmp_path / "world.xml")
    assert within.read_text() == "mine"
    (tmp_path / "other.files").write_text("mine")
    refuses("a file for a folder", write_extracted, files, tmp_path / "other.xml")
