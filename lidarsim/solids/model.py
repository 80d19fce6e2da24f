"""The solids of a compiled MuJoCo model, read into one table."""

import functools

import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim.limits import MOST_LENGTH_M, MOST_TRIANGLES
from lidarsim.solids.shapes import HFIELD, MESH, Solids, bounding_boxes
from lidarsim.solids.surfaces import height_field, mesh_surface


def solids_of(model: mujoco.MjModel, data: mujoco.MjData | None = None) -> Solids:
    """The solids of `model` in its reference configuration, or in that of `data` where given.

    Raises ValueError for data that were never forwarded, for a geom whose shape has no closed form here (a signed
    distance field's), for numbers that are not finite or beyond `MOST_LENGTH_M`, and for more than `MOST_TRIANGLES`.
    """
    if data is None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
    check_forwarded(model, data)
    seen = visible_geoms(model)
    _check(model, data, seen)
    bent = seen & ((model.geom_type == MESH) | (model.geom_type == HFIELD))
    plain = np.flatnonzero(seen & ~bent)
    shape = model.geom_type[plain].astype(np.int64)
    size = model.geom_size[plain].astype(np.float64)
    position = data.geom_xpos[plain].astype(np.float64)
    rotation = data.geom_xmat[plain].reshape(-1, 3, 3).astype(np.float64)
    lower, upper = bounding_boxes(shape, size, position, rotation)
    surface = functools.cache(
        lambda shape, number: mesh_surface(model, number) if shape == MESH else height_field(model, number)
    )
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
        shape,
        size,
        position,
        rotation,
        lower,
        upper,
        np.concatenate(soups),
        start,
        np.array(filled, dtype=np.bool_),
        np.concatenate([plain, np.flatnonzero(bent)]),
    )


def check_forwarded(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Raise ValueError for data in which no geom has a place yet, and which would show an empty world."""
    if model.ngeom and not data.geom_xmat[0].any():  # no rotation is all zeros
        raise ValueError("the MjData was never forwarded, so no geom has a place: call mujoco.mj_forward(model, data)")


def visible_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which geoms rays can see, (ngeom,): those whose material, or whose own colour without one, has alpha above 0."""
    alpha = model.geom_rgba[:, 3].copy()
    dressed = model.geom_matid >= 0
    alpha[dressed] = model.mat_rgba[model.geom_matid[dressed], 3]
    return alpha != 0


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
