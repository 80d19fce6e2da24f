"""A world: an MJCF document, what it refers to, and the model compiled from exactly these bytes."""

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim.parameters import MOST_LENGTH_M
from lidarsim.solids.model import solids_of, visible_geoms
from lidarsim.solids.shapes import Solids
from scenegen.errors import SceneError, printable, short
from scenegen.worlds.clearance import Clearance
from scenegen.worlds.drawing import FLIGHT_BOUNDS, Drawing


@contextmanager
def quiet_mujoco() -> Iterator[list[str]]:
    """While the block runs, MuJoCo's warnings go to the list that it gets, and to nothing else.

    Left alone, MuJoCo prints them and appends them to a file in the working folder. Whoever else
    uses MuJoCo in this process finds its own handler again afterwards.
    """
    told: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(told.append)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield told
    finally:
        mujoco.set_mju_user_warning(before)


@dataclass(frozen=True, eq=False)
class World:
    """One world, ready for an engine to scan it. The compiled model is the one source of truth:
    rays, occupancy and collision checks all read it, whether a recipe drew the world or a person
    did."""

    mjcf: bytes
    """The document, UTF-8."""
    assets: Mapping[str, bytes]
    """The files that the document refers to, by the names it uses."""
    model: mujoco.MjModel
    data: mujoco.MjData
    """The model's reference configuration, forwarded: where its geoms are. Not to be changed."""
    solids: Solids
    flight_bounds: NDArray[np.float64]
    """(2, 3): least and greatest corner of the box in which the sensor may fly, metres."""
    unseen: tuple[str, ...] = field(default=())
    """Geoms that rays cannot see, and that therefore are not in the truth either."""

    @cached_property
    def clearance(self) -> Clearance:
        """The collision check within the flight bounds."""
        return Clearance(self.solids, self.flight_bounds)


def compile_world(
    mjcf: bytes, assets: Mapping[str, bytes] | None = None, *, name: str = "world"
) -> World:
    """Compile an archived document. Raises SceneError, naming `name`, where it cannot serve as a
    world."""
    assets = dict(assets or {})
    with quiet_mujoco():
        try:
            model = mujoco.MjModel.from_xml_string(mjcf.decode(), assets)
        except (ValueError, UnicodeDecodeError, mujoco.FatalError) as error:
            raise SceneError(f"{name}: not valid MJCF: {printable(error)}") from None
        return _world(model, mjcf, assets, name)


def write_world(add_to: Callable[[Drawing], None], *, flight_bounds: NDArray[np.float64]) -> World:
    """Build a world by adding to an empty drawing, write it as MJCF, and compile what was
    written."""
    with quiet_mujoco():
        drawing = Drawing(flight_bounds)
        add_to(drawing)
        mjcf = drawing.mjcf()
    return compile_world(mjcf)


def _world(model: mujoco.MjModel, mjcf: bytes, assets: Mapping[str, bytes], name: str) -> World:
    if model.nflex or model.nskin:
        raise SceneError(f"{name}: has flexes or skins, which rays do not see; use geoms instead")
    seen = visible_geoms(model)
    unseen = tuple(model.geom(int(g)).name or f"number {g}" for g in np.flatnonzero(~seen))
    if not seen.any():
        raise SceneError(
            f"{name}: no geom that rays can see; add some, or give those there an alpha above 0"
        )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    try:
        solids = solids_of(model, data)
    except ValueError as error:
        raise SceneError(f"{name}: {printable(error)}") from None
    return World(mjcf, assets, model, data, solids, _flight_bounds(model, solids, name), unseen)


def _flight_bounds(model: mujoco.MjModel, solids: Solids, name: str) -> NDArray[np.float64]:
    """The document's own flight_bounds, or the box around all that is bounded in it."""
    if FLIGHT_BOUNDS in (model.numeric(n).name for n in range(model.nnumeric)):
        data = np.asarray(model.numeric(FLIGHT_BOUNDS).data, dtype=np.float64)
        if (
            data.size != 6
            or not (data[:3] < data[3:]).all()
            or not (np.abs(data) <= MOST_LENGTH_M).all()
        ):
            raise SceneError(
                f"{name}: <numeric {FLIGHT_BOUNDS}> = {short(data.tolist())}, expected xmin ymin "
                f"zmin xmax ymax zmax, "
                f"rising, up to {MOST_LENGTH_M:g}"
            )
        return data.reshape(2, 3)
    bounded = np.isfinite(solids.lower).all(axis=1)
    corners = np.concatenate(
        [solids.lower[bounded], solids.upper[bounded], solids.triangles.reshape(-1, 3)]
    )
    if not len(corners):
        raise SceneError(
            f"{name}: only planes, so nothing bounds the flights; add <numeric {FLIGHT_BOUNDS}>"
        )
    return np.stack([corners.min(axis=0), corners.max(axis=0)])
