"""A voxel is occupied when its closed cube is within 1e-6 m of a solid: checked against
``reference``."""

import dataclasses
import json
import math

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from lidarsim import GridSpec
from lidarsim.solids import solids_of
from scenegen.truth import rasterize
from tests.conftest import quarter
from tests.scenegen import each_case
from tests.scenegen.truth import reference
from tests.scenegen.truth.reference import EITHER, FREE, KINDS, OCCUPIED, Shape, unit

VOXELS = (0.1, 0.2, 0.25)

THINNEST, THICKEST = 0.01, 5.0  # metres across


def agreed(solids, verdict, voxel, origin, *where, hollow=False):
    """The answer under test, which must be the reference's, wherever the case is from."""
    grid = GridSpec(shape=verdict.shape, voxel_m=voxel, hollow=hollow)
    answer = rasterize(solids, grid, origin)
    wrong = np.argwhere(verdict == np.where(answer, FREE, OCCUPIED))
    assert wrong.tolist() == [], (where, voxel, origin)
    return answer


def check(shape, solids, grid_shape, voxel, origin):
    """Assert that the answer for one shape, compiled to `solids`, is the reference's."""
    verdict, boundary = reference.judge(shape, grid_shape, voxel, origin)
    agreed(solids, verdict, voxel, origin, shape)
    return verdict, boundary


def log_uniform(rng, low, high, n=3):
    return np.exp(rng.uniform(math.log(low), math.log(high), n))


def random_size(rng):
    """Half sizes: thin in any number of directions, in one only (plates), or all but one and 50 m
    long; or from 0.2 mm to 4 cm across, smaller than any voxel."""
    half = log_uniform(rng, THINNEST / 2, THICKEST / 2)
    style = rng.random()
    if style < 0.5:
        keep = rng.integers(3)
        half[np.arange(3) != keep] = log_uniform(rng, THICKEST / 8, THICKEST / 2, 2)
    elif style < 0.6:
        half[rng.integers(3)] = rng.uniform(5, 25)
    elif style < 0.65:
        half = log_uniform(rng, 1e-4, 2e-2)
    return tuple(half.tolist())


def random_shape(kind, rng):
    """A shape at the origin; a plane's size numbers (0 or not) are for drawing only."""
    size = random_size(rng)
    if kind == "plane":
        size = (0.0, 0.0, 1.0) if rng.random() < 0.5 else (size[0], size[1], 1.0)
    return Shape(kind, size, quat=rng.normal(size=4))


def surface_point(shape, rng):
    """A point on the surface: where a random plane touches it, or on a random ray from inside."""
    if shape.kind == "plane":
        return shape.pos + shape.rot[:, :2] @ rng.uniform(-30, 30, 2)
    a, b = (reference.support_point(shape, unit(rng)) for _ in range(2))
    if rng.random() < 0.5:
        return a
    inside, direction = a + rng.random() * (b - a), unit(rng)
    ray = inside + np.linspace(0, 60, 3001)[:, None] * direction
    return ray[np.flatnonzero(reference.points_inside(shape, ray)).max(initial=0)]


def placed(kind, rng, n):
    """A random shape whose surface passes through the middle part of a random map of n cubed
    voxels."""
    shape = random_shape(kind, rng)
    voxel = float(rng.choice(VOXELS))
    origin = rng.uniform(-20, 20, 3)
    target = origin + rng.uniform(0.2, 0.8, 3) * n * voxel
    return shape.at(target - surface_point(shape, rng)), voxel, origin


# ------------------------------------------------------------------------------------------
# The reference itself
# ------------------------------------------------------------------------------------------


# Metres between the solid and the cube; negative is how deep one sinks into the other.
TOUCHING = (-1e-3, -1e-5, -2e-6, 0.0, 4e-7)
APART = (3.5e-6, 1e-5, 1e-3)


def cube_feature(index, voxel, origin, rng):
    """A point on a face, edge or corner of a voxel and a unit outward normal of the cube there."""
    side = np.zeros(3, int)
    while not side.any():
        side = rng.integers(-1, 2, 3)  # the extreme it sits at, per axis; 0 is in between
    spread = np.where(side == 0, rng.uniform(-0.4, 0.4, 3), side * 0.5)
    normal = side * rng.uniform(0.2, 1, 3)
    return origin + (index + 0.5 + spread) * voxel, normal / np.linalg.norm(normal)


def squarely(shape, normal, rng):
    """The shape turned until one of its axes, or a direction up to 0.1 rad from it, points along
    -normal."""
    along = np.eye(3)[rng.integers(3)] + rng.normal(size=3) * 10.0 ** rng.uniform(-9, -1)
    turn, _ = Rotation.align_vectors([-normal], [along / np.linalg.norm(along)])
    x, y, z, w = (Rotation.from_rotvec(normal * rng.uniform(0, 2 * math.pi)) * turn).as_quat()
    return Shape(shape.kind, shape.size, shape.pos, np.array([w, x, y, z]))


