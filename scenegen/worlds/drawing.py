"""Worlds as MJCF: the drawing that kinds add solids to, and compiled models written as MJCF
again."""

import functools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from lidarsim.grid import Floats
from lidarsim.registry import suggestion
from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, HFIELD, MESH, PLANE, SPHERE
from scenegen.base.limits import MAX_DRAWN_SOLIDS
from scenegen.base.reading import sha256_of
from scenegen.worlds.classes import COLOURS
from scenegen.worlds.screen import screen

FLIGHT_BOUNDS = "flight_bounds"
"""Name of the MJCF <numeric> that holds the box, least corner then greatest, in which the sensor
may fly."""
COLOUR = (0.62, 0.64, 0.68, 1.0)
"""The default colour of solids, as red, green, blue and alpha."""
SHAPES = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
"""MJCF's names of shapes, by MuJoCo's codes."""
SIZES = {SPHERE: 1, CAPSULE: 2, ELLIPSOID: 3, CYLINDER: 2, BOX: 3, HFIELD: 0}
"""Shapes that are written here, and how many sizes they have."""
MAX_WRITTEN = 4096
"""The most solids for which the least <size memory> suffices, see `memory_bytes`."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
"""The default attitude of solids, w x y z."""
COLUMNS = (slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 14))
"""The numbers of a row: a solid's sizes, position, attitude and colour."""
_PLACE = "    <light "
"""Where MuJoCo's writer puts the geoms: before this."""


class HeightField(NamedTuple):
    """Uneven ground."""

    name: str
    size: tuple[float, float, float, float]
    """Half its extents along x and y, the span of its heights, and how deep it is filled below the
    least of them, metres."""
    heights: Floats
    """(along y, along x)."""


class Solid(NamedTuple):
    """One solid."""

    shape: int
    row: Floats
    """The solid's numbers (14,), as `COLUMNS` says."""
    material: str = ""
    """The solid's class; "" for none."""
    field: HeightField | None = None
    """None unless the solid is a height field."""


