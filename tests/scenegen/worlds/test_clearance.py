"""Distances and motion checks against MuJoCo's own for primitives, and against triangles and
winding numbers."""

import functools
import itertools
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from lidarsim.solids import solids_of
from scenegen.worlds.clearance import CAP_M, Clearance
from tests.scenegen.truth import reference

Floats = NDArray[np.float64]
Distances = Callable[[Floats], Floats]
Geom = mujoco.mjtGeom
BOUNDS = np.array([[-3.0, -5.0, 0.0], [6.0, 2.5, 4.0]])
"""Not a whole number of cells along either side, and not at the origin."""
TINY_M = 1e-6
"""Radius of the probe that stands for a point. (MuJoCo 4.0 finds a long thin capsule 0.2 m from a
box that it crosses, so a probe of that kind cannot stand for a motion.)"""
ROUNDING_M = 1e-5
"""MuJoCo's distances are found by iteration, and its meshes hold float32 numbers."""
SLACK_M = 2e-3
"""What a motion check may be off by; its shortest step is half of it."""


def primitive_world(seed):
    """Primitives of every kind at any attitude, within the bounds and around them; the last geom is
    a probe."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    names = ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX")
    shapes = [getattr(Geom, f"mjGEOM_{name}") for name in names]
    for shape in shapes * 6:
        size, quat = rng.uniform(0.1, 0.9, 3), rng.normal(size=4)
        pos = rng.uniform(BOUNDS[0] - 1.2, BOUNDS[1] + 1.2)
        spec.worldbody.add_geom(type=shape, size=size, pos=pos, quat=quat)
    spec.worldbody.add_geom(
        type=Geom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, 0.2], quat=[1, 0.1, 0.1, 0]
    )
    # invisible, so that it is not among the solids
    spec.worldbody.add_geom(type=Geom.mjGEOM_SPHERE, size=[TINY_M, 0, 0], rgba=[0, 0, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


def distances_by_mujoco(model, data, points):
    """Distance from each point (n, 3) to the nearest geom but the probe; 0 within one, and at least
    1.5 m is inf."""
    probe, far_m = model.ngeom - 1, 1.5
    found = np.full(len(points), np.inf)
    gaps = np.linalg.norm(points[:, None] - data.geom_xpos, axis=2) - model.geom_rbound
    gaps[:, model.geom_type == Geom.mjGEOM_PLANE] = 0.0
    for n, geom in np.argwhere(gaps[:, :probe] < far_m):
        data.geom_xpos[probe] = points[n]
        apart = mujoco.mj_geomDistance(model, data, geom, probe, far_m, None)
        found[n] = min(found[n], max(apart + TINY_M, 0.0) if apart < far_m else np.inf)
    return found


def motions(rng, longest_m):
    """Segments within the bounds, a fifth of them along an axis."""
    for n in itertools.count():
        p = rng.uniform(BOUNDS[0], BOUNDS[1])
        along = np.eye(3)[rng.integers(3)] if n % 5 == 0 else rng.normal(size=3)
        q = p + rng.uniform(0.0, longest_m) * along / np.linalg.norm(along)
        yield p, np.clip(q, BOUNDS[0], BOUNDS[1])


def nearest_along(distances, p, q):
    """Least distance from points of pq, 2 mm apart: sampled coarsely, then densely where the least
    may lie, for a distance changes by no more than its point moves."""
    coarse_m, fine_m, length = 0.05, 2e-3, float(np.linalg.norm(q - p))
    coarse, fine = (np.linspace(0.0, 1.0, int(length / step) + 2) for step in (coarse_m, fine_m))
    found = distances(p + coarse[:, None] * (q - p))
    near = coarse[found <= found.min() + coarse_m]
    beside = (np.abs(fine[:, None] - near) * length <= coarse_m).any(axis=1)
    return float(distances(p + fine[beside, None] * (q - p)).min())


def check_motions(clearance, distances, seed, *, count, longest_m):
    """A motion is free where all its points are farther than the radius, and is not where one of
    them is nearer."""
    rng = np.random.default_rng(seed)
    verdicts = []
    for p, q in itertools.islice(motions(rng, longest_m), count):
        nearest = nearest_along(distances, p, q)
        # close to the verdict's edge as often as anywhere
        radius = float(
            np.clip(rng.choice([nearest + rng.normal(0, 0.01), rng.uniform(0.05, 0.6)]), 0.05, 0.9)
        )
        free = clearance.motion_is_free(tuple(p), tuple(q), radius)
        if abs(nearest - radius) > SLACK_M:
            assert free == (nearest > radius), (p, q, radius, nearest)
            verdicts.append(free)
    assert min(verdicts.count(True), verdicts.count(False)) > count / 8


def check_distances(clearance, points, distances):
    """The distances to be found at points, which are."""
    expected = np.minimum(distances, CAP_M)
    found = np.array([clearance.at(*p) for p in points])
    assert_allclose(found, expected, rtol=0, atol=ROUNDING_M)
    assert (found[expected == 0] == 0).all()
    return expected


@pytest.mark.parametrize("seed", [0, 1])
def test_distances_to_primitives_are_those_of_mujoco_and_motions_keep_them(seed):
    model, data = primitive_world(seed)
    clearance = Clearance(solids_of(model), BOUNDS)

    def distances(points):
        return distances_by_mujoco(model, data, points)

    points = np.random.default_rng(seed).uniform(BOUNDS[0], BOUNDS[1], (250, 3))
    expected = check_distances(clearance, points, distances(points))
    between = (expected > 0) & (expected < CAP_M)
    assert min((expected == 0).sum(), (expected == CAP_M).sum(), between.sum()) > 5
    check_motions(clearance, distances, seed, count=60, longest_m=4.0)
    for p in points[:100]:  # motions of no length
        assert clearance.motion_is_free(tuple(p), tuple(p), 0.3) == (clearance.at(*p) >= 0.3)


def torus(share=1.0):
    """A ring; with a share below 1, its first faces alone, which enclose nothing."""
    ring = trimesh.creation.torus(
        major_radius=1.1, minor_radius=0.5, major_sections=14, minor_sections=7
    )
    faces = ring.faces[: round(share * len(ring.faces))]
    # each edge of a triangle lies at the rim of some
    return trimesh.Trimesh(ring.vertices, [np.roll(face, n) for n, face in enumerate(faces)])


def hill():
    """A height field of 5 x 6 points over 2.4 x 3.6 m, as the prisms that it is."""
    prisms = reference.hfield_prisms(ELEVATION * HILL[2], HILL, np.zeros(3), [1, 0, 0, 0])
    return trimesh.util.concatenate([trimesh.convex.convex_hull(one) for one in prisms])


ELEVATION = (
    (np.random.default_rng(7).permutation(30).reshape(5, 6) / 29.0).astype(np.float32).astype(float)
)
"""From 0 to 1, both reached, or else MuJoCo would stretch it."""
HILL = (1.2, 1.8, 1.5, 0.4)
BENT = {"ring": torus(), "half a ring": torus(0.5), "hill": hill()}
FILLED = ("ring", "hill")


def bent_world(names, seed):
    """Meshes and height fields at any attitude: their clearance, and each as triangles in the
    world, filled or not."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    shapes = []
    for name in names:
        at = rng.uniform(BOUNDS[0] + 1.0, BOUNDS[1] - 1.0), rng.normal(size=4)
        if name == "hill":
            reference.add_hfield(spec, ELEVATION, HILL, *at)
        else:
            reference.add_mesh(spec, BENT[name], *at)
        pose = np.eye(4)
        pose[:3, 3], pose[:3, :3] = at[0], reference.rotation(at[1])
        shapes.append((BENT[name].copy().apply_transform(pose), name in FILLED))
    return Clearance(solids_of(spec.compile()), BOUNDS), shapes


