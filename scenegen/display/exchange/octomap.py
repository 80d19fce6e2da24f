"""OctoMap's binary trees (.bt): what the sensor knows, observed cells as occupied and free ones, in
the world's frame.

The format is that of `OcTree::writeBinary` (github.com/OctoMap/octomap): a text header, then the
inner nodes depth first, two bits a child: 0 unknown, 1 free, 2 occupied, 3 an inner node. Cells are
multiples of the voxel from the world's origin, so the map moves by up to half a voxel along each
axis.
"""

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Sensor
from scenegen.display.exchange.choices import Choices
from scenegen.errors import DatasetError
from scenegen.sample import Sample

DEPTH = 16
"""Levels of a tree."""
MIDDLE = 1 << (DEPTH - 1)
"""The key, along each axis, of the cell that begins at the world's origin."""
FREE, OCCUPIED, INNER = 1, 2, 3


class OctoMap:
    """One tree a sample, ``train/000007.bt``."""

    def __init__(self, choices: Choices):
        pass

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """The file of a sample."""
        return (f"{split}/{number:06d}.bt",)

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> tuple[bytes, ...]:
        """Its content. Raises DatasetError where the map lies outside what a tree can hold."""
        known = np.argwhere(sample.observed | sample.free)
        keys = known + np.rint(sample.origin / grid.voxel_m).astype(np.int64) + MIDDLE
        if len(keys) and not (keys.min() >= 0 and keys.max() < 2 * MIDDLE):
            raise DatasetError(
                f"origin {sample.origin.tolist()}: beyond an OctoMap of {grid.voxel_m} m cells"
            )
        state = np.where(sample.observed[tuple(known.T)], OCCUPIED, FREE)
        nodes, tree = _tree(keys, state)
        head = f"# Octomap OcTree binary file\nid OcTree\nsize {nodes}\nres {grid.voxel_m:.17g}\ndata\n"
        return (head.encode() + tree,)


def _tree(keys: NDArray[np.int64], state: NDArray[np.int64]) -> tuple[int, bytes]:
    """The number of nodes, and the inner ones as bytes, of a tree with leaves at `keys` (n, 3),
    each with its state."""
    if not len(keys):
        return 0, b""
    codes = np.zeros(len(keys), np.int64)
    for bit in range(DEPTH):
        for axis in range(3):
            codes |= ((keys[:, axis] >> bit) & 1) << (3 * bit + axis)
    nodes, begins, depths, words = len(codes), [], [], []
    for depth in reversed(range(DEPTH)):
        parents, which = np.unique(codes >> 3, return_inverse=True)
        word = np.zeros(len(parents), np.uint16)
        np.bitwise_or.at(word, which, (state << (2 * (codes & 7))).astype(np.uint16))
        begins.append(parents << (3 * (DEPTH - depth)))  # the first leaf that may lie below
        depths.append(np.full(len(parents), depth))
        words.append(word)
        codes, state = parents, np.full(len(parents), INNER)
        nodes += len(parents)
    order = np.lexsort((np.concatenate(depths), np.concatenate(begins)))
    return nodes, np.concatenate(words)[order].astype("<u2").tobytes()
