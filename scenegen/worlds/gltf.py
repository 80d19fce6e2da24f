"""Reader of binary glTF 2.0 (.glb): the triangles, where the nodes put them.

Everything that places a rigid triangle is read (Khronos, glTF 2.0 specification): nodes, integer
accessors, and the extensions `QUANTIZED` and `INSTANCED`. Meshes that bend, by a skin or by the
weights of morph targets, are left out, and a note says so. A file that requires another extension
is refused, as the specification demands, unless the extension concerns only colours, textures or
lights: these are ignored."""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.grid import Floats, Ints
from lidarsim.parameters import MAX_TRIANGLES, short_repr
from scenegen.base.errors import CorruptFileError
from scenegen.base.files import Json
from scenegen.base.limits import MAX_GEOMS

QUANTIZED = "KHR_mesh_quantization"
"""Positions as integers. Accessors of integers are read anyway."""
INSTANCED = "EXT_mesh_gpu_instancing"
"""A node's mesh at several places."""
LOOKS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_")
"""Prefixes of extensions that concern only colours, textures and lights."""
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
    """A file's document, and its binary chunk."""

    document: Json
    binary: bytes

    def notes(self) -> Iterator[str]:
        """Describe parts that are not read and may move a triangle, a sentence each."""
        used = self.document.get("extensionsUsed", ())
        names = [str(name) for name in used if not _is_read(name) and name not in COMPRESSED]
        if names:
            yield f"glTF extensions that the file does not require are not read: {', '.join(names)}"
        if bent := sum(map(self._bends, self.document.get("nodes", ()))):
            yield f"meshes that bend, by a skin or by morph targets ({bent}), are left out"
        if animations := self.document.get("animations"):
            yield f"animations ({len(animations)}) are not played: nothing moves"

    def objects(self) -> Iterator[tuple[str, Floats, Ints]]:
        """The objects of the file's scene.

        Yields:
            For each primitive of each node's mesh, and each of its instances, a name, its corners
            (n, 3), metres, y up, and its triangles (m, 3), counter-clockwise seen from outside.
        """
        for node, world in self._placed():
            if "mesh" not in node or self._bends(node):
                continue
            mesh = self.document["meshes"][node["mesh"]]
            name = str(mesh.get("name") or node.get("name") or "")
            places = world @ self._instances(node)
            for primitive in mesh["primitives"]:
                if primitive.get("mode", TRIANGLES) < TRIANGLES:  # points and lines
                    continue
                corners = self.numbers(primitive["attributes"]["POSITION"])
                faces = self._faces(primitive, len(corners))
                for place in places:
                    # the outside of what is mirrored stays outside
                    mirrored = np.linalg.det(place[:3, :3]) < 0
                    yield name, _moved(place, corners), faces[:, ::-1] if mirrored else faces

    def _bends(self, node: Json) -> bool:
        """Return whether a node's mesh has a skin, or weights of morph targets."""
        mesh = self.document["meshes"][node["mesh"]] if "mesh" in node else {}
        return "skin" in node or any(node.get("weights") or mesh.get("weights", ()))

    def _placed(self) -> Iterator[tuple[Json, Floats]]:
        """Walk the nodes of the scene, each with the matrix (4, 4) from it to the world."""
        nodes, scenes = self.document.get("nodes", []), self.document.get("scenes", [{}])
        roots = scenes[self.document.get("scene", 0)].get("nodes", [])
        seen = set[int]()
        # a stack, since a file may nest deeper than Python recurses
        waiting = [(int(root), np.eye(4)) for root in reversed(roots)]
        while waiting:
            number, parent = waiting.pop()
            # a loop would never end, and shared children multiply
            if number in seen:
                raise CorruptFileError(f"node {number} has two parents; export it again")
            seen.add(number)
            node = nodes[number]
            if "matrix" in node:
                # glTF writes matrices column by column
                local = np.array(node["matrix"], float).reshape(4, 4).T
            else:
                parts = (node.get(name) for name in ("translation", "rotation", "scale"))
                (local,) = _matrices(*(part and np.array([part]) for part in parts))
            yield node, parent @ local
            children = reversed(node.get("children", []))
            waiting += [(int(child), parent @ local) for child in children]

    def _instances(self, node: Json) -> Floats:
        """Compute matrices (n, 4, 4) to a node from each instance of its mesh."""
        extension = node.get("extensions", {}).get(INSTANCED)
        if extension is None:
            return np.eye(4)[None]
        attributes = extension["attributes"]
        if max(self._count(name) for name in attributes.values()) > MAX_GEOMS:
            raise CorruptFileError(f"has more than {MAX_GEOMS} instances of a mesh; simplify it")
        names = (attributes.get(name) for name in ("TRANSLATION", "ROTATION", "SCALE"))
        return _matrices(*(None if name is None else self.numbers(name) for name in names))

    def _count(self, number: int) -> int:
        """Return the number of an accessor's elements. Raises CorruptFileError if it exceeds the
        limit."""
        count: int = self.document["accessors"][number]["count"]
        # separate triangles have three corners each
        if not 0 <= count <= 3 * MAX_TRIANGLES:
            raise CorruptFileError(
                f"accessor {number} has {short_repr(count)} elements; simplify the file"
            )
        return count

    def _faces(self, primitive: Json, corners: int) -> Ints:
        """Read triangles of a primitive (m, 3), as numbers of its corners."""
        if primitive.get("mode", TRIANGLES) != TRIANGLES:
            raise CorruptFileError(
                "has strips or fans of triangles; export it with separate triangles"
            )
        if "indices" not in primitive:
            return np.arange(corners).reshape(-1, 3)
        return self.numbers(primitive["indices"]).astype(np.int64).reshape(-1, 3)

    def numbers(self, number: int) -> Floats:
        """Read an accessor.

        Args:
            number: The accessor's number.

        Returns:
            (count, components): normalised integers as the numbers from -1 to 1 that they encode,
            other integers as they are.

        Raises:
            CorruptFileError: If it is sparse, has no data, or lies in another file.
        """
        accessor = self.document["accessors"][number]
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        shape = self._count(number), WIDTHS[accessor["type"]]
        if "bufferView" not in accessor or "sparse" in accessor:
            raise CorruptFileError(
                f"accessor {number} is sparse or has no data, which is not read; export it again"
            )
        view = self.document["bufferViews"][accessor["bufferView"]]
        start, step = view.get("byteOffset", 0), view.get("byteStride", kind.itemsize * shape[1])
        content = self._buffer(view["buffer"])[start : start + view["byteLength"]]
        offset, steps = accessor.get("byteOffset", 0), (step, kind.itemsize)
        values: Any = np.ndarray(
            shape, kind, content, offset, steps
        )  # raises if it would leave the buffer
        if accessor.get("normalized") and kind.kind in "iu":
            # glTF's rule: the least integer, one beyond the greatest's negative, means -1, too
            return np.maximum(values / float(np.iinfo(kind).max), -1.0)
        return values.astype(float)

    def _buffer(self, number: int) -> bytes:
        """Return the content of a buffer. Raises CorruptFileError for one in another file."""
        buffer = self.document["buffers"][number]
        uri = buffer.get("uri")
        if uri is None and number == 0:
            return self.binary
        location = "nowhere" if uri is None else f"in another file, {short_repr(uri)}"
        raise CorruptFileError(f"has numbers {location}; export it as one .glb")


