"""A world: an MJCF document, its files, the model compiled from exactly these bytes, and a digest
of its geometry."""

import hashlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim import AnalyticEngine, Engine, GridSpec, Pose, Scan, Sensor
from lidarsim.engines import Caster, EngineFactory
from lidarsim.grid import Floats, Mask
from lidarsim.movers import Movers, MovingCaster
from lidarsim.noise.returns import GREY, albedo_of
from lidarsim.parameters import MAX_LENGTH_M, short_repr
from lidarsim.solids import BOX, CAPSULE, CYLINDER, PLANE, SPHERE, Solids, solids_of, visible_geoms
from scenegen.base.errors import SceneError, reraise_as
from scenegen.truth import rasterize
from scenegen.worlds.clearance import Clearance
from scenegen.worlds.drawing import FLIGHT_BOUNDS, Drawing
from scenegen.worlds.mapping import Known
from scenegen.worlds.movers import TEXT, Zones, draw_movers, read_text, with_text
from scenegen.worlds.place import Place, archived_place, named_map
from scenegen.worlds.traffic import Traffic


@contextmanager
def quiet_mujoco() -> Iterator[list[str]]:
    """Redirect MuJoCo's warnings to a list while the block runs.

    Otherwise MuJoCo prints them and appends them to a file in the working folder. The handler that
    was set before is restored afterwards."""
    messages: list[str] = []
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield messages
    finally:
        mujoco.set_mju_user_warning(previous)


@dataclass(frozen=True, eq=False, repr=False)
class World:
    """A world that an engine can scan. The compiled model is the only source of truth: rays,
    occupancy and collision checks all read it, whether a recipe drew the world or a person did."""

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
    movers: Movers | None = None
    """What moves in it. All else of this class is of what stands still."""
    unseen: tuple[str, ...] = ()
    """Geoms that rays cannot see, and that therefore are not in the truth either."""

    def __repr__(self) -> str:
        return f"<World: {len(self.solids)} solids>"

    @cached_property
    def clearance(self) -> Clearance:
        """The collision check within the flight bounds."""
        return Clearance(self.solids, self.flight_bounds)

    def room(self, radius_m: float, length_m: float, *, rng: np.random.Generator) -> Floats:
        """Return the box in which to plan the next flight, (2, 3) metres: the flight bounds.

        Args:
            radius_m: Not needed; maps of real places need it.
            length_m: Not needed.
            rng: Not needed.

        Returns:
            Least and greatest corner, (2, 3).
        """
        return self.flight_bounds

    @cached_property
    def albedo(self) -> Floats:
        """The share of light that every geom reflects, (ngeom,), and every solid of movers."""
        solids = 0 if self.movers is None else len(self.movers.owner)
        return np.append(albedo_of(self.model), np.full(solids, GREY))

    @cached_property
    def _casters(self) -> dict[EngineFactory, Engine]:
        return {}

    def caster(self, engine: EngineFactory) -> Engine:
        """Return the caster that `engine` makes of this world, cached: flights through it share it.
        Raises SceneError if the engine refuses the world, or finds no device."""
        if engine not in self._casters:
            with reraise_as(SceneError):
                self._casters[engine] = engine(self.model, self.data)
        return self._casters[engine]

    def caster_at(self, engine: EngineFactory, time_s: ArrayLike) -> Caster:
        """Return the caster of this world at a time.

        Args:
            engine: As for `caster`.
            time_s: Seconds; one number, or one for each ray of a pose.
        """
        standing = self.caster(engine)
        if self.movers is None:
            return standing
        return MovingCaster(standing, self.movers, time_s, geoms=self.model.ngeom)

    def truth(self, grid: GridSpec, origin: Floats) -> dict[str, Mask]:
        """Compute the ground truth of a sample.

        Args:
            grid: The sample's grid.
            origin: (3,): its least corner in the world, metres.

        Returns:
            The field `occupancy`.
        """
        return {"occupancy": rasterize(self.solids, grid, origin)}

    def is_known(self, pose: Pose, lidar: Sensor, known: Known) -> bool:
        """Tell whether enough of the world is known at a pose: always, in a world of solids.

        Args:
            pose: Not needed; maps of real places need all three.
            lidar: Not needed.
            known: Not needed.

        Returns:
            True.
        """
        return True

    def unknown_m(self, scan: Scan) -> Floats:
        """Return metres of unknown space that each ray of a scan crosses, (*lidar.shape): 0."""
        return np.zeros(scan.ranges.shape)