class Drawing:
    """Solids under the world body, written to the same bytes as by MuJoCo's own writer, which is
    twenty times slower.

    It supports everything that a `mujoco.MjSpec` does: access to any attribute of one makes one,
    with the solids so far in it, and from then on MuJoCo writes the document."""

    def __init__(self, flight_bounds: Floats):
        self._bounds = tuple(np.asarray(flight_bounds, float).reshape(-1).tolist())
        self._solids: list[Solid] = []
        """Solids that are not in the spec yet."""
        self._fields = 0
        self._spec: mujoco.MjSpec | None = None

    def add_geom(
        self, shape: mujoco.mjtGeom, size: ArrayLike, position: ArrayLike, **attributes: Any
    ) -> None:
        """Add one solid.

        Args:
            shape: Its shape.
            size: MuJoCo's sizes, metres.
            position: (3,), metres.
            attributes: `quat` (w x y z), `rgba`, and every other keyword of MuJoCo's `add_geom`.
        """
        if attributes.keys() <= {"quat", "rgba"}:
            sizes = np.zeros(3)
            sizes[: np.size(size)] = size
            self.add_geoms(
                [shape],
                sizes,
                position,
                attributes.get("quat", UPRIGHT),
                attributes.get("rgba", COLOUR),
            )
        else:
            # any other attribute needs MuJoCo's writer
            self.worldbody.add_geom(type=shape, size=size, pos=position, **attributes)

    def add_geoms(
        self,
        shapes: ArrayLike,
        sizes: ArrayLike,
        positions: ArrayLike,
        quats: ArrayLike = UPRIGHT,
        rgba: ArrayLike = COLOUR,
        classes: Sequence[str] | None = None,
    ) -> None:
        """Add n solids at once, which is quicker than one by one. Values that all share may lack
        the first axis.

        Args:
            shapes: Codes of `mujoco.mjtGeom`, (n,).
            sizes: MuJoCo's sizes, (n, 3), metres.
            positions: (n, 3), metres.
            quats: Attitudes, (n, 4), w x y z.
            rgba: Colours, (n, 4).
            classes: Names of their classes in `scenegen.worlds.classes`, (n,), which become their
                materials; none by default.
        """
        codes = np.asarray(shapes, np.int64).tolist()
        rows = np.empty((len(codes), 14))
        for columns, values in zip(COLUMNS, (sizes, positions, quats, rgba), strict=True):
            rows[:, columns] = values
        named = classes or [""] * len(codes)
        self._add([Solid(*fields) for fields in zip(codes, rows, named, strict=True)])

    def add_height_field(
        self,
        heights: Floats,
        size_m: tuple[float, float],
        position: ArrayLike,
        *,
        depth_m: float,
        hanging: bool = False,
        of_class: str = "terrain",
    ) -> None:
        """Add uneven ground, filled below; or, `hanging`, an uneven ceiling, filled above.

        Args:
            heights: Heights (along y, along x) over `position`, metres; of a ceiling, how far it
                hangs below `position`.
            size_m: Its extents along x and y, metres.
            position: Of its middle (3,), metres.
            depth_m: How far it is filled beyond its least height, metres.
            hanging: Whether it is a ceiling.
            of_class: Its class.
        """
        x, y, z = np.asarray(position, float).tolist()
        lowest = float(heights.min())
        # MuJoCo refuses a height field without height
        span = max(float(heights.max()) - lowest, 1e-3)
        size = (size_m[0] / 2, size_m[1] / 2, span, depth_m)
        # a ceiling is turned about the x axis, which mirrors y
        field = HeightField(f"field{self._fields}", size, heights[::-1] if hanging else heights)
        self._fields += 1
        place = (x, y, z - lowest if hanging else z + lowest)
        turn = (0.0, 1.0, 0.0, 0.0) if hanging else UPRIGHT
        row = np.array([0.0, 0.0, 0.0, *place, *turn, *COLOUR])
        self._add([Solid(HFIELD, row, of_class, field)])

    def _add(self, solids: Sequence[Solid]) -> None:
        for solid in solids:
            if (named := solid.material) and named not in COLOURS:
                raise ValueError(f"unknown class {named!a}; {suggestion(named, COLOURS)}")
            self._solids.append(solid)
        if self._spec is not None:
            self._fill(self._spec)

    def _fill(self, spec: mujoco.MjSpec) -> None:
        """Move the solids into a spec."""
        for solid in self._solids:
            if solid.material and spec.material(solid.material) is None:
                _add_class(spec, solid.material)
            if solid.field:
                _add_field(spec, solid.field)
            size, position, quat, rgba = (solid.row[columns] for columns in COLUMNS)
            attributes = {"material": solid.material} if solid.material else {}
            attributes |= {"hfieldname": solid.field.name} if solid.field else {}
            kind = mujoco.mjtGeom(solid.shape)
            spec.worldbody.add_geom(
                type=kind, size=size, pos=position, quat=quat, rgba=rgba, **attributes
            )
        self._solids = []

    def __getattr__(self, name: str) -> Any:
        # else `copy` and `pickle` would make a spec when they look for hooks
        if name.startswith("_"):
            raise AttributeError(name)
        if self._spec is None:
            self._spec = _empty(self._bounds)
            self._fill(self._spec)
        return getattr(self._spec, name)

    def mjcf(self) -> bytes:
        """Write the document.

        Returns:
            The MJCF, UTF-8: lengths in metres, z up, in the world's frame.

        Raises:
            ValueError: If it has too many solids, or MuJoCo refuses the world.
            CorruptFileError: If readers of the archive would refuse it.
        """
        solids = len(self._solids) + (len(self._spec.geoms) if self._spec is not None else 0)
        # kinds do not count the floor in `max_solids`
        if solids > MAX_DRAWN_SOLIDS + 1:
            raise ValueError(f"{solids} solids, expected {MAX_DRAWN_SOLIDS} at most")
        if self._spec is None and len(self._solids) <= MAX_WRITTEN:
            lines = _lines(self._solids)
            if lines is not None:
                classes = tuple(
                    dict.fromkeys(solid.material for solid in self._solids if solid.material)
                )
                fields = tuple(solid.field for solid in self._solids if solid.field)
                before, after = (_around if fields else _around_solids)(
                    self._bounds, classes, fields
                )
                return f"{before}{lines}{after}".encode()
        self.worldbody  # noqa: B018 (from here on, there is a spec)
        assert self._spec is not None
        # set last, when the number of geoms is known
        self._spec.memory = memory_bytes(len(self._spec.geoms))
        document: bytes = self._spec.to_xml().encode()
        screen(document, {}, "its document")
        return document


