"""The solids of a compiled model: one table of primitives and one soup of triangles, in the world frame."""

import functools
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim.casters.mujoco import visible_geoms
from lidarsim.jit import kernel
from scenegen.limits import MOST_LENGTH_M, MOST_TRIANGLES
from scenegen.truth.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, HFIELD, MESH, SPHERE


@dataclass(frozen=True, eq=False)
class Solids:
    """Every geom of a model that rays can see, filled: n primitives and m meshes of T triangles in all.

    Height fields are meshes too: their surface closed by walls and a base.
    """

    shape: NDArray[np.int64]
    """(n,) codes of `scenegen.truth.shapes`."""
    size: NDArray[np.float64]
    """(n, 3) MuJoCo's sizes, metres."""
    position: NDArray[np.float64]
    """(n, 3) centres, metres."""
    rotation: NDArray[np.float64]
    """(n, 3, 3): takes the shape's coordinates to the world's."""
    lower: NDArray[np.float64]
    """(n, 3) least corners of the bounding boxes; -inf for planes."""
    upper: NDArray[np.float64]
    """(n, 3) greatest corners; +inf for planes."""
    triangles: NDArray[np.float64]
    """(T, 3, 3): triangle, corner, coordinate."""
    mesh_start: NDArray[np.int64]
    """(m + 1,): mesh q owns triangles mesh_start[q] to mesh_start[q + 1]."""
    mesh_filled: NDArray[np.bool_]
    """(m,): closed, so its inside is solid; otherwise it is a surface."""

    @cached_property
    def boxes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bounding boxes of all n + m solids: least corners (n + m, 3) and greatest corners (n + m, 3)."""
        meshes = [self.triangles[a:b].reshape(-1, 3) for a, b in pairwise(self.mesh_start)]
        lower = np.array([corners.min(axis=0) for corners in meshes]).reshape(-1, 3)
        upper = np.array([corners.max(axis=0) for corners in meshes]).reshape(-1, 3)
        return np.concatenate([self.lower, lower]), np.concatenate([self.upper, upper])

    def __len__(self) -> int:
        return len(self.shape) + len(self.mesh_filled)


def solids_of(model: mujoco.MjModel, data: mujoco.MjData | None = None) -> Solids:
    """The solids of `model` in its reference configuration, or in that of `data` where given.

    Raises ValueError for a geom whose shape has no closed form here (a signed distance field's), for numbers that are
    not finite or beyond `MOST_LENGTH_M`, and for more than `MOST_TRIANGLES`.
    """
    if data is None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
    seen = visible_geoms(model)
    _check(model, data, seen)
    bent = seen & ((model.geom_type == MESH) | (model.geom_type == HFIELD))
    plain = np.flatnonzero(seen & ~bent)
    shape = model.geom_type[plain].astype(np.int64)
    size = model.geom_size[plain].astype(np.float64)
    position = data.geom_xpos[plain].astype(np.float64)
    rotation = data.geom_xmat[plain].reshape(-1, 3, 3).astype(np.float64)
    lower, upper = _bounds(shape, size, position, rotation)
    surface = functools.cache(functools.partial(_surface, model))
    soups, filled = [np.empty((0, 3, 3))], []
    for geom in np.flatnonzero(bent):
        vertices, faces, closed = surface(int(model.geom_type[geom]), int(model.geom_dataid[geom]))
        # term by term: what a matrix product gives depends on the processor
        columns = data.geom_xmat[geom].reshape(3, 3).T
        world = (vertices[:, :1] * columns[0] + vertices[:, 1:2] * columns[1]) + vertices[:, 2:] * columns[2]
        soups.append((world + data.geom_xpos[geom])[faces])
        filled.append(closed)
    start = np.cumsum([len(soup) for soup in soups])
    return Solids(
        shape, size, position, rotation, lower, upper, np.concatenate(soups), start, np.array(filled, dtype=np.bool_)
    )


def _check(model: mujoco.MjModel, data: mujoco.MjData, seen: NDArray[np.bool_]) -> None:
    """Raise ValueError for what no kernel may see. Kernels index by these numbers, unchecked."""
    odd = seen & (model.geom_type > MESH)
    if odd.any():
        raise ValueError(
            f"geom {_name(model, odd)} is neither a primitive, a mesh nor a height field; use one of these"
        )
    for what, values in (("pos", data.geom_xpos), ("axes", data.geom_xmat), ("size", model.geom_size)):
        odd = seen & ~(np.abs(values) <= MOST_LENGTH_M).all(axis=1)  # a NaN is not
        if odd.any():
            value = values[np.argmax(odd)].tolist()
            raise ValueError(f"geom {_name(model, odd)}: {what} = {value}, expected numbers up to {MOST_LENGTH_M:g}")
    for what, values in (
        ("a mesh's vertices", model.mesh_vert),
        ("a height field's size", model.hfield_size),
        ("a height field's heights", model.hfield_data),
    ):
        if not (np.abs(values) <= MOST_LENGTH_M).all():
            raise ValueError(f"{what}: expected finite numbers, up to {MOST_LENGTH_M:g}")
    triangles = int(model.mesh_facenum[model.geom_dataid[seen & (model.geom_type == MESH)]].sum(dtype=np.int64))
    for field in model.geom_dataid[seen & (model.geom_type == HFIELD)]:
        triangles += 4 * int(model.hfield_nrow[field]) * int(model.hfield_ncol[field])
    if triangles > MOST_TRIANGLES:
        raise ValueError(
            f"meshes and height fields of {triangles} triangles, expected {MOST_TRIANGLES} at most; use coarser ones"
        )


def _name(model: mujoco.MjModel, chosen: NDArray[np.bool_]) -> str:
    """The name of the first of the `chosen` geoms, or its number where it has none."""
    first = int(np.argmax(chosen))
    return model.geom(first).name or f"number {first}"


def _surface(model: mujoco.MjModel, shape: int, number: int) -> tuple[NDArray[np.float64], NDArray[np.int64], bool]:
    """Vertices, faces (outward where closed) and whether they are closed, of a mesh or of a height field."""
    return (_mesh if shape == MESH else _height_field)(model, number)


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[NDArray[np.float64], NDArray[np.int64], bool]:
    """Vertices, faces (outward where closed) and whether the mesh is closed."""
    import trimesh  # takes a second to load, and few worlds hold a mesh

    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    soup = trimesh.Trimesh(
        model.mesh_vert[first : first + count].astype(np.float64), model.mesh_face[face : face + faces]
    )
    if not _is_closed(soup.faces) and soup.is_watertight:
        trimesh.repair.fix_winding(soup)
    return np.asarray(soup.vertices), np.asarray(soup.faces, dtype=np.int64), _is_closed(soup.faces)


def _is_closed(faces: NDArray[np.int64]) -> bool:
    """Whether every edge is walked as often one way as the other by the triangles (T, 3) around it.

    Then each point off the surface has a winding number, also where more than two triangles share an edge, as between
    two boxes that touch along it.
    """
    tail, head = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    count = int(faces.max(initial=0)) + 1
    return bool(np.array_equal(np.sort(tail * count + head), np.sort(head * count + tail)))


def _height_field(model: mujoco.MjModel, field: int) -> tuple[NDArray[np.float64], NDArray[np.int64], bool]:
    """MuJoCo's surface (each cell cut along the diagonal from its least x and y to its greatest), walls, and base."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    first = int(model.hfield_adr[field])
    half_x, half_y, top, base = model.hfield_size[field]
    height = model.hfield_data[first : first + rows * columns].reshape(rows, columns).astype(np.float64) * top
    y, x = np.meshgrid(np.linspace(-half_y, half_y, rows), np.linspace(-half_x, half_x, columns), indexing="ij")
    above = np.stack([x, y, height], axis=-1).reshape(-1, 3)
    below = np.stack([x, y, np.full_like(height, -base)], axis=-1).reshape(-1, 3)
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    surface = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    ahead, under = np.roll(rim, -1), rows * columns
    walls = np.concatenate([np.stack([rim, rim + under, ahead], 1), np.stack([ahead, rim + under, ahead + under], 1)])
    return np.concatenate([above, below]), np.concatenate([surface, surface[:, ::-1] + under, walls]), True


@kernel
def _bounds(shape, size, position, rotation):
    """Axis-aligned bounding boxes (n, 3), (n, 3)."""
    lower, upper = np.empty_like(position), np.empty_like(position)
    for n in range(len(shape)):
        for a in range(3):
            u, v, w = rotation[n, a, 0], rotation[n, a, 1], rotation[n, a, 2]
            reach = np.inf
            if shape[n] == SPHERE:
                reach = size[n, 0]
            elif shape[n] == CAPSULE:
                reach = size[n, 0] + abs(w) * size[n, 1]
            elif shape[n] == CYLINDER:
                reach = size[n, 0] * np.sqrt(max(1.0 - w * w, 0.0)) + abs(w) * size[n, 1]
            elif shape[n] == BOX:
                reach = abs(u) * size[n, 0] + abs(v) * size[n, 1] + abs(w) * size[n, 2]
            elif shape[n] == ELLIPSOID:
                reach = np.sqrt((u * size[n, 0]) ** 2 + (v * size[n, 1]) ** 2 + (w * size[n, 2]) ** 2)
            lower[n, a], upper[n, a] = position[n, a] - reach, position[n, a] + reach
    return lower, upper
