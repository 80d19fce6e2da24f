"""A real place as a world: its map of voxels, archived as the file that it came in.

Flights go through its free space. Maps come as OctoMap's files (Hornung et al. 2013), trees of
occupied and free cubes: `.bt` with states only, `.ot` with log-odds; or as .npz."""

import functools
import hashlib
import math
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
from lidarsim.sensors.table import MAX_NPY_HEADER_BYTES
from scenegen.base.errors import SceneError, printable
from scenegen.base.limits import MAX_ASSET_BYTES, MAX_PLACE_VOXELS
from scenegen.base.reading import read_bounded, sha256_of
from scenegen.truth.voxels import resample
from scenegen.worlds.clearance import Clearance, widest
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
        name: Its name, for messages.

    Returns:
        The map.

    Raises:
        SceneError: If it is not an OctoMap, or damaged, empty or too large.
    """
    first, _, _ = content[:MAX_HEADER_BYTES].partition(b"\n")
    head, mark, tree = content.partition(b"\ndata\n")
    magics = {b"# Octomap OcTree binary file": True, b"# Octomap OcTree file": False}
    if first.strip() not in magics or not mark or len(head) > MAX_HEADER_BYTES:
        raise SceneError(f"{name}: not an OctoMap; expected a .bt or .ot file of OctoMap 1.x")
    # latin-1 decodes any byte, so damaged headers are refused for what they lack
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
        # `check_voxel` refuses it
        voxel_m = float("nan")
    check_voxel(voxel_m, name)
    data, is_binary = np.frombuffer(tree, np.uint8), magics[first.strip()]
    # inside out, so that the first cube becomes the box
    bounds = np.array([[2 * HALF] * 3, [0] * 3])
    nothing = np.empty((0, 0, 0), np.uint8)
    # twice: the size of the array is known only after a first pass
    fault = _fill(data, is_binary, bounds, nothing)
    if fault:
        raise SceneError(f"{name}: {FAULTS[fault]}")
    shape = bounds[1] - bounds[0]
    if not (shape > 0).all():
        raise SceneError(f"{name}: an empty map; nothing in it is known")
    if (count := int(shape.prod())) > MAX_PLACE_VOXELS:
        raise SceneError(
            f"{name}: {' × '.join(map(str, shape))} voxels, {count} in all, expected "
            f"{MAX_PLACE_VOXELS} at most; cut the map, or make it coarser"
        )
    states = np.zeros(shape, np.uint8)
    _fill(data, is_binary, bounds, states)
    # trees are centred on the world's origin
    return VoxelMap(states, voxel_m, (bounds[0] - HALF) * voxel_m)


def check_voxel(voxel_m: float, name: str) -> None:
    """Check a voxel's edge.

    Args:
        voxel_m: Metres.
        name: The file's name, for the message.

    Raises:
        SceneError: If it is not from 0.001 to 1000 m.
    """
    if not 1e-3 <= voxel_m <= 1e3:
        raise SceneError(f"{name}: a voxel of {voxel_m:g} m; expected from 0.001 to 1000 metres")


@kernel
def _mark(x, y, z, size, state, bounds, states):
    """Put a cube of `size` voxels into `states`; if these are empty, into `bounds` (2, 3)."""
    if states.size == 0:
        for axis, low in enumerate((x, y, z)):
            bounds[0, axis] = min(bounds[0, axis], low)
            bounds[1, axis] = max(bounds[1, axis], low + size)
    else:
        i, j, k = x - bounds[0, 0], y - bounds[0, 1], z - bounds[0, 2]
        states[i : i + size, j : j + size, k : k + size] = state


@kernel
def _fill(data, is_binary, bounds, states):
    """Read a tree, depth first, into `bounds` or `states`, see `_mark`.

    A node of a `.bt` file, if `is_binary`, is 16 bits, two for each child: 0 unknown, 1 free, 2
    occupied, 3 a node of its own. One of an `.ot` file is its log-odds in four bytes, and one byte
    of flags of its children; without any it is a leaf, occupied from log-odds of 0 on. Returns the
    number of a fault in `FAULTS`, 0 for none."""
    waiting, offset, length = [(0, 0, 0, 2 * HALF)], 0, 2 if is_binary else 5
    while len(waiting) > 0:
        x, y, z, size = waiting.pop()
        if offset + length > len(data):
            return 1
        bits = np.int64(data[offset]) | np.int64(data[offset + 1]) << 8
        if not is_binary:
            bits = np.int64(0)
            for child in range(8):
                # as in a .bt file: 3 for each child, a node of its own
                bits |= (np.int64(data[offset + 4]) >> child & 1) * 3 << 2 * child
            odds = data[offset : offset + 4].view(np.float32)[0]
            if bits == 0 and np.isnan(odds):
                return 4
            if bits == 0:
                _mark(x, y, z, size, OCCUPIED if odds >= 0.0 else FREE, bounds, states)
        offset += length
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
    return 0 if offset == len(data) else 3


DOCUMENT = (
    '<mujoco model="map">\n  <custom>\n    <text name="voxel_map" data="{}"/>\n  </custom>\n'
    "</mujoco>\n"
)
"""The MJCF of a map in an archive: an empty world that names the map's file."""
NAMED = re.compile(re.escape(DOCUMENT).replace(r"\{\}", r"([0-9a-f]{16}\.(?:bt|ot|npz))").encode())
TRIES = 1000
"""Points tried to find one where a flight may be."""
LOCAL = 1.5
"""Flights stay within their least length times this of that point: a map may be far larger."""
PARTS: dict[str, tuple[np.dtype[Any], int]] = {
    "states": (np.dtype("u1"), 3),
    "voxel_m": (np.dtype("<f8"), 0),
    "origin": (np.dtype("<f8"), 1),
}
"""The arrays of an .npz map: their types and dimensions."""