def read_gltf(content: bytes) -> Gltf:
    """Split a binary glTF file into its parts.

    Args:
        content: The file's bytes.

    Returns:
        Document and binary chunk.

    Raises:
        CorruptFileError: If it is not glTF 2.0, is cut off, or requires an extension that is
            not read.
    """
    if len(content) < 20 or content[:4] != b"glTF" or content[16:20] != b"JSON":
        raise CorruptFileError("does not begin as a binary glTF file does; export it as .glb")
    version, length, size = struct.unpack_from("<III", content, 4)
    if version != 2:
        raise CorruptFileError(f"is glTF {version}; expected glTF 2.0")
    # bytes behind the file's own length are ignored
    if len(content) < length or length < 20 + size:
        raise CorruptFileError(
            f"has {len(content)} of {max(length, 20 + size)} bytes; copy it again"
        )
    document, offset, binary = json.loads(content[20 : 20 + size]), 20 + size, b""
    # chunks of other types are skipped, as the specification demands
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", content, offset)
        if kind == b"BIN\0":
            binary = content[offset + 8 : offset + 8 + size]
            break
        offset += 8 + size
    for name in document.get("extensionsRequired", ()):
        if name in COMPRESSED:
            raise CorruptFileError(
                f"is packed by the glTF extension {name}; unpack it, for example with "
                "`npx @gltf-transform/cli copy IN.glb OUT.glb`"
            )
        if not _is_read(name):
            raise CorruptFileError(
                f"requires the glTF extension {short_repr(name)}, which is not read; export it "
                "without"
            )
    return Gltf(document, binary)


def _is_read(name: str) -> bool:
    return name in (QUANTIZED, INSTANCED) or name.startswith(LOOKS)


def _matrices(translation: Floats | None, rotation: Floats | None, scale: Floats | None) -> Floats:
    """Compose matrices (n, 4, 4): scale by (n, 3), then rotate by quaternions (n, 4), x y z w, then
    move by (n, 3); None changes nothing."""
    (count,) = {len(part) for part in (translation, rotation, scale) if part is not None} or {1}
    matrices = np.tile(np.eye(4), (count, 1, 1))
    if rotation is not None:
        from scipy.spatial.transform import Rotation  # takes long to load

        matrices[:, :3, :3] = Rotation.from_quat(rotation).as_matrix()
    if scale is not None:
        matrices[:, :3, :3] *= scale[:, None, :]
    if translation is not None:
        matrices[:, :3, 3] = translation
    return matrices


def _moved(matrix: Floats, points: Floats) -> Floats:
    """Transform points (n, 3) by a matrix (4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]
