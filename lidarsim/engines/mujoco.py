"""Ray casting by MuJoCo's own `mj_multiRay`."""

import copy
from typing import Self

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from lidarsim.grid import Floats, rays_of
from lidarsim.solids import check_forwarded, visible_geoms

NEAR_GROUPS = np.array([1, 0, 0, 0, 0, 0], np.uint8)
"""The geom groups that rays see: in the engine's copy of a model, group 0 holds the geoms within
range."""
SPARE_M = 1e-6
"""Padding of geoms' boxes in that copy, metres: rounding then decides on no geom."""
SPARE_LENGTH2 = 2e-6
"""How far the squared length of a unit vector may be from 1."""
ROUNDED = 1e-11
"""Vectors whose squared length is within this of 1 are used unchanged; others are scaled to
length 1."""


class MujocoEngine:
    """Casts rays at every visible geom of a compiled model, in its reference configuration or as
    `data` stands: an `Engine`.

    The model is copied, not changed. Bodies that move in `data` are seen where they are at the time
    of the cast.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        self._model = copy.copy(model)
        # mj_multiRay passes over geoms by angles to their boxes, from the system's arctangents:
        # with room to spare, their last bits decide nothing
        self._model.geom_aabb[:, 3:] += SPARE_M
        self._data = data
        _search_every_body(self._model)

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData | None = None) -> Self:
        """See `lidarsim.engines.Engine.of`.

        Args:
            model: The world.
            data: Where bodies are.

        Returns:
            The engine; a later change of `data` is seen by the next cast.
        """
        if data is None:
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)  # where the bodies' bounding volumes are
        return cls(model, data)

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """See `lidarsim.engines.Caster.cast`.

        Returns:
            (P, *shape), metres.

        Raises:
            ValueError: If data were never forwarded, or arrays have wrong shapes.
        """
        starts, vectors = rays_of(origins, directions, max_range_m)
        check_forwarded(self._model, self._data)
        ranges = np.empty(vectors.shape[:-1], np.float64)
        # the cutoff alone drops geoms by their bounding spheres, which for tall ones reach far: a
        # third of the time
        lower, upper = _boxes(self._model, self._data)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            length2 = (vectors * vectors).sum(axis=-1)
            invalid, rough = (
                ~(np.abs(length2 - 1.0) <= spare) for spare in (SPARE_LENGTH2, ROUNDED)
            )
            if rough.any():  # MuJoCo would count in lengths of the vector, and stop at one without
                vectors[rough] /= np.sqrt(length2[rough])[:, None]
                vectors[invalid] = 1.0, 0.0, 0.0
        count = int(np.prod(ranges.shape[1:]))
        geoms, distances = np.empty(count, np.int32), np.empty(count)
        for p, origin in enumerate(starts):
            if not np.isfinite(origin).all():
                invalid[p] = True
                continue
            gap = np.maximum(np.maximum(lower - origin, origin - upper), 0.0)
            self._model.geom_group[:] = (gap**2).sum(axis=1) > max_range_m * max_range_m
            mujoco.mj_multiRay(
                self._model,
                self._data,
                origin,
                vectors[p].reshape(-1),
                NEAR_GROUPS,
                True,  # static geoms too
                -1,  # no body left out
                geoms,
                distances,
                None,  # no normals
                len(geoms),
                max_range_m,
            )
            missed = (geoms < 0) | (distances > max_range_m)
            ranges[p] = np.where(missed, np.inf, distances).reshape(ranges[p].shape)
        ranges[invalid] = np.inf
        return ranges


def _boxes(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Floats, Floats]:
    """Compute least and greatest corners (ngeom, 3) of the geoms' boxes; infinite for planes."""
    rotation = data.geom_xmat.reshape(-1, 3, 3)
    centre = data.geom_xpos + np.einsum("gab,gb->ga", rotation, model.geom_aabb[:, :3])
    half = np.einsum("gab,gb->ga", np.abs(rotation), model.geom_aabb[:, 3:])
    half[model.geom_rbound == 0] = np.inf
    return centre - half, centre + half


def _search_every_body(model: mujoco.MjModel) -> None:
    """Make rays find visible geoms that collide with nothing.

    mj_multiRay searches a body only if the ray meets the ball around the body's *colliding* geoms
    (mj_ray has no such shortcut). If that could hide a geom, the balls are made practically
    infinite."""
    ghosts = visible_geoms(model) & (model.geom_contype == 0) & (model.geom_conaffinity == 0)
    if ghosts.any():
        roots = model.body_bvhadr[model.body_bvhadr >= 0]
        model.bvh_aabb[roots] = [0.0, 0.0, 0.0, 1e10, 1e10, 1e10]
