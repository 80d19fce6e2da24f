"""Rays through MuJoCo's own ray caster, `mj_multiRay`."""

import copy

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray


class MujocoCaster:
    """Casts rays at every visible geom of a compiled model, in its reference configuration or in that of `data`.

    Geoms whose colour (or material) has alpha 0 are not seen; see `visible_geoms`.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData | None = None):
        if data is None:
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
        self._model = _all_searched(model)
        self._data = data

    def cast(self, position: ArrayLike, directions: ArrayLike, max_range_m: float) -> NDArray[np.float64]:
        """See `lidarsim.casters.Caster.cast`."""
        vectors = np.ascontiguousarray(directions, dtype=np.float64)
        shape = vectors.shape[:-1]
        count = int(np.prod(shape))
        geoms = np.empty(count, dtype=np.int32)
        distances = np.empty(count, dtype=np.float64)
        origin = np.ascontiguousarray(position, dtype=np.float64)
        mujoco.mj_multiRay(
            self._model,
            self._data,
            origin,
            vectors.reshape(-1),
            None,  # all geom groups
            True,  # static geoms too
            -1,  # no body left out
            geoms,
            distances,
            None,  # no normals
            count,
            max_range_m,
        )
        missed = (geoms < 0) | (distances > max_range_m)
        return np.where(missed, np.inf, distances).reshape(shape)


def _all_searched(model: mujoco.MjModel) -> mujoco.MjModel:
    """`model`, or where it has visible geoms that collide with nothing, a copy in which rays find these too.

    mj_multiRay searches a body only if the ray meets the ball around the body's *colliding* geoms (mj_ray has no such
    shortcut). The copy's balls are as good as infinite.
    """
    ghosts = visible_geoms(model) & (model.geom_contype == 0) & (model.geom_conaffinity == 0)
    if not ghosts.any():
        return model
    model = copy.copy(model)
    roots = model.body_bvhadr[model.body_bvhadr >= 0]
    model.bvh_aabb[roots] = [0.0, 0.0, 0.0, 1e10, 1e10, 1e10]
    return model


def visible_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which geoms rays can see, (ngeom,): those whose material, or whose own colour without one, has alpha above 0."""
    alpha = model.geom_rgba[:, 3].copy()
    dressed = model.geom_matid >= 0
    alpha[dressed] = model.mat_rgba[model.geom_matid[dressed], 3]
    return alpha != 0
