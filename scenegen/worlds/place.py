"""A real place as a world: its map of voxels, archived as the file that it came in, and flights
through what is free there.

Maps come as OctoMap's files (Hornung et al. 2013), trees of occupied and free cubes: `.bt` with
states alone, `.ot` with log-odds; or as .npz.
"""

import functools
import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose, Scan, Sensor
from lidarsim.engines.voxels import FREE, OCCUPIED, VoxelEngine, VoxelMap
from lidarsim.grid import Floats, Ints, Mask
from lidarsim.jit import kernel
from lidarsim.pose import rotate
from lidarsim.sensors.table import MOST_HEADER_BYTES
from scenegen.base.errors import SceneError, printable
from scenegen.base.files import read_bounded, sha256_of
from scenegen.base.limits import MOST_ASSET_BYTES, MOST_PLACE_VOXELS
from scenegen.truth.voxels import resample
from scenegen.worlds.clearance import Clearance
from scenegen.worlds.clouds.write import encode_npz, read_npz
from scenegen.worlds.mapping import Known

LEVELS = 16
"""Levels of a tree, as OctoMap has them."""
HALF = 1 << (LEVELS - 1)
"""Voxels from the tree's least corner to the world's origin, along each axis."""
MAX_HEADER_BYTES = 64 << 10
"""The most bytes of a header."""
FAULTS = {
    1: "ends within its tree; copy it again",
    2: f"has a tree of more than {LEVELS} levels; write it with OctoMap's own depth",
    3: "goes on behind its tree; copy it again",
    4: "has log-odds that are NaN; map the place again",
}


def parse_octomap(content: bytes, name: str) -> VoxelMap:
    """Parse a `.bt` or `.ot` file.

    Args:
        content: Its bytes.
        name: What errors name.

    Raises:
        SceneError: It is no OctoMap, damaged, empty or too large.
    """
    first, _, _ = content[:MAX_HEADER_BYTES].partition(b"\n")
    head, mark, tree = content.partition(b"\ndata\n")
    magics = {b"# Octomap OcTree binary file": True, b"# Octomap OcTree file": False}
    if first.strip() not in magics or not mark or len(head) > MAX_HEADER_BYTES:
        raise SceneError(f"{name}: not an OctoMap; expected a .bt or .ot file of OctoMap 1.x")
    lines = (line.split(None, 1) for line in head.decode("latin-1").splitlines())
    header = {words[0]: words[1].strip() for words in lines if len(words) == 2}
    if header.get("id") != "OcTree":
        raise SceneError(
            f"{name}: holds a tree of type {printable(header.get('id', 'none'))[:40]}, expected "
            "OcTree; convert it with OctoMap's convert_octree"
        )
    try:
        voxel_m = float(header.get("res", "nan"))
    except ValueError:
        voxel_m = float("nan")
    check_voxel(voxel_m, name)
    data, is_binary = np.frombuffer(tree, np.uint8), magics[first.strip()]
    bounds = np.array([[2 * HALF] * 3, [0] * 3])
    nothing = np.empty((0, 0, 0), np.uint8)
    fault = _fill(data, is_binary, bounds, nothing)
    if fault:
        raise SceneError(f"{name}: {FAULTS[fault]}")
    shape = bounds[1] - bounds[0]
    if not (shape > 0).all():
        raise SceneError(f"{name}: an empty map; nothing in it is known")
    if (count := int(shape.prod())) > MOST_PLACE_VOXELS:
        raise SceneError(
            f"{name}: {' × '.join(map(str, shape))} voxels, {count} in all, expected "
            f"{MOST_PLACE_VOXELS} at most; cut the map, or make it coarser"
        )
    states = np.zeros(shape, np.uint8)
    _fill(data, is_binary, bounds, states)
    return VoxelMap(states, voxel_m, (bounds[0] - HALF) * voxel_m)


