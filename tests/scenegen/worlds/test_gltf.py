"""Binary glTF: files written here by hand, whose corners NumPy and SciPy put where the
specification says."""

import json
import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from scenegen.worlds.gltf import read_gltf
from scenegen.worlds.scene import load_scene
from scenegen.worlds.world import compile_world
from tests.refusals import refuses
from tests.scenegen import each_case

CODES = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "f")
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "B")
INSTANCES = "EXT_mesh_gpu_instancing"


class File:
    """A file of one mesh, which grows by accessors, and its document, for a test to change."""

    def __init__(self, corners=CORNERS, *, stride=0, normalized=False, **document):
        self.binary, self.document = b"", {"asset": {"version": "2.0"}, "scenes": [{}]}
        self.document |= {"accessors": [], "bufferViews": [], **document}
        attributes = {"POSITION": self.add(corners, stride=stride, normalized=normalized)}
        primitive = {"attributes": attributes, "indices": self.add(FACES.reshape(-1, 1))}
        self.document["meshes"] = [{"primitives": [primitive]}]

    def add(self, values, *, stride=0, normalized=False):
        """The number of a new accessor, its rows `stride` bytes apart, after an odd offset."""
        views, accessors = self.document["bufferViews"], self.document["accessors"]
        content = b"".join(row.tobytes().ljust(stride, b"\xff") for row in values)
        self.binary += b"\xee" * 4
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        views.append(view | ({"byteStride": stride} if stride else {}))
        self.binary += content
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        accessor = {"bufferView": len(views) - 1, "componentType": CODES[values.dtype.char]}
        accessors.append(accessor | {"type": kind, "count": len(values), "normalized": normalized})
        return len(accessors) - 1

    def encoded(self, *nodes, roots=None, **changes):
        """The content of the file, parts of its document changed."""
        self.document["nodes"] = nodes
        self.document["scenes"][0]["nodes"] = [*range(len(nodes))] if roots is None else roots
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.document | changes).encode()
        text += b" " * (-len(text) % 4)
        chunks = b""  # those of other kinds are passed by
        for kind, data in ((b"JSON", text), (b"ODD\0", b"none"), (b"BIN\0", self.binary)):
            chunks += struct.pack("<I4s", len(data), kind) + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def placed(self, *nodes, **options):
        """Corners of every object."""
        objects = read_gltf(self.encoded(*nodes, **options)).objects()
        return [corners for _, corners, _ in objects]


@pytest.mark.parametrize("kind", "bBhH")
@pytest.mark.parametrize("normalized", [True, False])
def test_integers_are_the_numbers_they_stand_for(kind, normalized):
    """With the scale and the place of the node that undo the quantisation, as tools write them."""
    limits = np.iinfo(kind)
    corners = np.resize(np.array([limits.min, limits.max, 5, limits.min + 1, 0], kind), (4, 3))
    extensions = {"extensionsRequired": ["KHR_mesh_quantization"]}
    file = File(corners, stride=8, normalized=normalized, **extensions)
    expected = np.maximum(corners / limits.max, -1) if normalized else corners
    scale, move = [20.0, 20.0, 5.0], [3.0, -1.0, 0.5]
    actual = file.placed({"mesh": 0, "scale": scale, "translation": move})
    assert_allclose(actual, [expected * scale + move], rtol=1e-15)


@pytest.mark.parametrize("kind", "fhb")
def test_a_mesh_stands_where_each_instance_is(kind, rng):
    """By matrices of SciPy, in the frame of a node that is turned, too."""
    moves, scales = rng.uniform(-9, 9, (5, 3)), rng.uniform(0.5, 3, (5, 3))
    turns, half = Rotation.random(5, rng=rng).as_quat(), Rotation.from_euler("xyz", [0.3, -0.8, 2])
    stored = (turns if kind == "f" else np.rint(turns * np.iinfo(kind).max)).astype(kind)
    file = File(extensionsUsed=[INSTANCES])
    attributes = {
        "TRANSLATION": file.add(moves.astype("f")),
        "ROTATION": file.add(stored, normalized=kind != "f"),
        "SCALE": file.add(scales.astype("f")),
    }
    node = {
        "mesh": 0,
        "translation": [1, 2, 3],
        "rotation": half.as_quat().tolist(),
        "extensions": {INSTANCES: {"attributes": attributes}},
    }
    expected = [
        half.apply(Rotation.from_quat(turn).apply(CORNERS * scale) + move) + np.arange(1, 4)
        for move, turn, scale in zip(moves, stored.astype(float), scales, strict=True)
    ]
    assert_allclose(file.placed(node), expected, atol=1e-6)