def distances_to(shapes, points):
    """Distance from each point (n, 3) to the nearest of the shapes; 0 within a filled one."""
    nearest = np.full(len(points), np.inf)
    for shape, filled in shapes:
        _, outside, _ = trimesh.proximity.closest_point_naive(shape, points)
        within = filled & (
            np.abs(reference.winding_number(np.asarray(shape.triangles), points)) > 0.5
        )
        nearest = np.minimum(nearest, np.where(within, 0.0, outside))
    return nearest


@pytest.mark.parametrize(
    "names", [("ring",), ("half a ring",), ("hill",), ("hill", "ring", "half a ring", "ring")]
)
def test_distances_to_meshes_and_height_fields_are_those_of_their_triangles(names, rng):
    clearance, shapes = bent_world(names, seed=len(names[0]))
    corners = np.concatenate([np.asarray(shape.vertices) for shape, _ in shapes])
    near = corners[rng.integers(0, len(corners), 200)] + rng.normal(0.0, 0.4, (200, 3))
    points = np.clip(near, BOUNDS[0], BOUNDS[1])
    expected = check_distances(clearance, points, distances_to(shapes, points))
    assert ((expected > 0.05) & (expected < CAP_M)).sum() > 40
    if names != ("half a ring",):
        deep = (expected == 0) & (
            distances_to([(shape, False) for shape, _ in shapes], points) > 0.05
        )
        assert deep.sum() > 8  # else no point lies well within a filled shape


