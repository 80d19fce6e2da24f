"""Distances to triangles and crossings of vertical lines, against the plainest definitions."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from trimesh.triangles import closest_point

from scenegen.truth.triangles import crossing, side, triangle_distance

RNG = np.random.default_rng(0)
TRIANGLES = RNG.uniform(-1, 1, (40, 3, 3))

WEIGHTS = np.vstack([np.eye(3), [0.5, 0.5, 0], [0.2, 0.3, 0.5]])
"""Of corners, of a point on an edge, and of one within."""


def test_distances_are_those_of_the_nearest_point():
    for triangle in TRIANGLES:
        points = np.concatenate([RNG.uniform(-2, 2, (6, 3)), WEIGHTS @ triangle])
        nearest = closest_point([triangle] * len(points), points)
        distances = [triangle_distance(*triangle, *point) for point in points]
        assert_allclose(distances, np.linalg.norm(nearest - points, axis=1), atol=1e-12)


def test_lines_cross_where_barycentric_weights_are_positive():
    signs = []
    for a, b, c in TRIANGLES:
        for x, y in RNG.uniform(-1, 1, (20, 2)):
            weights = np.linalg.solve(
                [[a[0], b[0], c[0]], [a[1], b[1], c[1]], [1, 1, 1]], [x, y, 1]
            )
            sign, height = crossing(a, b, c, x, y)
            upward = np.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
            assert sign == (upward if (weights > 0).all() else 0)
            if sign:
                assert_allclose(height, weights @ [a[2], b[2], c[2]], atol=1e-9)
            signs.append(sign)
    assert {-1, 0, 1} == set(signs)


def test_sides_are_opposite_when_an_edge_is_walked_back():
    """Also for points right on it, along x, along y and at its ends."""
    ends = RNG.integers(-2, 3, (300, 2, 3)).astype(float)
    places = RNG.integers(-2, 3, (300, 2)).astype(float)
    there = [side(a, b, *place) for (a, b), place in zip(ends, places, strict=True)]
    back = [side(b, a, *place) for (a, b), place in zip(ends, places, strict=True)]
    assert_array_equal(there, np.negative(back))
    same = (ends[:, 0, :2] == ends[:, 1, :2]).all(axis=1)
    assert_array_equal(np.array(there) == 0, same)