@dataclass(frozen=True, eq=False)
class Place:
    """A map of a real place, through whose free space a sensor flies. It has the interface of a
    `scenegen.worlds.world.World`."""

    name: str
    """Name of the map's file in an archive."""
    content: bytes
    """That file."""
    unseen: tuple[str, ...] = ()
    """Nothing: a map has no geoms."""
    albedo: None = None
    """Unknown: a map holds no reflectivities."""
    opened: bool = False
    """Whether unknown space counts as free, and not as solid."""

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
        """Choose a box in which to plan the next flight, about a random free point.

        Args:
            radius_m: Clearance of that point, metres.
            length_m: The flight's least length, metres.
            rng: Draws the point.

        Returns:
            Least and greatest corner, (2, 3), metres.
        """
        bounds, clearance = self.flight_bounds, self.clearance
        for point in rng.uniform(bounds[0], bounds[1], (TRIES, 3)):
            if clearance.at(*point) >= radius_m:
                reach = LOCAL * length_m
                return np.clip([point - reach, point + reach], *bounds)
        return bounds

    def caster(self, engine: object) -> VoxelEngine:
        """Return the `VoxelEngine` of the map, whatever `engine` other worlds use. A process caches
        two."""
        return _engine(self.content, self.name)

    def truth(self, grid: GridSpec, origin: Floats) -> dict[str, Mask]:
        """Compute the ground truth of a sample.

        Args:
            grid: The sample's grid.
            origin: (3,): its least corner in the world, metres.

        Returns:
            `occupancy`; and `known`, unless unknown space counts as free.
        """
        occupancy, known = resample(self.voxels, grid, origin)
        return {"occupancy": occupancy} | ({} if self.opened else {"known": known})

    def is_known(self, pose: Pose, lidar: Sensor, known: Known) -> bool:
        """Tell whether few enough rays cross unknown space for a scan to be kept.

        Args:
            pose: The sensor's.
            lidar: The sensor.
            known: The limits.

        Returns:
            Whether the scan may be kept.
        """
        rays = rotate(pose.quaternion, lidar.directions_body)[None]
        limits = known.most_unknown_m, known.most_marked_share
        return self.caster(None).mostly_known(pose.position[None], rays, lidar.max_range_m, *limits)

    def unknown_m(self, scan: Scan) -> Floats:
        """Compute metres of unknown space that each ray of a scan crosses before it returns,
        (*rays)."""
        start, rays, reach = scan.pose.position[None], scan.directions[None], scan.lidar.max_range_m
        return self.caster(None).cross(start, rays, reach)[1][0]