def check_voxel(voxel_m: float, name: str) -> None:
    """Raise SceneError, naming `name`, for what cannot be a voxel's edge."""
    if not 1e-3 <= voxel_m <= 1e3:
        raise SceneError(f"{name}: a voxel of {voxel_m:g} m; expected from 0.001 to 1000 metres")


@kernel
def _mark(x, y, z, size, state, bounds, states):
    """Put a cube of `size` voxels into `states`; where these are empty, into `bounds` (2, 3)."""
    if states.size == 0:
        for axis, low in enumerate((x, y, z)):
            bounds[0, axis] = min(bounds[0, axis], low)
            bounds[1, axis] = max(bounds[1, axis], low + size)
    else:
        i, j, k = x - bounds[0, 0], y - bounds[0, 1], z - bounds[0, 2]
        states[i : i + size, j : j + size, k : k + size] = state


@kernel
def _fill(data, is_binary, bounds, states):
    """Read a tree, depth first, into `bounds` or `states`, see `_mark`. The number of a fault, 0
    for none.

    A node of a `.bt` file, if `is_binary`, is 16 bits, two for each child: 0 unknown, 1 free, 2
    occupied, 3 a node of its own. One of an `.ot` file is its log-odds in four bytes, and one byte
    that says which children it has; without any it is a leaf, occupied from log-odds of 0 on.
    """
    waiting, at, length = [(0, 0, 0, 2 * HALF)], 0, 2 if is_binary else 5
    while len(waiting) > 0:
        x, y, z, size = waiting.pop()
        if at + length > len(data):
            return 1
        bits = np.int64(data[at]) | np.int64(data[at + 1]) << 8
        if not is_binary:
            bits = np.int64(0)
            for child in range(8):
                bits |= (np.int64(data[at + 4]) >> child & 1) * 3 << 2 * child
            odds = data[at : at + 4].view(np.float32)[0]
            if bits == 0 and np.isnan(odds):
                return 4
            if bits == 0:
                _mark(x, y, z, size, OCCUPIED if odds >= 0.0 else FREE, bounds, states)
        at += length
        half = size // 2
        if half == 0 and (is_binary or bits > 0):
            return 2
        for turn in range(8):
            child = 7 - turn  # the first one is taken from the stack first
            state = bits >> 2 * child & 3
            i, j, k = x + half * (child & 1), y + half * (child >> 1 & 1), z + half * (child >> 2)
            if state == 3:
                waiting.append((i, j, k, half))
            elif state > 0:
                _mark(i, j, k, half, state, bounds, states)
    return 0 if at == len(data) else 3


DOCUMENT = (
    '<mujoco model="map">\n  <custom>\n    <text name="voxel_map" data="{}"/>\n  </custom>\n'
    "</mujoco>\n"
)
"""The MJCF of a map in an archive: an empty world that names the map's file."""
NAMED = re.compile(re.escape(DOCUMENT).replace(r"\{\}", r"([0-9a-f]{16}\.(?:bt|ot|npz))").encode())
TRIES = 1000
"""Points tried to find one where a flight may be."""
LOCAL = 1.5
"""Flights keep within so many times their least length of that point: a map may be far larger."""
PARTS: dict[str, tuple[np.dtype[Any], int]] = {
    "states": (np.dtype("u1"), 3),
    "voxel_m": (np.dtype("<f8"), 0),
    "origin": (np.dtype("<f8"), 1),
}
"""The arrays of an .npz map: their types and dimensions."""


