"""Distances and motion checks against closed forms for primitives, and against triangles and
winding numbers."""

import functools

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from lidarsim.solids import solids_of
from scenegen.worlds.clearance import CAP_M, Clearance
from tests.scenegen.truth import reference
from tests.scenegen.truth.reference import Shape

BOUNDS = np.array([[-3.0, -5.0, 0.0], [6.0, 2.5, 4.0]])
"""Not a whole number of cells along either side, and not at the origin."""
ROUNDING_M = 1e-5
"""MuJoCo's meshes hold float32 numbers."""
SLACK_M = 4e-3
"""What a motion check may be off by: twice its shortest step, and half of one along the samples."""


def among(*shapes):
    """The clearance in a world of shapes."""
    return Clearance(solids_of(reference.world_of(*shapes)), BOUNDS)


def to_ellipsoid(shape, points):
    """Distances of points (n, 3): the nearest point is where the normal leads there, which the
    right Lagrange multiplier tells, by bisection."""
    at, squares = np.abs((points - shape.pos) @ shape.rot), np.square(shape.size)
    low, high = np.zeros((2, len(points), 1))
    high[:, 0] = np.linalg.norm(at * shape.size, axis=1)
    for _ in range(40):
        middle = (low + high) / 2
        is_short = ((at / (squares + middle)) ** 2 * squares).sum(axis=1, keepdims=True) > 1
        low, high = np.where(is_short, middle, low), np.where(is_short, high, middle)
    return np.linalg.norm(at - at * squares / (squares + low), axis=1)


def to_primitives(shapes, points):
    """Distance from each point (n, 3) to the nearest of the shapes; 0 within one."""
    distances = [
        to_ellipsoid(shape, points)
        if shape.kind == "ellipsoid"
        else np.maximum(reference.at_least(shape, points), 0)
        for shape in shapes
    ]
    return np.min(distances, axis=0)


def check_distances(clearance, points, distances):
    """The clearance at points, (n,), which is as expected."""
    expected = np.minimum(distances, CAP_M)
    actual = np.array([clearance.at(*point) for point in points])
    assert_allclose(actual, expected, rtol=0, atol=ROUNDING_M)
    assert (actual[expected == 0] == 0).all()
    return expected


def check_motions(clearance, distances, rng, *, count, longest_m):
    """A motion is free where all its points are farther than the radius, and is not where one of
    them is nearer. A fifth of them are along an axis."""
    verdicts = []
    for n in range(count):
        p = rng.uniform(*BOUNDS)
        along = np.eye(3)[rng.integers(3)] if n % 5 == 0 else reference.unit(rng)
        q = np.clip(p + rng.uniform(0.0, longest_m) * along, *BOUNDS)
        steps = int(np.linalg.norm(q - p) / SLACK_M) + 2
        nearest = distances(np.linspace(p, q, steps)).min()
        # close to the verdict's edge as often as anywhere
        radius = rng.choice([nearest + rng.normal(0, 0.01), rng.uniform(0.05, 0.6)])
        radius = float(np.clip(radius, 0.05, 0.9))
        free = clearance.motion_is_free(tuple(p), tuple(q), radius)
        if abs(nearest - radius) > SLACK_M:
            assert free == (nearest > radius), (p, q, radius, nearest)
            verdicts.append(free)
    assert min(verdicts.count(True), verdicts.count(False)) > count / 8


@pytest.mark.parametrize("seed", [0, 1])
def test_clearance_keeps_the_distances_of_primitives(seed):
    """Of every kind at any attitude, within the bounds and around them."""
    rng = np.random.default_rng(seed)
    shapes = [Shape("plane", (0, 0, 1), np.array([0, 0, 0.2]), np.array([1, 0.1, 0.1, 0]))]
    for kind in [kind for kind in reference.KINDS if kind != "plane"] * 6:
        place = rng.uniform(BOUNDS[0] - 1.2, BOUNDS[1] + 1.2)
        shapes.append(Shape(kind, tuple(rng.uniform(0.1, 0.9, 3)), place, rng.normal(size=4)))
    clearance, distances = among(*shapes), functools.partial(to_primitives, shapes)
    points = rng.uniform(*BOUNDS, (250, 3))
    expected = check_distances(clearance, points, distances(points))
    between = (expected > 0) & (expected < CAP_M)
    assert min((expected == 0).sum(), (expected == CAP_M).sum(), between.sum()) > 5
    check_motions(clearance, distances, rng, count=40, longest_m=4.0)
    for p in points[:100]:  # motions of no length
        assert clearance.motion_is_free(tuple(p), tuple(p), 0.3) == (clearance.at(*p) >= 0.3)