@pytest.mark.parametrize("kind", KINDS)
@quarter(250, 8)
def test_gaps_of_a_micrometre_decide(kind, count, rng):
    """Cubes at a distance known by construction, from solids at random attitudes or flat against
    them.

    The point of the solid that is farthest along -n is put the gap away along n from a point of the
    cube where n is an outward normal: the plane between the two separates them, so the gap is their
    distance. No search is involved, so this judges ``reference`` too.
    """
    cubes, grid_shape = 0, (3, 2, 4)
    for _ in range(count):
        voxel = float(rng.choice(VOXELS))
        shape = random_shape(kind, rng)
        origin, index = rng.uniform(-5, 5, 3), rng.integers(0, grid_shape)
        if kind == "plane":
            normal = shape.rot[:, 2]
            touch = origin + (index + 0.5 + np.where(normal > 0, -0.5, 0.5)) * voxel
            normal, lowest = -normal, shape.rot[:, :2] @ rng.uniform(-9, 9, 2)
        else:
            touch, normal = cube_feature(index, voxel, origin, rng)
            attitude = rng.integers(4)
            if attitude > 1:
                shape = squarely(shape, normal, rng)
            elif attitude == 1:  # upright to the bit
                shape = dataclasses.replace(shape, quat=np.array([1.0, 0, 0, rng.normal()]))
            lowest = reference.support_point(shape, -normal)
        shape = shape.at(touch - lowest)
        solids = solids_of(reference.world_of(shape))
        for gap in (*TOUCHING, *APART):
            if gap < 0 and kind != "plane" and -gap > min(shape.size[: 1 + (kind != "sphere")]) / 2:
                continue  # it would come out at the other side
            verdict, _ = check(shape, solids, grid_shape, voxel, origin - gap * normal)
            expected = OCCUPIED if gap in TOUCHING else FREE
            assert verdict[tuple(index)] == expected, (shape, voxel, origin, index, gap)
            cubes += 1
    assert cubes > 6 * count


# ------------------------------------------------------------------------------------------
# Every primitive at many attitudes
# ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@quarter(1000, 16)
def test_primitives_occupy_the_cubes_they_touch(kind, count):
    """Random sizes, attitudes, positions and voxels; every voxel of every map, near the surface or
    not."""
    rng, grid_shape, counts = np.random.default_rng([13, KINDS.index(kind)]), (16, 16, 16), []
    for _ in range(count):
        shape, voxel, origin = placed(kind, rng, 16)
        solids = solids_of(reference.world_of(shape))
        verdict, boundary = check(shape, solids, grid_shape, voxel, origin)
        masks = boundary, boundary & (verdict == OCCUPIED), verdict == EITHER
        counts.append([mask.sum() for mask in masks])
    boundary, filled, undecidable = np.sum(counts, axis=0)
    assert boundary >= (300 if kind == "plane" else 150) * count
    assert 0.02 * boundary < filled < 0.98 * boundary
    assert undecidable < 1e-4 * boundary


# ------------------------------------------------------------------------------------------
# Meshes
# ------------------------------------------------------------------------------------------


def ring():
    """A torus of 120 faces."""
    return trimesh.creation.torus(0.8, 0.3, major_sections=10, minor_sections=6)


def box(low, high):
    return trimesh.creation.box(bounds=(low, high))


def hollow_box():
    """A box with a box-shaped cavity that no passage joins to the outside."""
    inner = box([-0.6, -0.5, -0.45], [0.65, 0.55, 0.4])
    inner.invert()
    return trimesh.util.concatenate([box([-1, -0.9, -0.8], [1, 0.9, 0.8]), inner])


def touching_blocks():
    """One mesh of two closed pieces that share an edge."""
    blocks = box([-1, -0.3, -0.3], [-0.2, 0.4, 0.5]), box([-0.2, 0.4, -0.3], [0.8, 1, 0.5])
    both = trimesh.util.concatenate(blocks)
    both.merge_vertices()
    assert len(both.vertices) == 14
    return both


