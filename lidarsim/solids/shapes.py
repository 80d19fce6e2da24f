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


def bounding_boxes(
    shape: Ints, size: Floats, position: Floats, rotation: Floats
) -> tuple[Floats, Floats]:
    """Axis-aligned bounding boxes (n, 3), (n, 3) of primitives; see `Solids`."""
    reach = np.full(position.shape, np.inf)
    for kind in set(shape.tolist()):
        of = shape == kind
        x, y, z = np.moveaxis(rotation[of], 2, 0)
        a, b, c = size[of].T[..., None]
        if kind == SPHERE:
            reach[of] = a
        elif kind == CAPSULE:
            reach[of] = a + abs(z) * b
        elif kind == CYLINDER:
            reach[of] = a * np.sqrt(np.maximum(1.0 - z * z, 0.0)) + abs(z) * b
        elif kind == BOX:
            reach[of] = abs(x) * a + abs(y) * b + abs(z) * c
        elif kind == ELLIPSOID:
            reach[of] = np.sqrt((x * a) ** 2 + (y * b) ** 2 + (z * c) ** 2)
    return position - reach, position + reach
