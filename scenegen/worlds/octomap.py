"""OctoMap's files (Hornung et al. 2013): trees of occupied and free cubes, `.bt` with states alone,
`.ot` with log-odds."""

import numpy as np

from lidarsim.engines.voxels import FREE, OCCUPIED, VoxelMap
from lidarsim.jit import kernel
from scenegen.errors import SceneError, printable
from scenegen.limits import MOST_PLACE_VOXELS

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
