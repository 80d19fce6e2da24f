"""What a world is, whatever it is called: a digest of its solids that no renaming, reordering or
nesting changes."""

import hashlib

import numpy as np
from numpy.typing import NDArray

from lidarsim.solids.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE, Solids

ROUND_M = 1e-5
"""Lengths are rounded to this before they are hashed: more than arithmetic can move them, less than
matters."""


def geometry_digest(solids: Solids) -> bytes:
    """SHA-256 of what fills space: every solid in a form of its own, sorted.

    Two worlds with the same solids have the same digest, whatever the order, names, bodies or
    colours, the sign of a quaternion, or which of a solid's equal placings was written (a box
    turned by 90° with its sizes exchanged). A world moved as a whole is another world.
    """
    rows = [np.zeros((0, 13))]
    for shape in np.unique(solids.shape):
        chosen = solids.shape == shape
        size, position, rotation = (
            solids.size[chosen],
            solids.position[chosen],
            solids.rotation[chosen],
        )
        form = _form(int(shape), size, position, rotation)
        # negative zeros are zeros
        rounded = np.rint(form / ROUND_M) + 0.0
        rows.append(np.concatenate([np.full((len(form), 1), float(shape)), rounded], axis=1))
    table = np.concatenate(rows)
    digest = hashlib.sha256(table[np.lexsort(table.T[::-1])].tobytes())
    for mesh in sorted(
        _mesh_digest(solids.triangles[first:last], bool(filled))
        for first, last, filled in zip(
            solids.mesh_start, solids.mesh_start[1:], solids.mesh_filled, strict=False
        )
    ):
        digest.update(mesh)
    return digest.digest()


def _form(
    shape: int,
    size: NDArray[np.float64],
    position: NDArray[np.float64],
    rotation: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Twelve numbers a solid that depend on the points it fills alone, (n, 12)."""
    form = np.zeros((len(size), 12))
    form[:, :3] = position
    axis = rotation[:, :, 2]
    if shape == PLANE:
        form[:, :3] = axis
        form[:, 3] = (axis * position).sum(axis=1)
    elif shape == SPHERE:
        form[:, 3] = size[:, 0]
    elif shape in (CAPSULE, CYLINDER):
        form[:, 3] = size[:, 0]
        form[:, 4:7] = _unsigned(axis * size[:, 1:2])
    elif shape == BOX:
        # a box is its three half edges, in any order and of either sign
        edges = _unsigned((rotation * size[:, None, :]).transpose(0, 2, 1))
        form[:, 3:] = _ordered(edges).reshape(-1, 9)
    elif shape == ELLIPSOID:
        form[:, 3:] = np.einsum("nij,nj,nkj->nik", rotation, size**2, rotation).reshape(-1, 9)
    return form


def _unsigned(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """`vectors` (..., 3), each or its opposite: that whose first component other than 0, rounded,
    is positive."""
    rounded = np.rint(vectors / ROUND_M)
    first = np.take_along_axis(rounded, np.argmax(rounded != 0, axis=-1)[..., None], axis=-1)
    return np.where(first < 0, -vectors, vectors)


def _ordered(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each three of `vectors` (n, 3, 3) in an order that depends on them alone: by a sum that tells
    rounded vectors apart."""
    rounded = np.rint(vectors / ROUND_M)
    key = rounded[..., 0] + np.sqrt(2.0) * rounded[..., 1] + np.sqrt(3.0) * rounded[..., 2]
    return np.take_along_axis(vectors, np.argsort(key, axis=1)[:, :, None], axis=1)


def _mesh_digest(triangles: NDArray[np.float64], filled: bool) -> bytes:
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
