"""Rays through MuJoCo's own ray caster, `mj_multiRay`."""

import copy

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

NEAR_ALONE = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
"""The geom groups that rays see: in the caster's copy of a model, group 0 holds the geoms within range."""
SPARE_M = 1e-6
"""How much larger geoms' boxes are in that copy: what is left out by them does not depend on rounding."""


class MujocoCaster:
    """Casts rays at every visible geom of a compiled model, in its reference configuration or as `data` stands.

    Geoms whose colour (or material) has alpha 0 are not seen; see `visible_geoms`. The model is copied, not changed.
    A caster serves one thread at a time.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData | None = None):
        if data is None:
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)  # where the bodies' bounding volumes are
        self._model = copy.copy(model)
        # mj_multiRay passes over geoms by angles to their boxes, from the system's arctangents: with room to spare,
        # their last bits decide nothing
        self._model.geom_aabb[:, 3:] += SPARE_M
        self._data = data
        _search_every_body(self._model)

    def cast(self, position: ArrayLike, directions: ArrayLike, max_range_m: float) -> NDArray[np.float64]:
        """See `lidarsim.casters.Caster.cast`."""
        vectors = np.ascontiguousarray(directions, dtype=np.float64)
        shape = vectors.shape[:-1]
        count = int(np.prod(shape))
        geoms = np.empty(count, dtype=np.int32)
        distances = np.empty(count, dtype=np.float64)
        origin = np.ascontiguousarray(position, dtype=np.float64)
        # the cutoff alone drops geoms by their bounding spheres, which for tall ones reach far: a third of the time
        lower, upper = _boxes(self._model, self._data)
        away = np.maximum(np.maximum(lower - origin, origin - upper), 0.0)
        self._model.geom_group[:] = (away**2).sum(axis=1) > max_range_m * max_range_m
        mujoco.mj_multiRay(
            self._model,
            self._data,
            origin,
            vectors.reshape(-1),
            NEAR_ALONE,
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


def visible_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which geoms rays can see, (ngeom,): those whose material, or whose own colour without one, has alpha above 0."""
    alpha = model.geom_rgba[:, 3].copy()
    dressed = model.geom_matid >= 0
    alpha[dressed] = model.mat_rgba[model.geom_matid[dressed], 3]
    return alpha != 0


def _boxes(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and greatest corners (ngeom, 3) of the geoms' boxes; planes have no bounds."""
    rotation = data.geom_xmat.reshape(-1, 3, 3)
    centre = data.geom_xpos + np.einsum("gab,gb->ga", rotation, model.geom_aabb[:, :3])
    half = np.einsum("gab,gb->ga", np.abs(rotation), model.geom_aabb[:, 3:])
    half[model.geom_rbound == 0] = np.inf
    return centre - half, centre + half


def _search_every_body(model: mujoco.MjModel) -> None:
    """Make rays find visible geoms that collide with nothing.

    mj_multiRay searches a body only if the ray meets the ball around the body's *colliding* geoms (mj_ray has no such
    shortcut). Where that could hide something, the balls are made as good as infinite.
    """
    ghosts = visible_geoms(model) & (model.geom_contype == 0) & (model.geom_conaffinity == 0)
    if ghosts.any():
        roots = model.body_bvhadr[model.body_bvhadr >= 0]
        model.bvh_aabb[roots] = [0.0, 0.0, 0.0, 1e10, 1e10, 1e10]
