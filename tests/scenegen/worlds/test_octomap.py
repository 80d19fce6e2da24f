"""OctoMap's files are read as they were written, and refused in a line where they are damaged."""

import struct
from contextlib import suppress

import numpy as np
import pytest

from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN
from scenegen.errors import SceneError
from scenegen.worlds.octomap import parse_octomap

HALF = 1 << 15


def written(states, corner, suffix):
    """An OctoMap of `states`, whose least voxel is `corner` voxels from the world's origin."""
    place = np.array(corner) + HALF

    def block(low, size):
        begin, end = np.maximum(low - place, 0), np.minimum(low - place + size, states.shape)
        if not (end > begin).all():
            return np.zeros(0, np.uint8)
        return states[tuple(slice(a, b) for a, b in zip(begin, end, strict=True))]

    def kind(low, size):
        """A state, or 3 for what has several."""
        part = block(low, size)
        if not part.any():
            return UNKNOWN
        return int(part.flat[0]) if part.size == size**3 and (part == part.flat[0]).all() else 3

    def node(low, size):
        steps = [low + size // 2 * np.array([c & 1, c >> 1 & 1, c >> 2]) for c in range(8)]
        kinds = [kind(step, size // 2) for step in steps]
        if suffix == ".bt":
            head = struct.pack("<H", sum(k << 2 * c for c, k in enumerate(kinds)))
            return head + b"".join(
                node(s, size // 2) for s, k in zip(steps, kinds, strict=True) if k == 3
            )
        head = struct.pack("<fB", 0.1, sum((k > 0) << c for c, k in enumerate(kinds)))
        leaf = {FREE: struct.pack("<fB", -0.4, 0), OCCUPIED: struct.pack("<fB", 0.0, 0)}
        return head + b"".join(
            node(s, size // 2) if k == 3 else leaf[k]
            for s, k in zip(steps, kinds, strict=True)
            if k
        )

    binary = " binary" if suffix == ".bt" else ""
    head = f"# Octomap OcTree{binary} file\n# made by a test\nid OcTree\nsize 9\nres 0.1\ndata\n"
    return head.encode() + node(np.zeros(3, int), 2 * HALF)


@pytest.mark.parametrize("suffix", [".bt", ".ot"])
@pytest.mark.parametrize("corner", [(-3, -9, 2), (31000, -32768, -5)])
def test_a_map_is_read_as_it_was_written(suffix, corner):
    rng = np.random.default_rng(0)
    states = rng.choice([UNKNOWN, FREE, OCCUPIED], (13, 6, 9)).astype(np.uint8)
    states[:, :4] = FREE  # cubes of several voxels
    states[0, 0, 0], states[-1, -1, -1] = FREE, OCCUPIED
    found = parse_octomap(written(states, corner, suffix), f"map{suffix}")
    assert (found.states == states).all()
    assert found.voxel_m == 0.1
    assert found.origin == pytest.approx(np.array(corner) * 0.1)


BT, OT = (
    written(np.full((3, 2, 1), OCCUPIED, np.uint8), (0, 0, 0), suffix) for suffix in (".bt", ".ot")
)
DEEP = BT[: BT.index(b"\ndata\n") + 6]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not an OctoMap"),
        (BT.replace(b"\ndata\n", b"\n"), "not an OctoMap"),
        (BT.replace(b"id OcTree", b"id ColorOcTree"), "ColorOcTree"),
        (BT.replace(b"res 0.1", b"res -1"), "a voxel of"),
        (BT.replace(b"res 0.1", b"res nan"), "a voxel of"),
        (BT.replace(b"res 0.1", b"res"), "a voxel of"),
        (BT[:-1], "ends within its tree"),
        (OT[:-1], "ends within its tree"),
        (BT + b"\0", "goes on behind"),
        (OT + b"\0", "goes on behind"),
        (DEEP + b"\xff\xff" * 20, "more than 16 levels"),
        (DEEP + b"\0\0", "empty map"),
        (DEEP + b"\x02\x80", "at most"),  # two opposite eighths of everything
        (OT[:-5] + struct.pack("<fB", np.nan, 0), "NaN"),
    ],
)
def test_a_damaged_map_ends_in_a_line(content, said):
    with pytest.raises(SceneError, match=said):
        parse_octomap(content, "map")


def test_any_damage_ends_in_a_line_or_in_a_map():
    rng = np.random.default_rng(0)
    for suffix, whole in ((".bt", BT), (".ot", OT)):
        begin = whole.index(b"\ndata\n") + 6
        for _ in range(200):
            damaged = bytearray(whole)
            damaged[rng.integers(begin, len(whole))] = rng.integers(256)
            with suppress(SceneError):
                assert parse_octomap(bytes(damaged), suffix).states.any()