def punctured_ball():
    """A round shell that misses a single triangle."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.9)
    return listed(ball.vertices, ball.faces[1:])


def slivers():
    """Two dozen triangles at random, half of them so thin that they slip past every centre."""
    rng = np.random.default_rng(23)
    corners = rng.uniform(-1, 1, (24, 3, 3))
    corners[:12, 1] = corners[:12, 0] + rng.normal(scale=0.05, size=(12, 3))
    return listed(corners.reshape(-1, 3), np.arange(72).reshape(-1, 3))


def listed(vertices, faces):
    """A mesh of these faces, as they are."""
    return trimesh.Trimesh(vertices, faces, process=False)


WATERTIGHT = {make.__name__: make for make in (ring, hollow_box, touching_blocks)}
MESHES = WATERTIGHT | {make.__name__: make for make in (punctured_ball, slivers)}


def mesh_solids(*mesh, **more):
    """The solids of a world of one mesh."""
    spec = mujoco.MjSpec()
    reference.add_mesh(spec, *mesh, **more)
    return solids_of(spec.compile())


def judged(triangles, is_filled, *where):
    """The verdict on a mesh, and that on its surface."""
    surface = reference.judge_hulls(triangles, *where)
    filled = reference.filled(surface, triangles, *where[1:]) if is_filled else surface
    return filled, surface


def mesh_triangles(mesh, pos, quat):
    """The triangles in the world, from the vertices that were put in (MuJoCo keeps float32)."""
    return mesh.triangles.astype(np.float32).astype(float) @ reference.rotation(quat).T + pos


@pytest.mark.parametrize("name", MESHES)
@quarter(150)
def test_closed_meshes_are_filled_and_open_ones_not(name, count):
    """In maps of all of it and in small ones anywhere in and around it: hollows and holes stay
    free, and what is inside does not depend on how much the map shows."""
    rng = np.random.default_rng(22)
    mesh, solid_maps = MESHES[name](), 0
    for whole_voxel in VOXELS:
        pos, quat = rng.uniform(-5, 5, 3), rng.normal(size=4)
        triangles = mesh_triangles(mesh, pos, quat)
        solids = mesh_solids(mesh, pos, quat)
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        maps = [((20, 20, 20), whole_voxel, pos + rng.uniform(-0.4, 0.4, 3))]
        for _ in range(count // 3):
            shape, voxel = tuple(rng.integers(1, 7, 3).tolist()), rng.choice([0.025, 0.1, 0.2])
            maps.append((shape, float(voxel), rng.uniform(low, high)))
        for shape, voxel, middle in maps:
            place = voxel, middle - np.array(shape) * voxel / 2
            verdict, surface = judged(triangles, name in WATERTIGHT, shape, *place)
            answer = agreed(solids, verdict, *place, pos, quat)
            agreed(solids, surface, *place, pos, quat, hollow=True)
            solid_maps += bool(answer.all()) and answer.size > 20
    assert (solid_maps > 0) == (name in WATERTIGHT)


@each_case("mesh_lists", "scale order", json.loads)
def test_a_watertight_mesh_is_filled_however_listed(scale, order):
    """Scaled or mirrored; vertices not shared between faces, or faces wound the wrong way round,
    enclose the same space."""
    mesh, at = ring(), (np.array([2.0, 2.1, 1.9]), np.array([0.3, 0.5, -0.2, 0.7]))
    points, faces, place = mesh.vertices, mesh.faces, (0.2, np.zeros(3))
    triangles = mesh_triangles(listed(points * scale, faces), *at)
    verdict, _ = judged(triangles, True, (20, 20, 20), *place)
    turned = (np.arange(len(faces)) % 3 == 0)[:, None]
    variant = {
        "whole": mesh,
        "apart": listed(points[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)),
        "inward": listed(points, faces[:, ::-1]),
        "mixed": listed(points, np.where(turned, faces[:, ::-1], faces)),
    }[order]
    agreed(mesh_solids(variant, *at, scale=scale), verdict, *place)


# ------------------------------------------------------------------------------------------
# Height fields
# ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
def test_height_fields_are_filled_down_to_their_base(turned, rng):
    """Elevations are float32 numbers, as MuJoCo keeps them."""
    occupied, grid_shape, voxel = 0, (16, 16, 16), 0.2
    for _ in range(12):
        elevation = rng.random(rng.integers(2, 12, 2)).astype(np.float32).astype(float)
        elevation.flat[rng.choice(elevation.size, 2, replace=False)] = 0, 1
        size = tuple(rng.uniform([0.4, 0.4, 0.05, 0.01], [1.6, 1.6, 1.2, 0.6]).tolist())
        quat = rng.normal(size=4) if turned else np.array([1.0, 0, 0, 0])
        origin = rng.uniform(-5, 5, 3)
        at = origin + 1.6 + rng.uniform(-0.3, 0.3, 3), quat
        spec = mujoco.MjSpec()
        reference.add_hfield(spec, elevation, size, *at)
        prisms = reference.hfield_prisms(elevation * size[2], size, *at)
        verdict = reference.judge_hulls(prisms, grid_shape, voxel, origin)
        agreed(solids_of(spec.compile()), verdict, voxel, origin, elevation, size, at)
        occupied += (verdict == OCCUPIED).sum()
    assert occupied > 2000
