"""Binary glTF: files written here by hand, whose corners NumPy and SciPy put where the
specification says."""

import json
import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from scenegen.base.errors import SceneError
from scenegen.worlds.gltf import read_gltf
from scenegen.worlds.scene import load_scene
from scenegen.worlds.world import compile_world
from tests.scenegen import cases, refuses

CODES = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
HALF_TURN = Rotation.from_euler("xyz", [0.3, -0.8, 2.5])


class File:
    """A file that grows by accessors, and its document, for a test to change."""

    def __init__(self, **document):
        self.binary, self.document = b"", {"asset": {"version": "2.0"}, "buffers": [{}]}
        self.document |= {"accessors": [], "bufferViews": [], "meshes": [], "scenes": [{}]}
        self.document |= document

    def view(self, values, stride=0):
        """The number of a new buffer view, its rows `stride` bytes apart, after an odd offset."""
        flat = np.ascontiguousarray(values).reshape(len(values), -1)
        lines = [row.tobytes().ljust(stride, b"\xff") for row in flat]
        self.binary += b"\xee" * 4
        view = {"buffer": 0, "byteOffset": len(self.binary)}
        self.binary += b"".join(lines)
        view["byteLength"] = len(self.binary) - view["byteOffset"]
        self.document["bufferViews"].append(view | ({"byteStride": stride} if stride else {}))
        return len(self.document["bufferViews"]) - 1

    def numbers(self, values, *, stride=0, **more):
        """The number of a new accessor."""
        values = np.asarray(values)
        accessor = {
            "bufferView": self.view(values, stride),
            "componentType": CODES[values.dtype.char],
            "type": TYPES[values[0].size],
            "count": len(values),
        }
        self.document["accessors"].append(accessor | more)
        return len(self.document["accessors"]) - 1

    def mesh(self, position, **primitive):
        """The number of a new mesh, of the `FACES` of corners in an accessor."""
        attributes = {"POSITION": position} | primitive.pop("attributes", {})
        if "mode" not in primitive:
            primitive["indices"] = self.numbers(FACES.reshape(-1).astype("B"))
        self.document["meshes"].append({"primitives": [{"attributes": attributes} | primitive]})
        return len(self.document["meshes"]) - 1

    def encoded(self, nodes, roots=None):
        """The content of the file."""
        self.document["nodes"] = nodes
        self.document["scenes"][0]["nodes"] = [*range(len(nodes))] if roots is None else roots
        self.document["buffers"][0].setdefault("byteLength", len(self.binary))
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        strange = struct.pack("<I4s", 4, b"ODD\0") + b"none"  # chunks of other kinds are passed by
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + strange
        chunks += struct.pack("<I4s", len(self.binary), b"BIN\0") + self.binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def floats(values):
    return np.asarray(values, "f")


def placed(file, nodes, roots=None):
    """Corners of every object of a file."""
    return [corners for _, corners, _ in read_gltf(file.encoded(nodes, roots)).objects()]


QUANTISED = [
    (
        "h",
        True,
        [[32767, -32767, -32768], [16384, 0, 1]],
        [[1, -1, -1], [16384 / 32767, 0, 1 / 32767]],
    ),
    ("b", True, [[127, -127, -128], [64, 0, 1]], [[1, -1, -1], [64 / 127, 0, 1 / 127]]),
    ("H", True, [[65535, 0, 32768]], [[1, 0, 32768 / 65535]]),
    ("B", True, [[255, 0, 51]], [[1, 0, 0.2]]),
    ("h", False, [[32767, -32768, 5]], [[32767, -32768, 5]]),
    ("H", False, [[65535, 0, 5]], [[65535, 0, 5]]),
    ("b", False, [[127, -128, 5]], [[127, -128, 5]]),
    ("B", False, [[255, 0, 5]], [[255, 0, 5]]),
]


@pytest.mark.parametrize(("kind", "normalized", "stored", "meant"), QUANTISED)
def test_integers_are_the_numbers_that_they_stand_for(kind, normalized, stored, meant):
    """With the scale and the place of the node that undo the quantisation, as tools write them."""
    file = File(extensionsRequired=["KHR_mesh_quantization"])
    corners = np.resize(np.array(stored, kind), (4, 3))
    mesh = file.mesh(file.numbers(corners, stride=8, normalized=normalized))
    scale, move = [20.0, 20.0, 5.0], [3.0, -1.0, 0.5]
    found = placed(file, [{"mesh": mesh, "scale": scale, "translation": move}])
    assert_allclose(found, [np.resize(meant, (4, 3)) * scale + move], rtol=1e-15)


@pytest.mark.parametrize("kind", ["f", "h", "b"])
def test_a_mesh_stands_where_each_of_its_instances_is(kind, rng):
    """By matrices of SciPy, in the frame of a node that is turned, too."""
    moves, scales = rng.uniform(-9, 9, (5, 3)), rng.uniform(0.5, 3, (5, 3))
    turns = Rotation.random(5, rng=rng).as_quat()
    most = {"f": 1.0, "h": 32767.0, "b": 127.0}[kind]
    stored = (turns if kind == "f" else np.rint(turns * most)).astype(kind)
    file = File(extensionsUsed=["EXT_mesh_gpu_instancing"])
    attributes = {
        "TRANSLATION": file.numbers(floats(moves)),
        "ROTATION": file.numbers(stored, normalized=kind != "f"),
        "SCALE": file.numbers(floats(scales)),
    }
    node = {
        "mesh": file.mesh(file.numbers(floats(CORNERS))),
        "translation": [1, 2, 3],
        "rotation": HALF_TURN.as_quat().tolist(),
        "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}},
    }
    expected = [
        HALF_TURN.apply(Rotation.from_quat(turn).apply(CORNERS * scale) + move)
        + np.array([1, 2, 3])
        for move, turn, scale in zip(moves, stored.astype(float), scales, strict=True)
    ]
    assert_allclose(placed(file, [node]), expected, atol=1e-6)