def memory_bytes(geoms: int) -> int:
    """Return bytes for MuJoCo's <size memory>: few, since they are allocated for every world."""
    return max(1 << 20, 256 * geoms)


def _empty(bounds: tuple[float, ...]) -> mujoco.MjSpec:
    """Make a spec of a world with only a light."""
    spec = mujoco.MjSpec()
    spec.modelname = "scenegen"
    spec.default.geom.rgba = COLOUR
    spec.add_numeric(name=FLIGHT_BOUNDS, data=bounds, size=6)
    spec.worldbody.add_light(
        pos=[0, 0, 30], dir=[0.2, 0.1, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )
    return spec


def _add_class(spec: mujoco.MjSpec, name: str) -> None:
    spec.add_material(name=name, rgba=COLOURS[name])


def _add_field(spec: mujoco.MjSpec, field: HeightField) -> None:
    rows, columns = field.heights.shape
    heights = field.heights.reshape(-1).tolist()
    spec.add_hfield(name=field.name, nrow=rows, ncol=columns, size=field.size, userdata=heights)


def _around(
    bounds: tuple[float, ...], classes: tuple[str, ...], fields: tuple[HeightField, ...]
) -> tuple[str, str]:
    """Return MuJoCo's text before and after the geoms of a world with these classes and fields."""
    spec = _empty(bounds)
    for name in classes:
        _add_class(spec, name)
    for field in fields:
        _add_field(spec, field)
    spec.memory = memory_bytes(0)
    if fields:
        spec.compile()  # scales heights to 0 to 1
    before, light, after = spec.to_xml().partition(_PLACE)
    return before, light + after


_around_solids = functools.lru_cache(maxsize=64)(_around)
"""`_around`, cached for worlds without height fields, many of which share it."""


def _lines(solids: list[Solid]) -> str | None:
    """Write geoms as MuJoCo does; None if one of them needs MuJoCo's writer."""
    if any(solid.shape not in SIZES for solid in solids):
        return None
    rows = np.array([solid.row for solid in solids]).reshape(-1, 14)
    square = rows[:, 6:10] * rows[:, 6:10]
    # added in MuJoCo's order, for the same bits
    length = np.sqrt(((square[:, 0] + square[:, 1]) + square[:, 2]) + square[:, 3])
    counts = np.array([SIZES[solid.shape] for solid in solids], np.int64)
    lengths = np.abs(rows[:, :10])
    lengths[:, :3][np.arange(3) >= counts[:, None]] = 0.0
    # MuJoCo writes most numbers like this, but not what it rounds to 0 itself, or large whole ones
    plain = (lengths == 0.0) | ((lengths >= 1e-9) & (lengths < 1e5))
    if not (plain.all() and ((length > 0.5) & (length < 2.0)).all()):
        return None
    rows[:, 6:10] /= length[:, None]
    written = (rows + 0.0).tolist()  # + 0.0 makes 0 of -0
    return "".join(_line(solid, row) for solid, row in zip(solids, written, strict=True))


def _line(solid: Solid, row: list[float]) -> str:
    """Write a geom's line, with six digits for every number, as C++ does."""
    count, place, turn, colour = SIZES[solid.shape], row[3:6], row[6:10], row[10:]
    line = "    <geom" + (_attribute("size", row[:count]) if count else "")
    line += _attribute("pos", place) if any(place) else ""
    line += _attribute("quat", turn) if tuple(turn) != UPRIGHT else ""
    line += f' type="{SHAPES[solid.shape]}"' if solid.shape != SPHERE else ""
    line += _attribute("rgba", colour) if tuple(colour) != COLOUR else ""
    line += f' material="{solid.material}"' if solid.material else ""
    return line + (f' hfield="{solid.field.name}"' if solid.field else "") + "/>\n"


def _attribute(name: str, numbers: list[float]) -> str:
    return f' {name}="{" ".join([f"{number:.6g}" for number in numbers])}"'


def flatten(
    model: mujoco.MjModel, data: mujoco.MjData, *, materials: bool = False
) -> tuple[bytes, dict[str, bytes]]:
    """Write a compiled model as MJCF.

    Colours are those that decide what rays see. Planes become infinite, as they are for collisions
    and for the truth: rays would pass beside the rectangle that is drawn. Joints, skins, textures,
    and everything else that no ray meets, are left out.

    Args:
        model: The model.
        data: Where its geoms are.
        materials: Whether the names of materials are kept.

    Returns:
        The document, and the files that it refers to, by name.
    """
    root = ElementTree.Element("mujoco", model="scenegen")
    ElementTree.SubElement(root, "size", memory=str(memory_bytes(model.ngeom)))
    custom = ElementTree.SubElement(root, "custom")
    for number in map(model.numeric, range(model.nnumeric)):
        if number.name == FLIGHT_BOUNDS:
            ElementTree.SubElement(custom, "numeric", name=FLIGHT_BOUNDS, data=_exact(number.data))
    asset, world = ElementTree.SubElement(root, "asset"), ElementTree.SubElement(root, "worldbody")
    files: dict[str, bytes] = {}
    bent_names: dict[tuple[int, int], str] = {}
    colours: dict[str, str] = {}
    for geom in np.flatnonzero(model.geom_type <= MESH):
        shape, number = int(model.geom_type[geom]), int(model.geom_dataid[geom])
        attributes = {
            "type": SHAPES[shape],
            "pos": _exact(data.geom_xpos[geom]),
        }
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[geom])
        attributes["quat"] = _exact(quaternion)
        if model.geom(geom).name:
            attributes["name"] = model.geom(geom).name
        if shape in (MESH, HFIELD):
            # geoms may share a mesh or a field
            if (shape, number) not in bent_names:
                bent_names[shape, number] = _add_bent(asset, files, model, shape, number)
            attributes[attributes["type"]] = bent_names[shape, number]
        else:
            attributes["size"] = "0 0 1" if shape == PLANE else _exact(model.geom_size[geom])
        if model.geom_group[geom]:
            attributes["group"] = str(model.geom_group[geom])
        material = model.geom_matid[geom]
        attributes["rgba"] = _exact(
            model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        )
        if materials and material >= 0:
            attributes["material"] = model.mat(int(material)).name
            colours[attributes["material"]] = attributes["rgba"]
        if shape == MESH:  # then MuJoCo needs no convex hull
            attributes |= {"contype": "0", "conaffinity": "0"}
        ElementTree.SubElement(world, "geom", attributes)
    for name, rgba in colours.items():
        ElementTree.SubElement(asset, "material", name=name, rgba=rgba)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8"), files