def test_a_motion_among_meshes_is_free_where_its_points_keep_the_radius():
    clearance, shapes = bent_world(("hill", "ring", "half a ring"), 0)
    distances = functools.partial(distances_to, shapes)
    check_motions(clearance, distances, 0, count=10, longest_m=1.5)


def alone(kind, size, place):
    """The clearance around one solid."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=kind, size=size, pos=place)
    return Clearance(solids_of(spec.compile()), BOUNDS)


def test_a_world_without_solids_is_all_free():
    empty = alone(Geom.mjGEOM_SPHERE, [1, 0, 0], [50, 50, 50])
    assert empty.at(*BOUNDS.mean(axis=0)) == CAP_M
    assert empty.motion_is_free(tuple(BOUNDS[0]), tuple(BOUNDS[1]), 0.9)


def test_a_motion_may_be_blocked_at_its_ends_alone():
    """A ball of 0.3 m against a thin plate, as near to either end as can be."""
    clearance = alone(Geom.mjGEOM_BOX, [0.01, 1, 1], [0, 0, 2])
    for length in (0.0005, 0.4, 3.0):
        for gap, free in ((0.305, True), (0.295, False)):
            at, away = (0.01 + gap, 0.0, 2.0), (0.01 + gap + length, 0.0, 2.0)
            assert clearance.motion_is_free(at, away, 0.3) is free
            assert clearance.motion_is_free(away, at, 0.3) is free
    assert not clearance.motion_is_free((-1.0, 0.0, 2.0), (1.0, 0.0, 2.0), 0.3)
    assert clearance.motion_is_free((-1.0, 1.4, 2.0), (1.0, 1.4, 2.0), 0.3)


def test_a_motion_that_grazes_a_post_is_seen_wherever_its_steps_fall():
    """A ball of 5 cm past a post of 2 cm: they meet over 4 cm of a long way, or pass with 3 mm
    between them."""
    clearance = alone(Geom.mjGEOM_CYLINDER, [0.02, 1, 0], [0, 0, 2])
    for start in np.random.default_rng(0).uniform(-2.0, -0.5, 50):
        for y, free in ((0.067, False), (0.073, True)):
            assert clearance.motion_is_free((start, y, 2.0), (1.5, y, 2.0), 0.05) is free