def test_nodes_move_what_is_below_them():
    """Also a node that holds a camera; what is not in the scene is left out."""
    matrix = np.eye(4)
    matrix[:3] = [[0, -2, 0, 7], [2, 0, 0, 8], [0, 0, 2, 9]]
    file = File(cameras=[{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}])
    mesh = file.mesh(file.numbers(floats(CORNERS)))
    nodes = [
        {"matrix": matrix.T.reshape(-1).tolist(), "children": [1], "camera": 0},
        {"translation": [1, 0, 0], "scale": [1, 3, 1], "mesh": mesh},
        {"mesh": mesh},
    ]
    local = CORNERS * [1, 3, 1] + [1, 0, 0]
    expected = np.stack([7 - 2 * local[:, 1], 8 + 2 * local[:, 0], 9 + 2 * local[:, 2]], axis=1)
    assert_allclose(placed(file, nodes, roots=[0]), [expected])


@pytest.mark.parametrize("scale", [[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [-1, -2, -3]])
def test_a_mirrored_mesh_keeps_its_outside(scale):
    file = File()
    mesh = file.mesh(file.numbers(floats(CORNERS)))
    ((_, corners, faces),) = read_gltf(file.encoded([{"mesh": mesh, "scale": scale}])).objects()
    a, b, c = corners[faces].transpose(1, 0, 2)
    # six times its volume, positive where triangles are counter-clockwise seen from outside
    assert (a * np.cross(b, c)).sum() == pytest.approx(abs(np.prod(scale)))


def test_meshes_that_bend_are_left_out_and_counted():
    file = File()
    mesh = file.mesh(file.numbers(floats(CORNERS)))
    nodes = [{"mesh": mesh, "skin": 0}, {"mesh": mesh, "weights": [0, 2]}, {"mesh": mesh}]
    gltf = read_gltf(file.encoded(nodes))
    assert len(list(gltf.objects())) == 1
    assert list(gltf.notes()) == [
        "meshes that bend, by a skin or by morph targets (2), are left out"
    ]
    file.document["meshes"][mesh]["weights"] = [0.5]
    assert not list(read_gltf(file.encoded(nodes)).objects())


def test_a_quantised_and_instanced_file_is_a_world(tmp_path):
    """In metres, z up, as MuJoCo compiles it; colours' extensions may be required."""
    required = ["KHR_mesh_quantization", "EXT_mesh_gpu_instancing", "KHR_materials_unlit"]
    file = File(extensionsRequired=required, extensionsUsed=[*required, "ADA_waves"])
    file.document["animations"] = [{}]
    attributes = {"TRANSLATION": file.numbers(floats([[0, 0, 0], [4, 0, 0], [0, 0, -8]]))}
    node = {
        "mesh": file.mesh(file.numbers((32767 * CORNERS).astype("h"), normalized=True)),
        "scale": [2, 2, 2],
        "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}},
    }
    path = tmp_path / "posts.glb"
    path.write_bytes(file.encoded([node]))
    scene = load_scene(path)
    assert [note.partition(":")[2] for note in scene.notes] == [
        " glTF extensions that the file does not require are not read: ADA_waves",
        " animations (1) are not played: nothing moves",
    ]
    solids = compile_world(scene.mjcf, scene.assets).solids
    assert solids.mesh_filled.tolist() == [True] * 3
    upright = np.stack([CORNERS[:, 0], -CORNERS[:, 2], CORNERS[:, 1]], axis=1)
    expected = [2 * upright + move for move in ([0, 0, 0], [8, 0, 0], [0, 16, 0])]
    found = solids.triangles.reshape(3, -1, 3)
    assert_allclose(found.min(axis=1), np.min(expected, axis=1), atol=1e-6)
    assert_allclose(found.max(axis=1), np.max(expected, axis=1), atol=1e-6)


@pytest.mark.parametrize(("change", "line"), cases("worlds/gltf"))
def test_what_cannot_be_read_ends_in_a_line(tmp_path, change, line):
    file = File()
    mesh = file.mesh(file.numbers(floats(CORNERS)))
    content = file.encoded([{"mesh": mesh}, {}])
    assert len(list(read_gltf(content).objects())) == 1
    document = file.document | json.loads(change)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + struct.unpack_from("<I", content, 12)[0] :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    (tmp_path / "a.glb").write_bytes(head + text + rest)
    with pytest.raises(SceneError) as error:
        load_scene(tmp_path / "a.glb")
    assert line in str(error.value)
    assert str(error.value).startswith(f"{tmp_path}/a.glb: ")


@pytest.mark.parametrize(
    ("damage", "line"),
    [
        (lambda content: b"glTF", "does not begin as a binary glTF file"),
        (lambda content: content[:-1], "bytes; copy it again"),
        (lambda content: content[:4] + b"\1" + content[5:], "is glTF 1; expected glTF 2.0"),
    ],
)
def test_a_file_that_is_cut_or_old_is_named(tmp_path, damage, line):
    file = File()
    content = file.encoded([{"mesh": file.mesh(file.numbers(floats(CORNERS)))}])
    (tmp_path / "a.glb").write_bytes(damage(content))
    refuses(line, load_scene, tmp_path / "a.glb")
