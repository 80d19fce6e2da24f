"""Shapes as data: what stands in a world, with no opinion on how rays or voxels meet it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarsim.grid import Floats, Ints, Mask
from lidarsim.jit import kernel

PLANE, HFIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = range(8)
"""The codes of MuJoCo's `mjtGeom`."""


@dataclass(frozen=True, eq=False)
class Solids:
    """Every geom of a model that rays can see, filled: n primitives and m meshes of T triangles in
    all.

    Height fields are meshes too: their surface closed by walls and a base.
    """

    shape: Ints
    """(n,) codes, as above."""
    size: Floats
    """(n, 3) MuJoCo's sizes, metres."""
    position: Floats
    """(n, 3) centres, metres."""
    rotation: Floats
    """(n, 3, 3): takes the shape's coordinates to the world's."""
    lower: Floats
    """(n, 3) least corners of the bounding boxes; -inf for planes."""
    upper: Floats
    """(n, 3) greatest corners; +inf for planes."""
    triangles: Floats
    """(T, 3, 3): triangle, corner, coordinate."""
    mesh_start: Ints
    """(m + 1,): mesh q owns triangles mesh_start[q] to mesh_start[q + 1]."""
    mesh_filled: Mask
    """(m,): closed, so its inside is solid; otherwise it is a surface."""
    geom: Ints
    """(n + m,): the numbers of primitives and meshes among the model's geoms."""

    @cached_property
    def boxes(self) -> tuple[Floats, Floats]:
        """Bounding boxes of all n + m solids: least corners (n + m, 3) and greatest corners (n + m,
        3)."""
        first = self.mesh_start[:-1]
        lower = np.minimum.reduceat(self.triangles.min(axis=1), first)
        upper = np.maximum.reduceat(self.triangles.max(axis=1), first)
        return np.concatenate([self.lower, lower]), np.concatenate([self.upper, upper])

    def __len__(self) -> int:
        return len(self.shape) + len(self.mesh_filled)


@kernel
def joining(one, other):
    """The vector from one point to another."""
    return other[0] - one[0], other[1] - one[1], other[2] - one[2]


@kernel
def local(axes, x, y, z):
    """A vector of the world's in the frame of a shape whose rotation is `axes` (3, 3)."""
    return (
        axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z,
        axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z,
        axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z,
    )


@kernel
def bounding_boxes(shape, size, position, rotation):
    """Axis-aligned bounding boxes (n, 3), (n, 3)."""
    lower, upper = np.empty_like(position), np.empty_like(position)
    for n in range(len(shape)):
        for a in range(3):
            u, v, w = rotation[n, a]
            reach = np.inf
            if shape[n] == SPHERE:
                reach = size[n, 0]
            elif shape[n] == CAPSULE:
                reach = size[n, 0] + abs(w) * size[n, 1]
            elif shape[n] == CYLINDER:
                reach = size[n, 0] * np.sqrt(max(1.0 - w * w, 0.0)) + abs(w) * size[n, 1]
            elif shape[n] == BOX:
                reach = abs(u) * size[n, 0] + abs(v) * size[n, 1] + abs(w) * size[n, 2]
            elif shape[n] == ELLIPSOID:
                reach = np.sqrt(
                    (u * size[n, 0]) ** 2 + (v * size[n, 1]) ** 2 + (w * size[n, 2]) ** 2
                )
            lower[n, a], upper[n, a] = position[n, a] - reach, position[n, a] + reach
    return lower, upper