def test_nodes_move_what_is_below_them():
    """Also a node that holds a camera; what is not in the scene is left out."""
    matrix = np.array([[0, 2, 0, 0], [-2, 0, 0, 0], [0, 0, 2, 0], [7, 8, 9, 1]])  # its columns
    file = File(cameras=[{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}])
    nodes = [
        {"matrix": matrix.ravel().tolist(), "children": [1], "camera": 0},
        {"translation": [1, 0, 0], "scale": [1, 3, 1], "mesh": 0},
        {"mesh": 0},
    ]
    expected = (CORNERS * [1, 3, 1] + [1, 0, 0]) @ matrix[:3, :3] + matrix[3, :3]
    assert_allclose(file.placed(*nodes, roots=[0]), [expected])


@each_case("worlds/scales", "scale", json.loads)
def test_a_mirrored_mesh_keeps_its_outside(scale):
    objects = read_gltf(File().encoded({"mesh": 0, "scale": scale})).objects()
    ((_, corners, faces),) = objects
    a, b, c = corners[faces].transpose(1, 0, 2)
    # six times its volume, positive where triangles are counter-clockwise seen from outside
    assert (a * np.cross(b, c)).sum() == pytest.approx(abs(np.prod(scale)))


def test_meshes_that_bend_are_left_out():
    file = File()
    nodes = {"mesh": 0, "skin": 0}, {"mesh": 0, "weights": [0, 2]}, {"mesh": 0}
    gltf = read_gltf(file.encoded(*nodes))
    assert len(list(gltf.objects())) == 1
    note = "meshes that bend, by a skin or by morph targets (2), are left out"
    assert list(gltf.notes()) == [note]
    file.document["meshes"][0]["weights"] = [0.5]
    assert not file.placed(*nodes)


def test_what_a_world_leaves_out_is_noted(tmp_path):
    """Colours' extensions may be required."""
    required = ["KHR_mesh_quantization", INSTANCES, "KHR_materials_unlit"]
    extensions = {"extensionsRequired": required, "extensionsUsed": [*required, "ADA_waves"]}
    path = tmp_path / "posts.glb"
    path.write_bytes(File(animations=[{}], **extensions).encoded({"mesh": 0, "scale": [2, 2, 2]}))
    scene = load_scene(path)
    assert [note.partition(":")[2] for note in scene.notes] == [
        " glTF extensions that the file does not require are not read: ADA_waves",
        " animations (1) are not played: nothing moves",
    ]
    solids = compile_world(scene.mjcf, scene.assets).solids
    assert solids.mesh_filled.tolist() == [True]
    corners = solids.triangles.reshape(-1, 3)  # z is up: it was y, and what was z is -y
    assert_allclose([corners.min(axis=0), corners.max(axis=0)], [[0, -2, 0], [2, 0, 2]], atol=1e-6)


@each_case("worlds/gltf", "change")
def test_what_cannot_be_read_is_refused(tmp_path, change):
    content = File().encoded({"mesh": 0}, {}, **json.loads(change))
    (tmp_path / "a.glb").write_bytes(content)
    assert refuses(change, load_scene, tmp_path / "a.glb").startswith(f"{tmp_path}/a.glb: ")


def test_a_file_that_is_cut_or_old_is_refused(tmp_path):
    good, path = File().encoded({"mesh": 0}), tmp_path / "a.glb"
    old = good.replace(b"glTF\2", b"glTF\1")
    for case, content in {"no file": b"glTF", "cut": good[:-1], "old": old}.items():
        path.write_bytes(content)
        refuses(case, load_scene, path)