def _add_bent(
    asset: ElementTree.Element,
    files: dict[str, bytes],
    model: mujoco.MjModel,
    shape: int,
    number: int,
) -> str:
    """Add a mesh or a height field as MuJoCo compiled it. Returns its name."""
    if shape == MESH:  # in the MSH format, which keeps every bit of a vertex
        first, face = model.mesh_vertadr[number], model.mesh_faceadr[number]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[number]]
        faces = model.mesh_face[face : face + model.mesh_facenum[number]]
        header, arrays = [len(vertices), 0, 0, len(faces)], [vertices, faces]
        tag, ending, given_name = "mesh", "msh", model.mesh(number).name
        # a shell's inertia exists for every mesh, closed or not, flat or not
        attributes = {"inertia": "shell"}
    else:  # heights from 0 to 1
        header = [int(model.hfield_nrow[number]), int(model.hfield_ncol[number])]
        first = model.hfield_adr[number]
        arrays = [model.hfield_data[first : first + header[0] * header[1]]]
        tag, ending, given_name = "hfield", "bin", model.hfield(number).name
        attributes = {"size": _exact(model.hfield_size[number])}
    parts = [values.astype("<f4" if values.dtype.kind == "f" else "<i4") for values in arrays]
    content = b"".join(part.tobytes() for part in (np.array(header, "<i4"), *parts))
    name = given_name or f"{tag}{number}"
    # the digest alone tells files apart; the name is for people
    safe = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:60]
    file = f"{sha256_of(content)[:12]}-{safe}.{ending}"
    files[file] = content
    ElementTree.SubElement(asset, tag, {"name": name, "file": file, **attributes})
    return name


def _exact(numbers: object) -> str:
    """Write numbers as MJCF does, without loss of bits."""
    return " ".join(repr(float(number)) for number in np.ravel(np.asarray(numbers)))
