"""Solids of a world as plain data, and how they are read from a compiled MuJoCo model.

Nothing here knows how rays or voxels meet them."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lidarsim.grid import Floats, Ints, Mask
from lidarsim.jit import kernel
from lidarsim.parameters import MAX_LENGTH_M, MAX_TRIANGLES

if TYPE_CHECKING:  # reading datasets must not load it
    import mujoco

PLANE, HFIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = range(8)
"""The codes of MuJoCo's `mjtGeom`."""


@dataclass(frozen=True, eq=False)
class Solids:
    """Every geom of a model that rays can see, filled: n primitives and m meshes of T triangles in
    all.

    Height fields are meshes too: their surface closed by walls and a base.
    """

    shape: Ints
    """(n,) codes, as above."""
    size: Floats
    """(n, 3) MuJoCo's sizes, metres."""
    position: Floats
    """(n, 3) centres, metres."""
    rotation: Floats
    """(n, 3, 3): takes the shape's coordinates to the world's."""
    lower: Floats
    """(n, 3) least corners of the bounding boxes; -inf for planes."""
    upper: Floats
    """(n, 3) greatest corners; +inf for planes."""
    triangles: Floats
    """(T, 3, 3): triangle, corner, coordinate."""
    mesh_start: Ints
    """(m + 1,): mesh q owns triangles mesh_start[q] to mesh_start[q + 1]."""
    mesh_filled: Mask
    """(m,): closed, so its inside is solid; otherwise it is a surface."""
    geom: Ints
    """(n + m,): the numbers of primitives and meshes among the model's geoms."""

    @cached_property
    def boxes(self) -> tuple[Floats, Floats]:
        """Bounding boxes of all n + m solids: least corners (n + m, 3) and greatest corners (n + m,
        3)."""
        first = self.mesh_start[:-1]
        lower = np.minimum.reduceat(self.triangles.min(axis=1), first)
        upper = np.maximum.reduceat(self.triangles.max(axis=1), first)
        return np.concatenate([self.lower, lower]), np.concatenate([self.upper, upper])

    def __len__(self) -> int:
        return len(self.shape) + len(self.mesh_filled)


@kernel
def joining(start, end):
    """Compute the vector from one point to another.

    Args:
        start: (3,).
        end: (3,).

    Returns:
        The coordinates x, y, z of `end` - `start`.
    """
    return end[0] - start[0], end[1] - start[1], end[2] - start[2]


@kernel
def local(axes, x, y, z):
    """Express a vector of the world in the frame of a shape.

    Args:
        axes: (3, 3): rotation from the shape's frame to the world's.
        x, y, z: The vector in the world frame.

    Returns:
        The coordinates x, y, z of the vector in the shape's frame.
    """
    return (
        # the transpose of a rotation is its inverse
        axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z,
        axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z,
        axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z,
    )


def bounding_boxes(
    shape: Ints, size: Floats, position: Floats, rotation: Floats
) -> tuple[Floats, Floats]:
    """Compute axis-aligned bounding boxes of primitives.

    Args:
        shape: (n,): codes of shapes; see `Solids` for all four arrays.
        size: (n, 3), metres.
        position: (n, 3), metres, in the world.
        rotation: (n, 3, 3).

    Returns:
        Least and greatest corners, (n, 3) each, metres; infinite for planes.
    """
    reach = np.full(position.shape, np.inf)
    for kind in set(shape.tolist()):
        chosen = shape == kind
        # the shapes' axes in the world, (k, 3) each
        x, y, z = np.moveaxis(rotation[chosen], 2, 0)
        a, b, c = size[chosen].T[..., None]
        if kind == SPHERE:
            reach[chosen] = a
        elif kind == CAPSULE:
            reach[chosen] = a + abs(z) * b
        elif kind == CYLINDER:
            # a disc with normal z reaches its radius times the sine of the angle to the axis
            reach[chosen] = a * np.sqrt(np.maximum(1.0 - z * z, 0.0)) + abs(z) * b
        elif kind == BOX:
            reach[chosen] = abs(x) * a + abs(y) * b + abs(z) * c
        elif kind == ELLIPSOID:
            reach[chosen] = np.sqrt((x * a) ** 2 + (y * b) ** 2 + (z * c) ** 2)
    return position - reach, position + reach


def solids_of(model: mujoco.MjModel, data: mujoco.MjData | None = None) -> Solids:
    """Read the solids of a compiled model.

    Args:
        model: The compiled world.
        data: Where bodies are; the model's reference configuration if None.

    Returns:
        Its visible geoms.

    Raises:
        ValueError: As `ModelSolids` and its `at` do.
    """
    if data is None:
        import mujoco

        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
    return ModelSolids(model).at(data)


