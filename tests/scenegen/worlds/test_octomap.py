"""OctoMap's files are read as they were written, and refused in a line where they are damaged."""

import struct

import numpy as np
import pytest

from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN
from scenegen.worlds.place import parse_octomap
from tests.refusals import refuses
from tests.scenegen import cases

HALF, HEADS = 1 << 15, cases("worlds/octomap")


LEAF = {FREE: struct.pack("<fB", -0.4, 0), OCCUPIED: struct.pack("<fB", 0.0, 0)}


def node(eight, suffix):
    """A node of eight children, each a state or a node's bytes; or a state that all have."""
    if eight[0] in LEAF and len(set(eight)) == 1:
        return eight[0]
    children = [3 if isinstance(child, bytes) else child for child in eight]
    if suffix == ".bt":
        head = struct.pack("<H", sum(child << 2 * n for n, child in enumerate(children)))
        return head + b"".join(child for child in eight if isinstance(child, bytes))
    head = struct.pack("<fB", 0.1, sum((child > 0) << n for n, child in enumerate(children)))
    return head + b"".join(LEAF.get(child, child) for child in eight if child != UNKNOWN)


def written(states, corner, suffix):
    """An OctoMap of `states`, whose least voxel is `corner` voxels from the world's origin."""
    cells = np.argwhere(states)
    keys = map(tuple, (cells + corner + HALF).tolist())
    level = dict(zip(keys, states[tuple(cells.T)].tolist(), strict=True))
    for _ in range(16):
        above = {}
        for (x, y, z), child in level.items():
            eight = above.setdefault((x // 2, y // 2, z // 2), [UNKNOWN] * 8)
            eight[x % 2 + 2 * (y % 2) + 4 * (z % 2)] = child
        level = {key: node(eight, suffix) for key, eight in above.items()}
    binary = " binary" if suffix == ".bt" else ""
    head = f"# Octomap OcTree{binary} file\n# made by a test\nid OcTree\nsize 9\nres 0.1\ndata\n"
    return head.encode() + level[0, 0, 0]


@pytest.mark.parametrize("suffix", [".bt", ".ot"])
@pytest.mark.parametrize("corner", [(-3, -9, 2), (31000, -32768, -5)])
def test_a_map_is_read_as_it_was_written(suffix, corner, rng):
    states = rng.choice([UNKNOWN, FREE, OCCUPIED], (13, 6, 9)).astype(np.uint8)
    states[:, :4] = FREE  # cubes of several voxels
    states[0, 0, 0], states[-1, -1, -1] = FREE, OCCUPIED
    voxels = parse_octomap(written(states, corner, suffix), f"map{suffix}")
    assert (voxels.states == states).all()
    assert voxels.voxel_m == 0.1
    assert voxels.origin == pytest.approx(np.array(corner) * 0.1)


BT, OT = (
    written(np.full((3, 2, 1), OCCUPIED, np.uint8), (0, 0, 0), suffix) for suffix in (".bt", ".ot")
)
DEEP = BT[: BT.index(b"\ndata\n") + 6]
DAMAGED = {f"{old} {new}": BT.replace(*map(str.encode, (old, new))) for old, new in HEADS} | {
    "empty": b"",
    "bt cut": BT[:-1],
    "ot cut": OT[:-1],
    "bt too long": BT + b"\0",
    "ot too long": OT + b"\0",
    "too deep": DEEP + b"\xff\xff" * 20,
    "nothing known": DEEP + b"\0\0",
    "two opposite eighths of everything": DEEP + b"\x02\x80",
    "NaN": OT[:-5] + struct.pack("<fB", np.nan, 0),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_map_is_refused(case):
    refuses(case, parse_octomap, DAMAGED[case], "map")
