"""The triangles of a binary glTF 2.0 file (.glb), where its nodes put them.

All that moves a triangle is read (Khronos, glTF 2.0 specification): nodes, integer and sparse
accessors, strips and fans, morph targets at their default weights, skins, and the extensions
`QUANTIZED` and `INSTANCED`. A file that requires another extension is refused, as the specification
asks, unless the extension concerns colours, textures or lights alone: these are left out.
"""

import base64
import itertools
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lidarsim.grid import Floats, Ints
from lidarsim.parameters import MOST_TRIANGLES
from scenegen.errors import BrokenError, short
from scenegen.files import Json
from scenegen.limits import MOST_GEOMS

QUANTIZED = "KHR_mesh_quantization"
"""Positions as integers. Accessors of integers are read anyway."""
INSTANCED = "EXT_mesh_gpu_instancing"
"""A node's mesh at several places."""
LOOKS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_")
"""How the names of extensions begin that concern colours, textures and lights alone."""
COMPRESSED = (
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
)
"""Extensions that pack a file's numbers."""
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES = 4
"""Mode of a primitive of separate triangles. Those of points and lines are below it."""


@dataclass(frozen=True)
class Gltf:
    """A file's document, and the binary chunk behind it."""

    document: Json
    binary: bytes

    def notes(self) -> Iterator[str]:
        """What is not read, and may move a triangle: a sentence each."""
        used = self.document.get("extensionsUsed", ())
        names = [str(name) for name in used if not _is_read(name) and name not in COMPRESSED]
        if names:
            yield f"glTF extensions that the file does not require are not read: {', '.join(names)}"
        if animations := self.document.get("animations"):
            yield f"animations ({len(animations)}) are not played: nothing moves"

    def objects(self) -> Iterator[tuple[str, Floats, Ints]]:
        """The objects of the file's scene.

        Yields:
            For each primitive of each node's mesh, and each of its instances, a name, its corners
            (n, 3), metres, y up, and its triangles (m, 3), counter-clockwise seen from outside.
        """
        for number, world in self._placed.items():
            node = self.document["nodes"][number]
            if "mesh" not in node:
                continue
            mesh = self.document["meshes"][node["mesh"]]
            name = str(mesh.get("name") or node.get("name") or "")
            # a skinned mesh lies where its joints are, wherever its node is
            places = np.eye(4)[None] if "skin" in node else world @ self._instances(node)
            for primitive in mesh["primitives"]:
                if primitive.get("mode", TRIANGLES) < TRIANGLES:  # points and lines
                    continue
                corners = self._corners(primitive, mesh, node)
                faces = self._faces(primitive, len(corners))
                for place in places:
                    # the outside of what is mirrored stays outside
                    mirrored = np.linalg.det(place[:3, :3]) < 0
                    yield name, _moved(place, corners), faces[:, ::-1] if mirrored else faces

    @cached_property
    def _placed(self) -> dict[int, Floats]:
        """The matrix (4, 4) to the world from each node of the scene, by the node's number, a
        node before its children."""
        nodes, scenes = self.document.get("nodes", []), self.document.get("scenes", [{}])
        roots = scenes[self.document.get("scene", 0)].get("nodes", [])
        placed: dict[int, Floats] = {}
        waiting = [(int(root), np.eye(4)) for root in reversed(roots)]
        while waiting:
            number, parent = waiting.pop()
            if number in placed:
                raise BrokenError(f"node {number} has two parents; export it again")
            node = nodes[number]
            if "matrix" in node:
                local = np.array(node["matrix"], float).reshape(4, 4).T
            else:
                parts = (node.get(name) for name in ("translation", "rotation", "scale"))
                local = _matrices(*(None if part is None else np.array([part]) for part in parts))[
                    0
                ]
            placed[number] = parent @ local
            children = reversed(node.get("children", []))
            waiting += [(int(child), placed[number]) for child in children]
        return placed

    def _instances(self, node: Json) -> Floats:
        """Matrices (n, 4, 4) to a node from each instance of its mesh."""
        extension = node.get("extensions", {}).get(INSTANCED)
        if extension is None:
            return np.eye(4)[None]
        attributes = extension["attributes"]
        if max(self._count(name) for name in attributes.values()) > MOST_GEOMS:
            raise BrokenError(f"has more than {MOST_GEOMS} instances of a mesh; simplify it")
        names = (attributes.get(name) for name in ("TRANSLATION", "ROTATION", "SCALE"))
        return _matrices(*(None if name is None else self.numbers(name) for name in names))

    def _count(self, number: int) -> int:
        """How many elements an accessor has."""
        count: int = self.document["accessors"][number]["count"]
        if not 0 <= count <= 3 * MOST_TRIANGLES:
            raise BrokenError(f"accessor {number} has {short(count)} elements; simplify the file")
        return count

    def _corners(self, primitive: Json, mesh: Json, node: Json) -> Floats:
        """Corners of a primitive (n, 3), in the frame of its node, or of the world if it is
        skinned."""
        attributes = primitive["attributes"]
        corners = self.numbers(attributes["POSITION"])
        weights = node.get("weights") or mesh.get("weights", ())
        for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
            if weight and "POSITION" in target:
                corners = corners + weight * self.numbers(target["POSITION"])
        return self._skinned(corners, attributes, node["skin"]) if "skin" in node else corners

    def _skinned(self, corners: Floats, attributes: Json, number: int) -> Floats:
        """Corners where a skin's joints put them: each by the mean of its joints' matrices."""
        skin = self.document["skins"][number]
        joints = np.array([self._placed[joint] for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            inverse = self.numbers(skin["inverseBindMatrices"])
            joints = joints @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)
        moved, sums = np.zeros_like(corners), np.zeros((len(corners), 1))
        for group in itertools.count():
            if f"JOINTS_{group}" not in attributes:
                return moved / sums
            chosen = self.numbers(attributes[f"JOINTS_{group}"]).astype(int)
            weights = self.numbers(attributes[f"WEIGHTS_{group}"])
            for joint, weight in zip(chosen.T, weights.T[..., None], strict=True):
                moved += weight * _moved(joints[joint], corners)
                sums += weight
        raise AssertionError("numbers do not end")

    def _faces(self, primitive: Json, corners: int) -> Ints:
        """Triangles of a primitive (m, 3), as numbers of its corners."""
        order = np.arange(corners)
        if "indices" in primitive:
            order = self.numbers(primitive["indices"])[:, 0].astype(np.int64)
        match primitive.get("mode", TRIANGLES):
            case 4:
                return order.reshape(-1, 3)
            case 5:  # a strip, of which every other triangle is turned
                faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
                faces[1::2] = faces[1::2, ::-1]
                return faces
            case 6:  # a fan around its first corner
                return np.stack([np.full_like(order[2:], order[0]), order[1:-1], order[2:]], axis=1)
            case mode:
                raise BrokenError(f"has a primitive of mode {short(mode)}; expected 0 to 6")

    def numbers(self, number: int) -> Floats:
        """An accessor's values (count, components): normalised integers as the shares from -1 to 1
        that they stand for, other integers as they are."""
        accessor = self.document["accessors"][number]
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        shape = self._count(number), WIDTHS[accessor["type"]]
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            values = self._view(accessor, kind, shape)
        elif sparse:
            values = np.zeros(shape, kind)
        else:
            raise BrokenError(f"accessor {number} has no data; export the file again")
        if sparse:
            count = sparse["count"]
            places = np.dtype(COMPONENTS[sparse["indices"]["componentType"]])
            chosen = self._view(sparse["indices"], places, (count, 1))[:, 0]
            values = values.copy()
            values[chosen] = self._view(sparse["values"], kind, (count, shape[1]))
        if accessor.get("normalized") and kind.kind in "iu":
            return np.maximum(values / float(np.iinfo(kind).max), -1.0)
        return values.astype(float)

    def _view(self, part: Json, kind: np.dtype[Any], shape: tuple[int, int]) -> Any:
        """The numbers of a part of an accessor, in a buffer view."""
        view = self.document["bufferViews"][part["bufferView"]]
        start, step = view.get("byteOffset", 0), view.get("byteStride", kind.itemsize * shape[1])
        content = self._buffer(view["buffer"])[start : start + view["byteLength"]]
        offset, steps = part.get("byteOffset", 0), (step, kind.itemsize)
        return np.ndarray(shape, kind, content, offset, steps)  # which looks at its bounds

    def _buffer(self, number: int) -> bytes:
        """The content of a buffer. No other file is read."""
        buffer = self.document["buffers"][number]
        uri = buffer.get("uri")
        if uri is None and number == 0:
            return self.binary
        if uri is None or not uri.startswith("data:"):
            where = "nowhere" if uri is None else f"in another file, {short(uri)}"
            raise BrokenError(f"has numbers {where}; export it as one .glb")
        return base64.b64decode(uri.partition(",")[2], validate=True)


def read_gltf(content: bytes) -> Gltf:
    """The parts of a binary glTF file.

    Raises:
        BrokenError: It is none, it is cut off, or it requires an extension that is not read.
    """
    if len(content) < 20 or content[:4] != b"glTF" or content[16:20] != b"JSON":
        raise BrokenError("does not begin as a binary glTF file does; export it as .glb")
    version, length, size = struct.unpack_from("<III", content, 4)
    if version != 2:
        raise BrokenError(f"is glTF {version}; expected glTF 2.0")
    if len(content) < length or length < 20 + size:
        raise BrokenError(f"has {len(content)} of {max(length, 20 + size)} bytes; copy it again")
    document, at, binary = json.loads(content[20 : 20 + size]), 20 + size, b""
    while at + 8 <= length:
        size, kind = struct.unpack_from("<I4s", content, at)
        if kind == b"BIN\0":
            binary = content[at + 8 : at + 8 + size]
            break
        at += 8 + size
    for name in document.get("extensionsRequired", ()):
        if name in COMPRESSED:
            raise BrokenError(
                f"is packed by the glTF extension {name}; unpack it, for example with "
                "`npx @gltf-transform/cli copy IN.glb OUT.glb`"
            )
        if not _is_read(name):
            raise BrokenError(
                f"requires the glTF extension {short(name)}, which is not read; export it without"
            )
    return Gltf(document, binary)


def _is_read(name: str) -> bool:
    return name in (QUANTIZED, INSTANCED) or name.startswith(LOOKS)


def _matrices(translation: Floats | None, rotation: Floats | None, scale: Floats | None) -> Floats:
    """Matrices (n, 4, 4) that scale by (n, 3), then turn by quaternions (n, 4), x y z w, then move
    by (n, 3); None changes nothing."""
    (count,) = {len(part) for part in (translation, rotation, scale) if part is not None} or {1}
    matrices = np.tile(np.eye(4), (count, 1, 1))
    if rotation is not None:
        x, y, z, w = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
        matrices[:, :3, :3] = np.moveaxis(
            np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            ),
            2,
            0,
        )
    if scale is not None:
        matrices[:, :3, :3] *= scale[:, None, :]
    if translation is not None:
        matrices[:, :3, 3] = translation
    return matrices


def _moved(matrix: Floats, points: Floats) -> Floats:
    """Points (n, 3) moved by a matrix (4, 4), or each by its own of (n, 4, 4)."""
    turned: Floats = (matrix[..., :3, :3] @ points[..., None])[..., 0]
    return turned + matrix[..., :3, 3]
