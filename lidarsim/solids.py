"""Solids: what stands in a world, as data, with no opinion on how rays or voxels meet it; and those
of a compiled MuJoCo model, read into one table."""

import functools
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lidarsim.grid import Floats, Ints, Mask
from lidarsim.jit import kernel
from lidarsim.parameters import MOST_LENGTH_M, MOST_TRIANGLES

if TYPE_CHECKING:
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
def joining(one, other):
    """The vector from one point to another."""
    return other[0] - one[0], other[1] - one[1], other[2] - one[2]


@kernel
def local(axes, x, y, z):
    """A vector of the world's in the frame of a shape whose rotation is `axes` (3, 3)."""
    return (
        axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z,
        axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z,
        axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z,
    )


def bounding_boxes(
    shape: Ints, size: Floats, position: Floats, rotation: Floats
) -> tuple[Floats, Floats]:
    """Axis-aligned bounding boxes (n, 3), (n, 3) of primitives; see `Solids`."""
    reach = np.full(position.shape, np.inf)
    for kind in set(shape.tolist()):
        of = shape == kind
        x, y, z = np.moveaxis(rotation[of], 2, 0)
        a, b, c = size[of].T[..., None]
        if kind == SPHERE:
            reach[of] = a
        elif kind == CAPSULE:
            reach[of] = a + abs(z) * b
        elif kind == CYLINDER:
            reach[of] = a * np.sqrt(np.maximum(1.0 - z * z, 0.0)) + abs(z) * b
        elif kind == BOX:
            reach[of] = abs(x) * a + abs(y) * b + abs(z) * c
        elif kind == ELLIPSOID:
            reach[of] = np.sqrt((x * a) ** 2 + (y * b) ** 2 + (z * c) ** 2)
    return position - reach, position + reach


def solids_of(model: "mujoco.MjModel", data: "mujoco.MjData | None" = None) -> Solids:
    """The solids of `model` in its reference configuration, or in that of `data` where given.

    Raises ValueError as `ModelSolids` does.
    """
    if data is None:
        import mujoco  # which takes long: readers of datasets need no engine

        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
    return ModelSolids(model).at(data)


