"""A world taken out of a dataset is what it was in there, and nothing of the user's is replaced for
it."""

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal
from PIL import Image

from scenegen.dataset.archive import DOCUMENT, write_extracted
from scenegen.worlds.scene import load_scene
from tests.scenegen import refuses
from tests.scenegen.conftest import names

SCENE = """
<mujoco>
  <compiler meshdir="meshes" angle="radian"/>
  <asset><mesh name="m" file="m.obj"/><hfield name="h" file="h.png" size="2 2 1 0.1"/></asset>
  <worldbody>
    <geom type="mesh" mesh="m" pos="0 0 2" euler="0.1 0.2 0.3"/>
    <geom type="hfield" hfield="h" pos="4 0 0"/>
  </worldbody>
</mujoco>
"""


MODEL = "geom_pos geom_quat geom_size mesh_vert mesh_face hfield_data"


@pytest.fixture
def files(tmp_path):
    """A world with a mesh and a height field, as `Dataset.world` gives it."""
    (tmp_path / "scene" / "meshes").mkdir(parents=True)
    (tmp_path / "scene" / "scene.xml").write_text(SCENE)
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "scene" / "meshes" / "m.obj")
    heights = np.random.default_rng(0).integers(0, 255, (8, 8, 1), dtype=np.uint8)
    Image.fromarray(np.repeat(heights, 3, axis=2)).save(tmp_path / "scene" / "meshes" / "h.png")
    scene = load_scene(tmp_path / "scene" / "scene.xml")
    return {DOCUMENT: scene.mjcf, **scene.assets}


def test_its_files_go_into_a_folder_of_their_own_and_it_compiles_to_the_same(files, tmp_path):
    output = tmp_path / "new" / "my world.xml"
    for _ in range(2):  # what is there already, and the same, is no hindrance
        write_extracted(files, output)
    assert names(output.parent) == {"my world.xml", "my world.files"}
    assert names(output.with_suffix(".files")) == files.keys() - {DOCUMENT}
    assets = {name: content for name, content in files.items() if name != DOCUMENT}
    archived = mujoco.MjModel.from_xml_string(files[DOCUMENT].decode(), assets)
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
    refuses(
        r"train.py: is there and another file; give another -o",
        write_extracted,
        theirs,
        tmp_path / "world.xml",
    )
    assert within.read_text() == "mine"
    (tmp_path / "other.files").write_text("mine")
    refuses("choose another place", write_extracted, files, tmp_path / "other.xml")