def read_place(path: str | Path) -> Place:
    """Read a map file.

    Args:
        path: OctoMap's `.bt` and `.ot`, or an `.npz` of `states`, `voxel_m` and `origin`, as in
            `VoxelMap`.

    Returns:
        The place.

    Raises:
        SceneError: If the file holds no map, or one without free space.
    """
    path = Path(path)
    return place_of(read_bounded(path, MAX_ASSET_BYTES), path.suffix, str(path))


def place_of(content: bytes, suffix: str, where: str) -> Place:
    """Make the place of a map file's content.

    Args:
        content: The file's bytes.
        suffix: Its type, with the dot.
        where: Its name, for messages.

    Returns:
        The place.

    Raises:
        SceneError: If the content is not a map, or one without free space.
    """
    # named by its content, so that archives hold a map once
    place = Place(f"{sha256_of(content)[:16]}{suffix}", content)
    try:
        bounds = place.flight_bounds
    except SceneError as error:
        # the parser names the archive's file, the user knows another
        raise SceneError(str(error).replace(place.name, where, 1)) from None
    if (bounds[0] == bounds[1]).all():
        raise SceneError(f"{where}: nothing in it is free, so that no sensor can be there")
    return place


def named_map(document: bytes) -> str:
    """Return the map file that an archived document names; "" for a world of solids."""
    match = NAMED.fullmatch(document)
    return match[1].decode() if match else ""


def archived_place(document: bytes, assets: Mapping[str, bytes], where: str) -> Place:
    """Read the place of an archived document for which `named_map` has a name.

    Args:
        document: The MJCF.
        assets: The files of the archive by name.
        where: The document's name, for messages.

    Returns:
        The place.

    Raises:
        SceneError: If the map's file is missing, or holds no map.
    """
    name = named_map(document)
    if name not in assets:
        raise SceneError(f"{where}: its map {name} is missing")
    # parsed now, so that a damaged file is refused here
    _engine(assets[name], name)
    return Place(name, assets[name])


def map_digest(voxels: VoxelMap) -> bytes:
    """Compute the SHA-256 of a map's content, independent of its file's format."""
    # of one byte order on every machine
    digest = hashlib.sha256(np.array([voxels.voxel_m, *voxels.origin], "<f8").tobytes())
    # cells in a row do not tell their shape
    digest.update(repr(voxels.states.shape).encode())
    digest.update(np.ascontiguousarray(voxels.states).data)
    return digest.digest()


@functools.lru_cache(maxsize=2)  # a large one takes 200 MB
def _engine(content: bytes, name: str) -> VoxelEngine:
    parse = parse_npz if name.endswith(".npz") else parse_octomap
    return VoxelEngine(parse(content, name))


