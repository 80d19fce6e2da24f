"""A compiled model written as MJCF again: its geoms, each where it is in the world, and the meshes
that MuJoCo made.

Whatever was read to compile it, nothing else is read any more: no include, no attached model, no
folder of assets.
"""

import hashlib
import re
from xml.etree import ElementTree

import mujoco
import numpy as np

from lidarsim.solids.shapes import HFIELD, MESH, PLANE
from scenegen.worlds.drawing import FLIGHT_BOUNDS, least_memory


def flatten(
    model: mujoco.MjModel, data: mujoco.MjData, *, materials: bool = False
) -> tuple[bytes, dict[str, bytes]]:
    """The document of `model` as `data` stands, and the files that it refers to, by name.

    Colours are those that decide what rays see. Planes become infinite, as they are for collisions
    and for the truth: rays would pass beside the rectangle that is drawn. Joints, skins, textures,
    and what else no ray meets, are left out; materials too, unless `materials` keeps their names.
    """
    root = ElementTree.Element("mujoco", model="scenegen")
    ElementTree.SubElement(root, "size", memory=str(least_memory(model.ngeom)))
    custom = ElementTree.SubElement(root, "custom")
    for number in map(model.numeric, range(model.nnumeric)):
        if number.name == FLIGHT_BOUNDS:
            ElementTree.SubElement(custom, "numeric", name=FLIGHT_BOUNDS, data=_said(number.data))
    asset, world = ElementTree.SubElement(root, "asset"), ElementTree.SubElement(root, "worldbody")
    files: dict[str, bytes] = {}
    named: dict[tuple[int, int], str] = {}
    worn: dict[str, str] = {}
    for geom in np.flatnonzero(model.geom_type <= MESH):
        shape, number = int(model.geom_type[geom]), int(model.geom_dataid[geom])
        about = {
            "type": mujoco.mjtGeom(shape).name.removeprefix("mjGEOM_").lower(),
            "pos": _said(data.geom_xpos[geom]),
        }
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[geom])
        about["quat"] = _said(quaternion)
        if model.geom(geom).name:
            about["name"] = model.geom(geom).name
        if shape in (MESH, HFIELD):
            if (shape, number) not in named:
                add = _add_mesh if shape == MESH else _add_field
                named[shape, number] = add(asset, files, model, number)
            about[about["type"]] = named[shape, number]
        else:
            about["size"] = "0 0 1" if shape == PLANE else _said(model.geom_size[geom])
        if model.geom_group[geom]:
            about["group"] = str(model.geom_group[geom])
        dress = model.geom_matid[geom]
        about["rgba"] = _said(model.mat_rgba[dress] if dress >= 0 else model.geom_rgba[geom])
        if materials and dress >= 0:
            about["material"] = model.mat(int(dress)).name
            worn[about["material"]] = about["rgba"]
        if shape == MESH:  # then MuJoCo needs no convex hull
            about |= {"contype": "0", "conaffinity": "0"}
        ElementTree.SubElement(world, "geom", about)
    for name, rgba in worn.items():
        ElementTree.SubElement(asset, "material", name=name, rgba=rgba)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8"), files


def _add_mesh(
    asset: ElementTree.Element, files: dict[str, bytes], model: mujoco.MjModel, mesh: int
) -> str:
    """Add a mesh as MuJoCo compiled it, in its MSH format, which keeps every bit of a vertex.
    Returns its name."""
    first, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[face : face + model.mesh_facenum[mesh]]
    content = np.array([len(vertices), 0, 0, len(faces)], "<i4").tobytes()
    content += vertices.astype("<f4").tobytes() + faces.astype("<i4").tobytes()
    name = model.mesh(mesh).name or f"mesh{mesh}"
    # a shell's inertia exists for every mesh, closed or not, flat or not
    ElementTree.SubElement(
        asset, "mesh", name=name, file=_put(files, content, name, "msh"), inertia="shell"
    )
    return name


def _add_field(
    asset: ElementTree.Element, files: dict[str, bytes], model: mujoco.MjModel, field: int
) -> str:
    """Add a height field as MuJoCo compiled it, heights from 0 to 1. Returns its name."""
    first, rows, columns = (
        model.hfield_adr[field],
        int(model.hfield_nrow[field]),
        int(model.hfield_ncol[field]),
    )
    content = np.array([rows, columns], "<i4").tobytes()
    content += model.hfield_data[first : first + rows * columns].astype("<f4").tobytes()
    name = model.hfield(field).name or f"hfield{field}"
    size = _said(model.hfield_size[field])
    ElementTree.SubElement(
        asset, "hfield", name=name, file=_put(files, content, name, "bin"), size=size
    )
    return name


def _put(files: dict[str, bytes], content: bytes, name: str, ending: str) -> str:
    """Put a file among `files` under a name made of its content and its own, and return that
    name."""
    safe = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:60]
    called = f"{hashlib.sha256(content).hexdigest()[:12]}-{safe}.{ending}"
    files[called] = content
    return called


def _said(numbers: object) -> str:
    """Numbers as MJCF writes them, every bit kept."""
    return " ".join(repr(float(number)) for number in np.ravel(np.asarray(numbers)))
