"""A world: an MJCF document, what it refers to, the model compiled from exactly these bytes, and a
digest that tells it from other worlds."""

import hashlib
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim import Engine, GridSpec, Pose, Scan, Sensor
from lidarsim.engines import EngineFactory
from lidarsim.grid import Floats, Mask
from lidarsim.noise.returns import albedo_of
from lidarsim.parameters import MOST_LENGTH_M
from lidarsim.solids import BOX, CAPSULE, CYLINDER, PLANE, SPHERE, Solids, solids_of, visible_geoms
from scenegen.base.errors import SceneError, raised_as, short
from scenegen.truth import rasterize
from scenegen.worlds.clearance import Clearance
from scenegen.worlds.drawing import FLIGHT_BOUNDS, Drawing
from scenegen.worlds.mapping import Known
from scenegen.worlds.place import Place, archived_place, named_map


@contextmanager
def quiet_mujoco() -> Iterator[list[str]]:
    """While the block runs, MuJoCo's warnings go to the list that it gets, and to nothing else.

    Left alone, MuJoCo prints them and appends them to a file in the working folder. Whoever else
    uses MuJoCo in this process finds its own handler again afterwards.
    """
    messages: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield messages
    finally:
        mujoco.set_mju_user_warning(before)


@dataclass(frozen=True, eq=False, repr=False)
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
    flight_bounds: Floats
    """(2, 3): least and greatest corner of the box in which the sensor may fly, metres."""
    unseen: tuple[str, ...] = ()
    """Geoms that rays cannot see, and that therefore are not in the truth either."""

    def __repr__(self) -> str:
        return f"<World: {len(self.solids)} solids>"

    @cached_property
    def clearance(self) -> Clearance:
        """The collision check within the flight bounds."""
        return Clearance(self.solids, self.flight_bounds)

    def room(self, radius_m: float, length_m: float, *, rng: np.random.Generator) -> Floats:
        """Where to plan the next flight, (2, 3) metres: the flight bounds."""
        return self.flight_bounds

    @property
    def albedo(self) -> Floats:
        """What share of light every geom reflects, (ngeom,)."""
        return albedo_of(self.model)

    @cached_property
    def _casters(self) -> dict[EngineFactory, Engine]:
        return {}

    def caster(self, engine: EngineFactory) -> Engine:
        """What casts rays in it, made by `engine`, once: flights through a world from a file share
        it. Raises SceneError where the engine refuses it, or finds no device."""
        if engine not in self._casters:
            with raised_as(SceneError):
                self._casters[engine] = engine(self.model, self.data)
        return self._casters[engine]

    def truth(self, grid: GridSpec, origin: Floats) -> dict[str, Mask]:
        """The field of a sample that says what is there, `occupancy`."""
        return {"occupancy": rasterize(self.solids, grid, origin)}

    def is_known(self, pose: Pose, lidar: Sensor, known: Known) -> bool:
        """Whether enough is known of it at a pose: all is."""
        return True

    def unknown_m(self, scan: Scan) -> Floats:
        """Metres of unknown space that each ray of a scan crosses, (*lidar.shape): none."""
        return np.zeros(scan.ranges.shape)


AnyWorld = World | Place
"""What one flies through and scans: a world of solids, or the map of a real place."""


def solid(world: AnyWorld, where: str) -> World:
    """`world`, where solids are needed. Raises SceneError, naming `where`, for a map."""
    if isinstance(world, Place):
        raise SceneError(f"{where}: is a map of voxels, which has no solids to show")
    return world


def archived_world(mjcf: bytes, assets: Mapping[str, bytes], *, name: str) -> AnyWorld:
    """Read the world of an archived document, of solids or a map. Raises as `compile_world`."""
    if named_map(mjcf):
        return archived_place(mjcf, assets, name)
    return compile_world(mjcf, assets, name=name)


def compile_world(
    mjcf: bytes, assets: Mapping[str, bytes] | None = None, *, name: str = "world"
) -> World:
    """Compile an archived document.

    Args:
        mjcf: The document, UTF-8.
        assets: The files that it refers to, by the names it uses.
        name: What the error names.

    Raises:
        SceneError: It cannot serve as a world.
    """
    assets = dict(assets or {})
    with quiet_mujoco():
        refused = (ValueError, mujoco.FatalError)
        with raised_as(SceneError, f"{name}: not valid MJCF: ", of=refused):
            model = mujoco.MjModel.from_xml_string(mjcf.decode(), assets)
        seen = visible_geoms(model)
        unseen = tuple(model.geom(int(g)).name or f"number {g}" for g in np.flatnonzero(~seen))
        if not seen.any():
            raise SceneError(
                f"{name}: no geom that rays can see; add some, or give those there an alpha above 0"
            )
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        with raised_as(SceneError, f"{name}: "):
            solids = solids_of(model, data)
        return World(mjcf, assets, model, data, solids, _flight_bounds(model, solids, name), unseen)


