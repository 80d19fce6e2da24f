"""A world: an MJCF document, what it refers to, and the model compiled from exactly these bytes."""

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim import MujocoCaster
from lidarsim.casters.mujoco import visible_geoms
from scenegen.clearance import Clearance
from scenegen.errors import SceneError
from scenegen.truth import Solids, solids_of

FLIGHT_BOUNDS = "flight_bounds"
"""Name of the MJCF <numeric> that holds the box, least corner then greatest, in which the sensor may fly."""

MOST_MOVED_M = 1e-3
"""How far writing a scene as MJCF may move a geom, metres, or turn its axes, radians."""


@dataclass(frozen=True, eq=False)
class World:
    """One world, ready to be scanned. The compiled model is the one source of truth: rays, occupancy and collision
    checks all read it, whether a recipe drew the world or a person did."""

    mjcf: bytes
    """The document, UTF-8."""
    assets: Mapping[str, bytes]
    """The files that the document refers to, by the names it uses."""
    model: mujoco.MjModel
    caster: MujocoCaster
    solids: Solids
    flight_bounds: NDArray[np.float64]
    """(2, 3): least and greatest corner of the box in which the sensor may fly, metres."""
    unseen: tuple[str, ...] = field(default=())
    """Geoms that rays cannot see, and that therefore are not in the truth either."""

    @cached_property
    def clearance(self) -> Clearance:
        """The collision check within the flight bounds."""
        return Clearance(self.solids, self.flight_bounds)


def compile_world(mjcf: bytes, assets: Mapping[str, bytes] | None = None, *, name: str = "world") -> World:
    """Compile an archived document. Raises SceneError, naming `name`, where it cannot serve as a world."""
    assets = dict(assets or {})
    try:
        model = mujoco.MjModel.from_xml_string(mjcf.decode(), assets)
    except (ValueError, UnicodeDecodeError) as error:
        raise SceneError(f"{name}: not valid MJCF: {one_line(error)}") from None
    return _world(model, mjcf, assets, name)


def write_world(add_to: Callable[[mujoco.MjSpec], None], *, flight_bounds: NDArray[np.float64]) -> World:
    """Build a world by adding to an empty MjSpec, write it as MJCF, and compile what was written."""
    spec = mujoco.MjSpec()
    spec.modelname = "scenegen"
    spec.default.geom.rgba = [0.62, 0.64, 0.68, 1.0]
    spec.add_numeric(name=FLIGHT_BOUNDS, data=np.asarray(flight_bounds).reshape(-1), size=6)
    spec.worldbody.add_light(pos=[0, 0, 30], dir=[0.2, 0.1, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    add_to(spec)
    spec.memory = max(1 << 20, 256 * len(spec.geoms))  # as little as will do: it is taken anew for every world
    return compile_world(spec.to_xml().encode())


def load_scene(path: Path) -> tuple[bytes, dict[str, bytes]]:
    """Read an MJCF file drawn by hand and make it self-contained: (document, files by new names).

    Includes are resolved and every mesh, height field and texture is taken along. Planes become infinite, as they are
    for collisions and for the truth: rays would pass beside the rectangle that is drawn. Raises SceneError.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        drawn = spec.compile()
        mjcf, assets = _make_self_contained(spec)
        kept = mujoco.MjModel.from_xml_string(mjcf.decode(), assets)
    except (ValueError, OSError, MemoryError) as error:
        raise SceneError(f"{path}: not valid MJCF: {one_line(error)}") from None
    moved = float(np.abs(_places(drawn) - _places(kept)).max(initial=0.0))
    if moved > MOST_MOVED_M:
        raise SceneError(
            f"{path}: written with MJCF's six digits, a geom moves by {moved:.2g} m; move the scene to the origin"
        )
    return mjcf, assets


def _make_self_contained(spec: mujoco.MjSpec) -> tuple[bytes, dict[str, bytes]]:
    """The document of `spec` with infinite planes, and the files it refers to under names of their own."""
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.size = [0.0, 0.0, geom.size[2] or 1.0]
    assets: dict[str, bytes] = {}
    meshes = Path(spec.modelfiledir) / (spec.compiler.meshdir or "")
    textures = Path(spec.modelfiledir) / (spec.compiler.texturedir or "")
    for folder, items in ((meshes, spec.meshes), (meshes, spec.hfields), (textures, spec.textures)):
        for item in items:
            if item.file:
                item.file = _take_along(folder / item.file, assets)
    spec.compiler.meshdir = spec.compiler.texturedir = ""
    spec.assets = assets
    return spec.to_xml().encode(), assets


def _places(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Where geoms are and how they are turned, (ngeom, 12)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.concatenate([data.geom_xpos, data.geom_xmat], axis=1)


def _take_along(source: Path, assets: dict[str, bytes]) -> str:
    """Put a file among `assets` under a name made of its content and its own, and return that name."""
    content = source.read_bytes()
    safe = re.sub(r"[^A-Za-z0-9._-]", "_", source.name)
    name = f"{hashlib.sha256(content).hexdigest()[:12]}-{safe}"
    assets[name] = content
    return name


def _world(model: mujoco.MjModel, mjcf: bytes, assets: Mapping[str, bytes], name: str) -> World:
    if model.nflex or model.nskin:
        raise SceneError(f"{name}: has flexes or skins, which rays do not see; use geoms instead")
    seen = visible_geoms(model)
    unseen = tuple(model.geom(int(g)).name or f"number {g}" for g in np.flatnonzero(~seen))
    if not seen.any():
        raise SceneError(f"{name}: no geom that rays can see; add some, or give those there an alpha above 0")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    try:
        solids = solids_of(model, data)
    except ValueError as error:
        raise SceneError(f"{name}: {one_line(error)}") from None
    return World(mjcf, assets, model, MujocoCaster(model, data), solids, _flight_bounds(model, solids, name), unseen)


def _flight_bounds(model: mujoco.MjModel, solids: Solids, name: str) -> NDArray[np.float64]:
    """The document's own flight_bounds, or the box around all that is bounded in it."""
    if FLIGHT_BOUNDS in (model.numeric(n).name for n in range(model.nnumeric)):
        data = np.asarray(model.numeric(FLIGHT_BOUNDS).data, dtype=np.float64)
        if data.size != 6 or not (data[:3] < data[3:]).all():
            raise SceneError(
                f"{name}: <numeric {FLIGHT_BOUNDS}> = {data}, expected xmin ymin zmin xmax ymax zmax, rising"
            )
        return data.reshape(2, 3)
    bounded = np.isfinite(solids.lower).all(axis=1)
    corners = np.concatenate([solids.lower[bounded], solids.upper[bounded], solids.triangles.reshape(-1, 3)])
    if not len(corners):
        raise SceneError(f"{name}: only planes, so nothing bounds the flights; add <numeric {FLIGHT_BOUNDS}>")
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def one_line(error: BaseException) -> str:
    """An error's message on one line."""
    return " ".join(str(error).split())