class ModelSolids:
    """The solids of a model. Shapes are read once, places whenever its data move.

    Raises ValueError if a geom's shape has no closed form here (a signed distance field's), if
    numbers are not finite or exceed `MAX_LENGTH_M`, or if there are more than `MAX_TRIANGLES`."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._seen = visible_geoms(model)
        _check_shapes(model, self._seen)
        has_mesh = self._seen & ((model.geom_type == MESH) | (model.geom_type == HFIELD))
        self._primitive_geoms, self._mesh_geoms = (
            np.flatnonzero(self._seen & ~has_mesh),
            np.flatnonzero(has_mesh),
        )
        self._shape = model.geom_type[self._primitive_geoms].astype(np.int64)
        self._size = model.geom_size[self._primitive_geoms].astype(np.float64)
        # geoms may share a mesh
        surface = functools.cache(
            lambda shape, number: (
                mesh_surface(model, number) if shape == MESH else height_field(model, number)
            )
        )
        self._surfaces = [
            surface(int(model.geom_type[geom]), int(model.geom_dataid[geom]))
            for geom in self._mesh_geoms
        ]
        self._start = np.cumsum([0, *(len(faces) for _, faces, _ in self._surfaces)])
        self._filled = np.array([closed for *_, closed in self._surfaces], bool)
        self.geom = np.concatenate([self._primitive_geoms, self._mesh_geoms])
        """(n + m,): see `Solids.geom`."""
        self._triangles = np.empty((int(self._start[-1]), 3, 3))
        # NaN equals nothing, so the first call of `at` computes every triangle
        self._placed = np.full((len(self._mesh_geoms), 12), np.nan)

    def at(self, data: mujoco.MjData) -> Solids:
        """Compute the solids at the places that `data` gives.

        Triangles are computed anew only for geoms that have moved since the last call.

        Args:
            data: Forwarded data of the model.

        Returns:
            The solids; their arrays of triangles are shared between calls while nothing moves.

        Raises:
            ValueError: If `data` were never forwarded or are another model's, or if places are not
                finite or exceed `MAX_LENGTH_M`.
        """
        if data.geom_xpos.shape != (self._model.ngeom, 3):
            raise ValueError(
                f"the MjData has {len(data.geom_xpos)} geoms, the model {self._model.ngeom}: give "
                f"data of that model"
            )
        check_forwarded(self._model, data)
        for field, values in (("pos", data.geom_xpos), ("axes", data.geom_xmat)):
            _check_numbers(self._model, field, values, self._seen)
        position = data.geom_xpos[self._primitive_geoms].astype(np.float64)
        rotation = data.geom_xmat[self._primitive_geoms].reshape(-1, 3, 3).astype(np.float64)
        lower, upper = bounding_boxes(self._shape, self._size, position, rotation)
        placed = np.concatenate(
            [data.geom_xpos[self._mesh_geoms], data.geom_xmat[self._mesh_geoms]], axis=1
        )
        moved = np.flatnonzero((placed != self._placed).any(axis=1))
        if len(moved):
            # a copy, since solids that were returned before hold the old array
            self._placed, self._triangles = placed, self._triangles.copy()
            for n in moved:
                vertices, faces, _ = self._surfaces[n]
                # term by term: what a matrix product gives depends on the processor
                columns = data.geom_xmat[self._mesh_geoms[n]].reshape(3, 3).T
                world = (vertices[:, :1] * columns[0] + vertices[:, 1:2] * columns[1]) + vertices[
                    :, 2:
                ] * columns[2]
                self._triangles[self._start[n] : self._start[n + 1]] = (
                    world + data.geom_xpos[self._mesh_geoms[n]]
                )[faces]
        return Solids(
            self._shape,
            self._size,
            position,
            rotation,
            lower,
            upper,
            self._triangles,
            self._start,
            self._filled,
            self.geom,
        )


def check_forwarded(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Check that geoms have places.

    Args:
        model: The compiled world.
        data: Its data.

    Raises:
        ValueError: If `data` were never forwarded; the world would look empty.
    """
    if model.ngeom and not data.geom_xmat[0].any():  # no rotation is all zeros
        raise ValueError(
            "the MjData was never forwarded, so no geom has a place: call "
            "mujoco.mj_forward(model, data)"
        )


def visible_geoms(model: mujoco.MjModel) -> Mask:
    """Return which geoms rays can see, (ngeom,): those of alpha above 0.

    A geom has its material's alpha, or its own without a material."""
    return colours(model)[:, 3] != 0


def colours(model: mujoco.MjModel) -> Floats:
    """Return red, green, blue and alpha (ngeom, 4) of every geom, its material's if it has one."""
    rgba = model.geom_rgba.astype(np.float64)
    dressed = model.geom_matid >= 0
    rgba[dressed] = model.mat_rgba[model.geom_matid[dressed]]
    return rgba