@dataclass(frozen=True, eq=False)
class Place:
    """A map of a real place, for a sensor to fly through what is free in it. It stands where a
    `scenegen.worlds.world.World` does."""

    name: str
    """What the map's file is called in an archive."""
    content: bytes
    """That file."""
    unseen: tuple[str, ...] = ()
    """Nothing: a map has no geoms."""
    albedo: None = None
    """A map does not know what reflects how much."""
    opened: bool = False
    """Whether what is unknown counts as free, and not as solid."""

    @property
    def mjcf(self) -> bytes:
        """A document that names the map's file, for archives."""
        return DOCUMENT.format(self.name).encode()

    @property
    def assets(self) -> dict[str, bytes]:
        """The map's file by its name."""
        return {self.name: self.content}

    @property
    def voxels(self) -> VoxelMap:
        """The map itself."""
        return self.caster(None).voxels

    @cached_property
    def flight_bounds(self) -> Floats:
        """(2, 3): least and greatest corner of the box around the free voxels, metres."""
        voxels = self.voxels
        box = box_of(voxels.states, lambda layer: layer == FREE)
        return np.asarray(voxels.origin + box * voxels.voxel_m)

    @property
    def clearance(self) -> "PlaceClearance":
        """The collision check."""
        return PlaceClearance(self.voxels, self.opened)

    def room(self, radius_m: float, length_m: float, *, rng: np.random.Generator) -> Floats:
        """Where to plan the next flight, (2, 3) metres: about a random free point, as far as a
        flight of `length_m` may need."""
        bounds, clearance = self.flight_bounds, self.clearance
        for point in rng.uniform(bounds[0], bounds[1], (TRIES, 3)):
            if clearance.at(*point) >= radius_m:
                reach = LOCAL * length_m
                return np.clip([point - reach, point + reach], *bounds)
        return bounds

    def caster(self, engine: object) -> VoxelEngine:
        """What casts rays: a `VoxelEngine`, whatever `engine` others are cast by. A process keeps
        the last two."""
        return _engine(self.content, self.name)

    def truth(self, grid: GridSpec, origin: Floats) -> dict[str, Mask]:
        """The fields of a sample that say what is there: `occupancy`, and `known` where what is
        unknown does not count as free."""
        occupancy, known = resample(self.voxels, grid, origin)
        return {"occupancy": occupancy} | ({} if self.opened else {"known": known})

    def is_known(self, pose: Pose, lidar: Sensor, known: Known) -> bool:
        """Whether so few rays of a sensor cross unknown space that a scan of it may be kept."""
        rays = rotate(pose.quaternion, lidar.directions_body)[None]
        limits = known.most_unknown_m, known.most_marked_share
        return self.caster(None).mostly_known(pose.position[None], rays, lidar.max_range_m, *limits)

    def unknown_m(self, scan: Scan) -> Floats:
        """Metres of unknown space that each ray of a scan crosses before it returns, (*rays)."""
        start, rays, reach = scan.pose.position[None], scan.directions[None], scan.lidar.max_range_m
        return self.caster(None).cross(start, rays, reach)[1][0]


def read_place(path: str | Path) -> Place:
    """The place of a map file: OctoMap's `.bt` and `.ot`, or an `.npz` of `states`, `voxel_m` and
    `origin`, as in `VoxelMap`. Raises SceneError for a file that holds no map, or nothing free."""
    path = Path(path)
    return place_of(read_bounded(path, MOST_ASSET_BYTES), path.suffix, str(path))


def place_of(content: bytes, suffix: str, where: str) -> Place:
    """The place of a map file's content. Raises as `read_place`, naming `where`."""
    place = Place(f"{sha256_of(content)[:16]}{suffix}", content)
    try:
        bounds = place.flight_bounds
    except SceneError as error:
        raise SceneError(str(error).replace(place.name, where, 1)) from None
    if (bounds[0] == bounds[1]).all():
        raise SceneError(f"{where}: nothing in it is free, so that no sensor can be there")
    return place


def named_map(document: bytes) -> str:
    """The file that a document of an archive names as its map; "" for a world of solids."""
    match = NAMED.fullmatch(document)
    return match[1].decode() if match else ""


def archived_place(document: bytes, assets: Mapping[str, bytes], where: str) -> Place:
    """Read the place of an archived document for which `named_map` has a name.

    Args:
        document: The MJCF.
        assets: The files of the archive by name.
        where: What the error names.

    Raises:
        SceneError: The map's file is missing, or holds no map.
    """
    name = named_map(document)
    if name not in assets:
        raise SceneError(f"{where}: its map {name} is missing")
    _engine(assets[name], name)
    return Place(name, assets[name])