def parse_npz(content: bytes, name: str) -> VoxelMap:
    """Parse an .npz map.

    Args:
        content: The file's bytes, with arrays `states` (uint8, 0 unknown, 1 free, 2 occupied),
            `voxel_m` and `origin`.
        name: Its name, for messages.

    Returns:
        The map.

    Raises:
        SceneError: If it is not such a file.
    """
    try:
        arrays = read_npz(content, *PARTS, max_bytes=MAX_PLACE_VOXELS + MAX_NPY_HEADER_BYTES)
    except Exception as error:  # errors of zipfile and zlib, and any that a crafted file may raise
        raise SceneError(
            f"{name}: not an .npz map ({printable(error)[:300]}); expected arrays "
            f"{', '.join(PARTS)}"
        ) from None
    for array, (part, (dtype, dimensions)) in zip(arrays, PARTS.items(), strict=True):
        if array.dtype != dtype or array.ndim != dimensions:
            raise SceneError(
                f"{name}: {part} is {array.dtype} {array.shape}, expected {dtype} of {dimensions} "
                "axes"
            )
    # a file may hold Fortran's order, for which numba would compile every kernel again
    states, voxel_m, origin = np.ascontiguousarray(arrays[0]), float(arrays[1]), arrays[2]
    check_voxel(voxel_m, name)
    if origin.shape != (3,) or not np.isfinite(origin).all() or states.max(initial=0) > OCCUPIED:
        raise SceneError(
            f"{name}: expected states of 0, 1 and 2, and an origin of three finite numbers"
        )
    return VoxelMap(states, voxel_m, origin)


def encode_map(voxels: VoxelMap, where: str, **extra: NDArray[Any]) -> bytes:
    """Encode a map as .npz: the same bytes for the same map.

    Args:
        voxels: The map.
        where: The file's name, for messages.
        extra: Further arrays by name.

    Returns:
        The file's bytes.

    Raises:
        SceneError: If they exceed the limit of a map's file.
    """
    arrays = dict(zip(PARTS, (voxels.states, voxels.voxel_m, voxels.origin), strict=True))
    content = encode_npz(arrays | extra, level=6)
    if len(content) > MAX_ASSET_BYTES:
        raise SceneError(
            f"{where}: its map takes {len(content)} bytes, expected {MAX_ASSET_BYTES} at most; "
            "give a larger --voxel"
        )
    return content


def box_of(cells: NDArray[Any], counts: Callable[[NDArray[Any]], Mask]) -> Ints:
    """Find the box around some cells, layer by layer: a map is too large for a copy.

    Args:
        cells: An array of any axes.
        counts: Marks the cells of a layer that count.

    Returns:
        (2, axes): the first such cell along each axis, and one more than the last; zeros if there
        is none.
    """
    rows, seen = np.zeros(len(cells), bool), np.zeros(cells.shape[1:], bool)
    for n, layer in enumerate(cells):
        marked = counts(layer)
        rows[n] = marked.any()
        seen |= marked
    box = np.zeros((2, cells.ndim), np.int64)
    for axis in range(cells.ndim) if rows.any() else ():
        # `seen` lacks the first axis
        across = tuple(n for n in range(seen.ndim) if n != axis - 1)
        line = seen.any(axis=across) if axis else rows
        box[:, axis] = np.flatnonzero(line)[[0, -1]] + [0, 1]
    return box


class PlaceClearance(Clearance):
    """Distances to the voxels that are not free, or only to the occupied ones if the map is
    `opened`."""

    def __init__(self, voxels: VoxelMap, opened: bool):
        self._arguments = voxels.states, voxels.voxel_m, voxels.origin, opened

    def width_m(self, start: Floats, length_m: float, cap_m: float) -> float:
        """Compute how wide the widest way from a point is.

        Args:
            start: The point (3,), in the map, metres.
            length_m: Its end lies this far from the point, metres.
            cap_m: Widths are capped at this, metres.

        Returns:
            The greatest clearance that a robot may keep on the way, metres; 0 if there is none.
        """
        states, voxel_m, origin, opened = self._arguments
        # the start limits the width, too
        cap_m = min(cap_m, self.at(*start))
        reach, margin = math.ceil(length_m / voxel_m), math.ceil(cap_m / voxel_m)
        begin = np.floor((start - origin) / voxel_m).astype(int)
        low = np.maximum(begin - reach - margin - 1, 0)
        # what a way and its clearances can reach: `widest` takes a byte for every voxel given
        cut = tuple(map(slice, low, begin + reach + margin + 2))
        part = np.ascontiguousarray(states[cut]), voxel_m, origin + low * voxel_m, opened
        return float(widest(tuple((begin - low).tolist()), reach, cap_m, part))