def _check_numbers(model: mujoco.MjModel, field: str, values: Floats, seen: Mask) -> None:
    """Raise ValueError if a visible geom's `values` (ngeom, n) are not finite, or too large."""
    bad = seen & ~(np.abs(values) <= MAX_LENGTH_M).all(axis=1)  # False for NaN, too
    if bad.any():
        value = values[np.argmax(bad)].tolist()
        raise ValueError(
            f"geom {_name(model, bad)}: {field} = {value}, expected numbers up to {MAX_LENGTH_M:g}"
        )


def _check_shapes(model: mujoco.MjModel, seen: Mask) -> None:
    """Raise ValueError for shapes and numbers that kernels, which index unchecked, must not get."""
    bad = seen & (model.geom_type > MESH)
    if bad.any():
        raise ValueError(
            f"geom {_name(model, bad)} is neither a primitive, a mesh nor a height field; use one "
            f"of these"
        )
    _check_numbers(model, "size", model.geom_size, seen)
    for source, values in (
        ("a mesh's vertices", model.mesh_vert),
        ("a height field's size", model.hfield_size),
        ("a height field's heights", model.hfield_data),
    ):
        if not (np.abs(values) <= MAX_LENGTH_M).all():
            raise ValueError(f"{source}: expected finite numbers, up to {MAX_LENGTH_M:g}")
    triangles = int(
        model.mesh_facenum[model.geom_dataid[seen & (model.geom_type == MESH)]].sum(dtype=np.int64)
    )
    # two triangles a cell for the surface, as many for the base; walls fit into the margin
    for field in model.geom_dataid[seen & (model.geom_type == HFIELD)]:
        triangles += 4 * int(model.hfield_nrow[field]) * int(model.hfield_ncol[field])
    if triangles > MAX_TRIANGLES:
        raise ValueError(
            f"meshes and height fields of {triangles} triangles, expected {MAX_TRIANGLES} at "
            f"most; use coarser ones"
        )


def _name(model: mujoco.MjModel, chosen: Mask) -> str:
    """Return the name of the first of the `chosen` geoms, or its number if it has none."""
    first = int(np.argmax(chosen))
    return model.geom(first).name or f"number {first}"


def mesh_surface(model: mujoco.MjModel, mesh: int) -> tuple[Floats, Ints, bool]:
    """Read the surface of a mesh.

    Args:
        model: The compiled world.
        mesh: The mesh's number in it.

    Returns:
        vertices: (V, 3), metres, in the mesh's frame.
        faces: (F, 3), numbers of vertices, turning left seen from outside if the mesh is closed.
        closed: Whether the mesh is closed.
    """
    import trimesh  # takes a second to load, and few worlds hold a mesh

    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    soup = trimesh.Trimesh(
        model.mesh_vert[first : first + count].astype(np.float64),
        model.mesh_face[face : face + faces],
    )
    # each edge joins two faces, but some faces are turned the wrong way
    if not _is_closed(soup.faces) and soup.is_watertight:
        trimesh.repair.fix_winding(soup)
    return np.asarray(soup.vertices), np.asarray(soup.faces, np.int64), _is_closed(soup.faces)


def _is_closed(faces: Ints) -> bool:
    """Whether every edge is walked as often one way as the other by the triangles (T, 3) around it.

    Then each point off the surface has a winding number, also where more than two triangles share
    an edge, as between two boxes that touch along it.
    """
    tail, head = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    count = int(faces.max(initial=0)) + 1
    return bool(np.array_equal(np.sort(tail * count + head), np.sort(head * count + tail)))


def height_field(model: mujoco.MjModel, field: int) -> tuple[Floats, Ints, bool]:
    """Close a height field's surface by walls and a base.

    As in MuJoCo, each cell is cut along the diagonal from its least to its greatest x and y.

    Args:
        model: The compiled world.
        field: The height field's number in it.

    Returns:
        Vertices (V, 3), metres, in the field's frame; faces (F, 3), outward; and True, for closed.
    """
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    first = int(model.hfield_adr[field])
    half_x, half_y, top, base = model.hfield_size[field]
    height = (
        model.hfield_data[first : first + rows * columns].reshape(rows, columns).astype(np.float64)
        * top
    )
    y, x = np.meshgrid(
        np.linspace(-half_y, half_y, rows), np.linspace(-half_x, half_x, columns), indexing="ij"
    )
    above = np.stack([x, y, height], axis=-1).reshape(-1, 3)
    below = np.stack([x, y, np.full_like(height, -base)], axis=-1).reshape(-1, 3)
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        part.ravel()
        for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    surface = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    # the outermost vertices, counter-clockwise seen from above
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    ahead, under = np.roll(rim, -1), rows * columns
    walls = np.concatenate(
        [np.stack([rim, rim + under, ahead], 1), np.stack([ahead, rim + under, ahead + under], 1)]
    )
    # the base is the surface seen from below, so its faces turn the other way
    faces = np.concatenate([surface, surface[:, ::-1] + under, walls])
    return np.concatenate([above, below]), faces, True