AnyWorld = World | Place
"""A world of solids, or the map of a real place."""


def solid(world: AnyWorld, where: str) -> World:
    """Require a world of solids.

    Args:
        world: A world.
        where: Its name, for the message.

    Returns:
        The same world.

    Raises:
        SceneError: If it is a map.
    """
    if isinstance(world, Place):
        raise SceneError(f"{where}: is a map of voxels, which has no solids to show")
    return world


def archived_world(mjcf: bytes, assets: Mapping[str, bytes], *, name: str) -> AnyWorld:
    """Read the world of an archived document, of solids or a map.

    Args:
        mjcf: The document, UTF-8.
        assets: The files that it refers to, by name.
        name: Its name, for messages.

    Returns:
        The world.

    Raises:
        SceneError: If it cannot serve as a world.
    """
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
        name: Its name, for messages.

    Returns:
        The world.

    Raises:
        SceneError: If it cannot serve as a world.
    """
    assets = dict(assets or {})
    with quiet_mujoco():
        refused = (ValueError, mujoco.FatalError)
        with reraise_as(SceneError, f"{name}: not valid MJCF: ", of=refused):
            model = mujoco.MjModel.from_xml_string(mjcf.decode(), assets)
        seen = visible_geoms(model)
        unseen = tuple(model.geom(int(g)).name or f"number {g}" for g in np.flatnonzero(~seen))
        if not seen.any():
            raise SceneError(
                f"{name}: no geom that rays can see; add some, or give those there an alpha above 0"
            )
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        # MuJoCo's own rays need the bodies' bounding volumes, which this computes
        mujoco.mj_comPos(model, data)
        with reraise_as(SceneError, f"{name}: "):
            solids = solids_of(model, data)
            movers = movers_of(model)
        bounds = _flight_bounds(model, solids, name)
        return World(mjcf, assets, model, data, solids, bounds, movers, unseen)


def movers_of(model: mujoco.MjModel) -> Movers | None:
    """Read the movers of a document, if it has some.

    Args:
        model: The compiled document.

    Returns:
        The movers, or None.

    Raises:
        ValueError: If they are damaged.
    """
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, TEXT)
    if number < 0:
        return None
    first, size = int(model.text_adr[number]), int(model.text_size[number])
    # MuJoCo ends texts by a zero byte
    return read_text(bytes(model.text_data[first : first + size - 1]).decode())


def populated(
    world: World, zones: Zones, traffic: Traffic, *, rng: np.random.Generator
) -> World | None:
    """Add movers to a world.

    Args:
        world: The world, without movers.
        zones: Where movers belong.
        traffic: How many there are, and how they move.
        rng: Decides everything that is random.

    Returns:
        The world with movers, in its document, too; None if they find no room.
    """
    caster = world.caster(AnalyticEngine.of)
    movers = draw_movers(world.solids, caster, zones, traffic, rng=rng)
    if movers is None:
        return None
    moving = replace(world, mjcf=with_text(world.mjcf, movers), movers=movers)
    # what stands still is the same, and so are its engines
    moving._casters.update(world._casters)
    return moving


MOVER_DRAWS = 20
"""Draws of movers for one world before it is refused."""


def with_movers(
    world: AnyWorld, zones: Zones, traffic: Traffic, *, seed: Sequence[int], name: str
) -> World:
    """Add movers to a world that stays the same, unless it has some.

    Args:
        world: The world.
        zones, traffic: As for `populated`.
        seed: Seed of the movers.
        name: Name of the world, for messages.

    Returns:
        The world with movers, in its document, too.

    Raises:
        SceneError: If it is a map, or movers find no room.
    """
    if isinstance(world, Place):
        raise SceneError(f"{name}: is a map of a real place; leave --movers out")
    if world.movers is not None:
        return world
    for draw in range(MOVER_DRAWS):
        moving = populated(world, zones, traffic, rng=np.random.default_rng([*seed, draw]))
        if moving is not None:
            return moving
    raise SceneError(f"{name}: movers find no room in {MOVER_DRAWS} draws; have fewer of them")


def write_world(add_to: Callable[[Drawing], None], *, flight_bounds: Floats) -> World:
    """Draw a world, write it as MJCF, and compile the document.

    Args:
        add_to: Adds solids to an empty drawing.
        flight_bounds: (2, 3): the box in which the sensor may fly, metres.

    Returns:
        The world.
    """
    with quiet_mujoco():
        drawing = Drawing(flight_bounds)
        add_to(drawing)
        mjcf = drawing.mjcf()
    return compile_world(mjcf)


def _flight_bounds(model: mujoco.MjModel, solids: Solids, name: str) -> Floats:
    """Return the document's own flight_bounds, or the box around all its bounded solids."""
    if FLIGHT_BOUNDS in (model.numeric(n).name for n in range(model.nnumeric)):
        data = np.asarray(model.numeric(FLIGHT_BOUNDS).data, float)
        # False for NaN, too
        small = data.size == 6 and (np.abs(data) <= MAX_LENGTH_M).all()
        if not (small and (data[:3] < data[3:]).all()):
            raise SceneError(
                f"{name}: <numeric {FLIGHT_BOUNDS}> = {short_repr(data.tolist())}, expected "
                "xmin ymin "
                f"zmin xmax ymax zmax, rising, up to {MAX_LENGTH_M:g}"
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
"""Lengths are rounded to this before they are hashed. Rounding errors are smaller, differences that
matter are larger."""


def geometry_digest(solids: Solids) -> bytes:
    """Compute the SHA-256 of a world's filled space: a normal form of every solid, sorted.

    Worlds with the same solids have the same digest, whatever the order, names, bodies or colours,
    the sign of a quaternion, or which of a solid's equal placings was written (a box turned by 90°
    with its sizes exchanged). A world moved as a whole is another world."""
    rows = [np.zeros((0, 16))]
    for shape in np.unique(solids.shape):
        chosen = solids.shape == shape
        numbers = solids.size[chosen], solids.position[chosen], solids.rotation[chosen]
        form = _form(int(shape), *numbers)
        # negative zeros are zeros
        rounded = np.rint(form / ROUND_M) + 0.0
        rows.append(np.concatenate([np.full((len(form), 1), float(shape)), rounded], axis=1))
    table = np.concatenate(rows)
    # sorted by all columns, the first one first
    digest = hashlib.sha256(table[np.lexsort(table.T[::-1])].tobytes())
    meshes = np.split(solids.triangles, solids.mesh_start[1:-1])
    filled = solids.mesh_filled.tolist()
    for mesh in sorted(map(_mesh_digest, meshes, filled)):
        digest.update(mesh)
    return digest.digest()


def _form(shape: int, size: Floats, position: Floats, rotation: Floats) -> Floats:
    """Describe each solid of a shape by numbers that depend only on its filled points, (n, 15).

    These are position and moments, which do not change with the sign of a quaternion, or if a box
    is turned by 90° and its sizes are exchanged."""
    if shape == PLANE:
        normal = rotation[:, :, 2]
        # a plane's position may slide in it: only its distance from the origin counts
        offset = (normal * position).sum(axis=1, keepdims=True)
        return np.concatenate([normal, offset, np.zeros((len(size), 11))], axis=1)
    radii = size
    if shape == SPHERE:
        radii = size[:, [0, 0, 0]]
    elif shape in (CAPSULE, CYLINDER):
        radii = size[:, [0, 0, 1]]
    axes = rotation * radii[:, None, :]
    # the matrix R diag(r²) Rᵀ: second moments up to a factor
    second = np.einsum("nij,nkj->nik", axes, axes).reshape(-1, 9)
    # second moments are equal for a cube at any attitude, fourth ones are not; those of round
    # shapes would change with a spin about the axis
    fourth = (axes**4).sum(axis=2) ** 0.25 if shape == BOX else np.zeros((len(size), 3))
    return np.concatenate([position, second, fourth], axis=1)


def _mesh_digest(triangles: Floats, filled: bool) -> bytes:
    """Compute a digest of triangles (T, 3, 3) that does not depend on their order, or their
    corners'."""
    rounded = (np.rint(triangles / ROUND_M) + 0.0).astype(np.int64).view(np.uint64)
    # sums of mixed numbers do not depend on order, and wrap around without loss
    corners = _mixed(rounded[..., 0] + _mixed(rounded[..., 1] + _mixed(rounded[..., 2])))
    total = int(_mixed(corners.sum(axis=1)).sum())
    return hashlib.sha256(bytes([filled]) + len(triangles).to_bytes(8) + total.to_bytes(8)).digest()


def _mixed(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix each number to one that looks random (splitmix64: Steele, Lea and Flood 2014)."""
    z = numbers + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