def torus(share=1.0):
    """A ring; with a share below 1, its first faces alone, which enclose nothing."""
    ring = trimesh.creation.torus(1.1, 0.5, major_sections=10, minor_sections=6)
    faces = ring.faces[: round(share * len(ring.faces))]
    # each edge of a triangle lies at the rim of some
    return trimesh.Trimesh(ring.vertices, [np.roll(face, n) for n, face in enumerate(faces)])


ELEVATION = (np.random.default_rng(7).permutation(30).reshape(5, 6) / 29).astype("f4").astype(float)
"""From 0 to 1, both reached, or else MuJoCo would stretch it."""
HILL = (1.2, 1.8, 1.5, 0.4)
PRISMS = reference.hfield_prisms(ELEVATION * HILL[2], HILL, np.zeros(3), [1, 0, 0, 0])
FILLED = {
    "ring": torus(),
    "hill": trimesh.util.concatenate([trimesh.convex.convex_hull(one) for one in PRISMS]),
}
BENT = FILLED | {"half a ring": torus(0.5)}


def to_triangles(shapes, points):
    """Distance from each point (n, 3) to the nearest of the meshes; 0 within a filled one."""
    nearest = np.full(len(points), np.inf)
    for mesh, is_filled in shapes:
        _, outside, _ = trimesh.proximity.closest_point_naive(mesh, points)
        windings = reference.winding_number(np.asarray(mesh.triangles), points)
        within = is_filled & (np.abs(windings) > 0.5)
        nearest = np.minimum(nearest, np.where(within, 0.0, outside))
    return nearest


def test_clearance_keeps_the_distances_of_triangles(rng):
    """Meshes and height fields at any attitude."""
    spec, shapes = mujoco.MjSpec(), []
    for name in ("hill", "ring", "half a ring", "ring"):
        at = rng.uniform(BOUNDS[0] + 1.0, BOUNDS[1] - 1.0), rng.normal(size=4)
        if name == "hill":
            reference.add_hfield(spec, ELEVATION, HILL, *at)
        else:
            reference.add_mesh(spec, BENT[name], *at)
        pose = np.eye(4)
        pose[:3, 3], pose[:3, :3] = at[0], reference.rotation(at[1])
        shapes.append((BENT[name].copy().apply_transform(pose), name in FILLED))
    clearance = Clearance(solids_of(spec.compile()), BOUNDS)
    corners = np.concatenate([mesh.vertices for mesh, _ in shapes])
    points = np.clip(rng.choice(corners, 120) + rng.normal(0.0, 0.4, (120, 3)), *BOUNDS)
    expected = check_distances(clearance, points, to_triangles(shapes, points))
    assert ((expected > 0.05) & (expected < CAP_M)).sum() > 25
    surfaces = to_triangles([(mesh, False) for mesh, _ in shapes], points)
    assert ((expected == 0) & (surfaces > 0.05)).sum() > 8  # well within a filled shape
    distances = functools.partial(to_triangles, shapes)
    check_motions(clearance, distances, rng, count=10, longest_m=1.5)


def test_a_world_without_solids_is_all_free():
    empty = among(Shape("sphere", (1, 0, 0), np.full(3, 50.0)))
    assert empty.at(*BOUNDS.mean(axis=0)) == CAP_M
    assert empty.motion_is_free(*map(tuple, BOUNDS), 0.9)


def test_a_motion_may_be_blocked_at_its_ends_alone():
    """A ball of 0.3 m against a thin plate, as near to either end as can be."""
    clearance = among(Shape("box", (0.01, 1, 1)).at([0, 0, 2]))
    for length in (0.0005, 0.4, 3.0):
        for gap, free in ((0.305, True), (0.295, False)):
            ends = (0.01 + gap, 0.0, 2.0), (0.01 + gap + length, 0.0, 2.0)
            assert clearance.motion_is_free(*ends, 0.3) is free
            assert clearance.motion_is_free(*ends[::-1], 0.3) is free


def test_a_motion_that_grazes_a_post_is_seen():
    """Wherever its steps fall: a ball of 5 cm past a post of 2 cm, which meet over 4 cm of a long
    way, or pass with 3 mm between them."""
    clearance = among(Shape("cylinder", (0.02, 1, 0)).at([0, 0, 2]))
    for start in np.random.default_rng(0).uniform(-2.0, -0.5, 50):
        for y, free in ((0.067, False), (0.073, True)):
            assert clearance.motion_is_free((start, y, 2.0), (1.5, y, 2.0), 0.05) is free