def map_digest(voxels: VoxelMap) -> bytes:
    """SHA-256 of what a map says, whatever file it came in."""
    digest = hashlib.sha256(np.array([voxels.voxel_m, *voxels.origin], "<f8").tobytes())
    digest.update(repr(voxels.states.shape).encode())
    digest.update(np.ascontiguousarray(voxels.states).data)
    return digest.digest()


@functools.lru_cache(maxsize=2)  # a large one takes 200 MB
def _engine(content: bytes, name: str) -> VoxelEngine:
    parse = parse_npz if name.endswith(".npz") else parse_octomap
    return VoxelEngine(parse(content, name))


def parse_npz(content: bytes, name: str) -> VoxelMap:
    """The map in an .npz file's arrays `states` (uint8, 0 unknown, 1 free, 2 occupied), `voxel_m`
    and `origin`. Raises SceneError, naming `name`."""
    try:
        arrays = read_npz(content, *PARTS, max_bytes=MOST_PLACE_VOXELS + MOST_HEADER_BYTES)
    except Exception as error:  # zipfile's, zlib's, and what else a crafted file may bring forth
        raise SceneError(
            f"{name}: not an .npz map ({printable(error)[:100]}); expected arrays "
            f"{', '.join(PARTS)}"
        ) from None
    for array, (part, (dtype, dimensions)) in zip(arrays, PARTS.items(), strict=True):
        if array.dtype != dtype or array.ndim != dimensions:
            raise SceneError(
                f"{name}: {part} is {array.dtype} {array.shape}, expected {dtype} of {dimensions} "
                "axes"
            )
    states, voxel_m, origin = np.ascontiguousarray(arrays[0]), float(arrays[1]), arrays[2]
    check_voxel(voxel_m, name)
    if origin.shape != (3,) or not np.isfinite(origin).all() or states.max(initial=0) > OCCUPIED:
        raise SceneError(
            f"{name}: expected states of 0, 1 and 2, and an origin of three finite numbers"
        )
    return VoxelMap(states, voxel_m, origin)


def encode_map(voxels: VoxelMap, where: str, **more: NDArray[Any]) -> bytes:
    """Encode a map as .npz: the same bytes for the same map.

    Args:
        voxels: The map.
        where: What the error names, a file.
        more: Further arrays by name.

    Raises:
        SceneError: It takes more than a map's file may hold.
    """
    arrays = dict(zip(PARTS, (voxels.states, voxels.voxel_m, voxels.origin), strict=True))
    content = encode_npz(arrays | more, level=6)
    if len(content) > MOST_ASSET_BYTES:
        raise SceneError(
            f"{where}: its map takes {len(content)} bytes, expected {MOST_ASSET_BYTES} at most; "
            "give a larger --voxel"
        )
    return content


def box_of(cells: NDArray[Any], wanted: Callable[[NDArray[Any]], Mask]) -> Ints:
    """Find the box around some cells, layer by layer: a map is too large for a copy.

    Args:
        cells: An array of any axes.
        wanted: Tells which cells of a layer count.

    Returns:
        (2, axes): the first such cell along each axis, and one more than the last; zeros if there
        is none.
    """
    rows, seen = np.zeros(len(cells), bool), np.zeros(cells.shape[1:], bool)
    for n, layer in enumerate(cells):
        here = wanted(layer)
        rows[n] = here.any()
        seen |= here
    box = np.zeros((2, cells.ndim), np.int64)
    for axis in range(cells.ndim) if rows.any() else ():
        others = tuple(other for other in range(seen.ndim) if other != axis - 1)
        line = seen.any(axis=others) if axis else rows
        box[:, axis] = np.flatnonzero(line)[[0, -1]] + [0, 1]
    return box


class PlaceClearance(Clearance):
    """Distances to the voxels that are not free, or to the occupied ones alone where the map is
    `opened`."""

    def __init__(self, voxels: VoxelMap, opened: bool):
        self._arguments = voxels.states, voxels.voxel_m, voxels.origin, opened