class ModelSolids:
    """The solids of a model, whose shapes are read once and whose places are read as often as its
    data move.

    Raises ValueError for a geom whose shape has no closed form here (a signed distance field's),
    for numbers that are not finite or beyond `MOST_LENGTH_M`, and for more than `MOST_TRIANGLES`.
    """

    def __init__(self, model: "mujoco.MjModel"):
        self._model = model
        self._seen = visible_geoms(model)
        _check_shapes(model, self._seen)
        bent = self._seen & ((model.geom_type == MESH) | (model.geom_type == HFIELD))
        self._plain, self._bent = np.flatnonzero(self._seen & ~bent), np.flatnonzero(bent)
        self._shape = model.geom_type[self._plain].astype(np.int64)
        self._size = model.geom_size[self._plain].astype(np.float64)
        surface = functools.cache(
            lambda shape, number: (
                mesh_surface(model, number) if shape == MESH else height_field(model, number)
            )
        )
        self._surfaces = [
            surface(int(model.geom_type[geom]), int(model.geom_dataid[geom])) for geom in self._bent
        ]
        self._start = np.cumsum([0, *(len(faces) for _, faces, _ in self._surfaces)])
        self._filled = np.array([closed for *_, closed in self._surfaces], bool)
        self.geom = np.concatenate([self._plain, self._bent])
        """(n + m,): see `Solids.geom`."""
        self._triangles = np.empty((int(self._start[-1]), 3, 3))
        self._placed = np.full((len(self._bent), 12), np.nan)

    def at(self, data: "mujoco.MjData") -> Solids:
        """The solids where `data` has them; triangles are computed anew for geoms that moved since
        the last call.

        Raises ValueError for data that were never forwarded, or are another model's, and for places
        that are not finite or beyond `MOST_LENGTH_M`.
        """
        if data.geom_xpos.shape != (self._model.ngeom, 3):
            raise ValueError(
                f"the MjData has {len(data.geom_xpos)} geoms, the model {self._model.ngeom}: give "
                f"data of that model"
            )
        check_forwarded(self._model, data)
        for what, values in (("pos", data.geom_xpos), ("axes", data.geom_xmat)):
            _check_numbers(self._model, what, values, self._seen)
        position = data.geom_xpos[self._plain].astype(np.float64)
        rotation = data.geom_xmat[self._plain].reshape(-1, 3, 3).astype(np.float64)
        lower, upper = bounding_boxes(self._shape, self._size, position, rotation)
        placed = np.concatenate([data.geom_xpos[self._bent], data.geom_xmat[self._bent]], axis=1)
        moved = np.flatnonzero((placed != self._placed).any(axis=1))
        if len(moved):
            self._placed, self._triangles = placed, self._triangles.copy()
            for n in moved:
                vertices, faces, _ = self._surfaces[n]
                # term by term: what a matrix product gives depends on the processor
                columns = data.geom_xmat[self._bent[n]].reshape(3, 3).T
                world = (vertices[:, :1] * columns[0] + vertices[:, 1:2] * columns[1]) + vertices[
                    :, 2:
                ] * columns[2]
                self._triangles[self._start[n] : self._start[n + 1]] = (
                    world + data.geom_xpos[self._bent[n]]
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


def check_forwarded(model: "mujoco.MjModel", data: "mujoco.MjData") -> None:
    """Raise ValueError for data in which no geom has a place yet, and which would show an empty
    world."""
    if model.ngeom and not data.geom_xmat[0].any():  # no rotation is all zeros
        raise ValueError(
            "the MjData was never forwarded, so no geom has a place: call "
            "mujoco.mj_forward(model, data)"
        )


def visible_geoms(model: "mujoco.MjModel") -> Mask:
    """Which geoms rays can see, (ngeom,): those whose material, or whose own colour without one,
    has alpha above 0."""
    return colours(model)[:, 3] != 0


def colours(model: "mujoco.MjModel") -> Floats:
    """Red, green, blue and alpha (ngeom, 4) of every geom: its material's, or its own without
    one."""
    found = model.geom_rgba.astype(np.float64)
    dressed = model.geom_matid >= 0
    found[dressed] = model.mat_rgba[model.geom_matid[dressed]]
    return found


def _check_numbers(model: "mujoco.MjModel", what: str, values: Floats, seen: Mask) -> None:
    """Raise ValueError for `values` (ngeom, n) of geoms that are not finite, or too large: geoms
    that are nowhere, or too far away."""
    odd = seen & ~(np.abs(values) <= MOST_LENGTH_M).all(axis=1)  # a NaN is not
    if odd.any():
        value = values[np.argmax(odd)].tolist()
        raise ValueError(
            f"geom {_name(model, odd)}: {what} = {value}, expected numbers up to {MOST_LENGTH_M:g}"
        )


def _check_shapes(model: "mujoco.MjModel", seen: Mask) -> None:
    """Raise ValueError for what no kernel may see. Kernels index by these numbers, unchecked."""
    odd = seen & (model.geom_type > MESH)
    if odd.any():
        raise ValueError(
            f"geom {_name(model, odd)} is neither a primitive, a mesh nor a height field; use one "
            f"of these"
        )
    _check_numbers(model, "size", model.geom_size, seen)
    for what, values in (
        ("a mesh's vertices", model.mesh_vert),
        ("a height field's size", model.hfield_size),
        ("a height field's heights", model.hfield_data),
    ):
        if not (np.abs(values) <= MOST_LENGTH_M).all():
            raise ValueError(f"{what}: expected finite numbers, up to {MOST_LENGTH_M:g}")
    triangles = int(
        model.mesh_facenum[model.geom_dataid[seen & (model.geom_type == MESH)]].sum(dtype=np.int64)
    )
    for field in model.geom_dataid[seen & (model.geom_type == HFIELD)]:
        triangles += 4 * int(model.hfield_nrow[field]) * int(model.hfield_ncol[field])
    if triangles > MOST_TRIANGLES:
        raise ValueError(
            f"meshes and height fields of {triangles} triangles, expected {MOST_TRIANGLES} at "
            f"most; use coarser ones"
        )


def _name(model: "mujoco.MjModel", chosen: Mask) -> str:
    """The name of the first of the `chosen` geoms, or its number where it has none."""
    first = int(np.argmax(chosen))
    return model.geom(first).name or f"number {first}"


def mesh_surface(model: "mujoco.MjModel", mesh: int) -> tuple[Floats, Ints, bool]:
    """Vertices, faces (outward where closed) and whether the mesh is closed."""
    import trimesh  # takes a second to load, and few worlds hold a mesh

    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    soup = trimesh.Trimesh(
        model.mesh_vert[first : first + count].astype(np.float64),
        model.mesh_face[face : face + faces],
    )
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


def height_field(model: "mujoco.MjModel", field: int) -> tuple[Floats, Ints, bool]:
    """MuJoCo's surface (each cell cut along the diagonal from its least x and y to its greatest),
    walls, and base."""
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
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    ahead, under = np.roll(rim, -1), rows * columns
    walls = np.concatenate(
        [np.stack([rim, rim + under, ahead], 1), np.stack([ahead, rim + under, ahead + under], 1)]
    )
    faces = np.concatenate([surface, surface[:, ::-1] + under, walls])
    return np.concatenate([above, below]), faces, True