def write_world(add_to: Callable[[Drawing], None], *, flight_bounds: Floats) -> World:
    """Build a world by adding to an empty drawing, write it as MJCF, and compile what was
    written."""
    with quiet_mujoco():
        drawing = Drawing(flight_bounds)
        add_to(drawing)
        mjcf = drawing.mjcf()
    return compile_world(mjcf)


def _flight_bounds(model: mujoco.MjModel, solids: Solids, name: str) -> Floats:
    """The document's own flight_bounds, or the box around all that is bounded in it."""
    if FLIGHT_BOUNDS in (model.numeric(n).name for n in range(model.nnumeric)):
        data = np.asarray(model.numeric(FLIGHT_BOUNDS).data, float)
        small = data.size == 6 and (np.abs(data) <= MOST_LENGTH_M).all()
        if not (small and (data[:3] < data[3:]).all()):
            raise SceneError(
                f"{name}: <numeric {FLIGHT_BOUNDS}> = {short(data.tolist())}, expected xmin ymin "
                f"zmin xmax ymax zmax, rising, up to {MOST_LENGTH_M:g}"
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


ROUND_M = 1e-5
"""Lengths are rounded to this before they are hashed: more than arithmetic can move them, less than
matters."""


def geometry_digest(solids: Solids) -> bytes:
    """SHA-256 of what fills space: every solid in a form of its own, sorted.

    Two worlds with the same solids have the same digest, whatever the order, names, bodies or
    colours, the sign of a quaternion, or which of a solid's equal placings was written (a box
    turned by 90° with its sizes exchanged). A world moved as a whole is another world.
    """
    rows = [np.zeros((0, 16))]
    for shape in np.unique(solids.shape):
        chosen = solids.shape == shape
        numbers = solids.size[chosen], solids.position[chosen], solids.rotation[chosen]
        form = _form(int(shape), *numbers)
        # negative zeros are zeros
        rounded = np.rint(form / ROUND_M) + 0.0
        rows.append(np.concatenate([np.full((len(form), 1), float(shape)), rounded], axis=1))
    table = np.concatenate(rows)
    digest = hashlib.sha256(table[np.lexsort(table.T[::-1])].tobytes())
    meshes = np.split(solids.triangles, solids.mesh_start[1:-1])
    filled = solids.mesh_filled.tolist()
    for mesh in sorted(map(_mesh_digest, meshes, filled)):
        digest.update(mesh)
    return digest.digest()


def _form(shape: int, size: Floats, position: Floats, rotation: Floats) -> Floats:
    """Numbers that depend only on the points that each solid of a shape fills, (n, 15): position
    and moments, which do not change with the sign of a quaternion, or if a box is turned by 90° and
    its sizes are exchanged."""
    if shape == PLANE:
        normal = rotation[:, :, 2]
        offset = (normal * position).sum(axis=1, keepdims=True)
        return np.concatenate([normal, offset, np.zeros((len(size), 11))], axis=1)
    radii = size
    if shape == SPHERE:
        radii = size[:, [0, 0, 0]]
    elif shape in (CAPSULE, CYLINDER):
        radii = size[:, [0, 0, 1]]
    axes = rotation * radii[:, None, :]
    second = np.einsum("nij,nkj->nik", axes, axes).reshape(-1, 9)
    # second moments do not tell turned cubes apart; of round shapes, higher ones change with a spin
    fourth = (axes**4).sum(axis=2) ** 0.25 if shape == BOX else np.zeros((len(size), 3))
    return np.concatenate([position, second, fourth], axis=1)


def _mesh_digest(triangles: Floats, filled: bool) -> bytes:
    """A digest of a soup of triangles (T, 3, 3) that does not depend on the order of triangles or
    of their corners."""
    rounded = (np.rint(triangles / ROUND_M) + 0.0).astype(np.int64).view(np.uint64)
    corners = _mixed(rounded[..., 0] + _mixed(rounded[..., 1] + _mixed(rounded[..., 2])))
    total = int(_mixed(corners.sum(axis=1)).sum())
    return hashlib.sha256(bytes([filled]) + len(triangles).to_bytes(8) + total.to_bytes(8)).digest()


def _mixed(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Numbers that look random, one for each (splitmix64: Steele, Lea and Flood 2014)."""
    z = numbers + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
