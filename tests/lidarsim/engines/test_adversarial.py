"""Worlds made to break ray casters, as a law: every range is that of almost the same world.

Rays start inside solids, on them, and 900 km away, touch them, run along their faces, and aim at
their edges, rims, seams and corners; solids measure 0.1 mm to 1 km, share surfaces, and stand
900 km from the world's origin. The reference, `reference.interval`, computes in numpy's longest
floats.

A range is right if some solids, larger or smaller than the world's by a tolerance, give it within
that tolerance. So a ray that touches a solid may hit or miss it, and nothing else may be missed.
"""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from lidarsim import AnalyticEngine
from lidarsim.solids import solids_of
from tests.conftest import quarter
from tests.lidarsim import reference
from tests.lidarsim.engines.test_laws import PROCESSORS, data_of, made, model_of, numbers
from tests.lidarsim.reference import unit

FAR_M = 9e5
SIZES = {"sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3}
MIN_M, MAX_M = 1e-4, 1e3
EPSILON = 2.0**-52
ROUNDINGS = 8
RAYS = 400
"""Aimed at each solid."""


def features(rng, kind, size):
    """Points in a solid's frame: on its edges, rims, seams, corners and poles, a little beside
    them, and anywhere in it."""
    half = {"sphere": (0, 0, 0), "ellipsoid": (0, 1, 2), "box": (0, 1, 2)}.get(kind, (0, 0, 1))
    extent = size[list(half)]
    if kind == "capsule":
        extent[2] += size[0]
    shares = [0.0, 0.5, 0.5**0.5, 1.0, 1.0, 1 - 1e-12, 1 + 1e-12, size[-1] / extent[2]]
    special = rng.choice(shares, (RAYS, 3)) * rng.choice([-1, 1], (RAYS, 3))
    some = rng.random((RAYS, 1)) < 0.8
    return extent * np.where(some, special, rng.uniform(-1, 1, (RAYS, 3)))


def aimed(rng, points, size_m):
    """Rays at points of a solid: random, touching, along axes, from right there, from inside."""
    sort = rng.integers(0, 4, (RAYS, 1))
    rays = unit(rng.normal(size=(RAYS, 3)))
    tilt = rng.choice([0, 0, 1e-16, -1e-16, 1e-14, -1e-12, 1e-8, -1e-4], (RAYS, 3))
    axes = rng.permuted(np.tile([1.0, 0.0, 0.0], (RAYS, 1)), axis=1) + tilt
    rays = np.where(sort == 1, axes * rng.choice([-1, 1], (RAYS, 1)), rays)
    away = size_m * 10.0 ** rng.uniform(-2, 2, (RAYS, 1))
    away[rng.random(RAYS) < 0.2] = FAR_M
    inside = rng.random((RAYS, 1)) * rng.permutation(points)
    origins = np.select([sort == 2, sort == 3], [points, inside], points - away * rays)
    return origins, unit(np.where(sort == 3, points - inside, rays))


def right(kind, size, rays, found, tol):
    """Whether each of the ranges `found` is the solid's.

    An origin, a direction and a point met are each rounded a few times, in shares of the distance
    and of the solid's size; where the world's origin is does not matter.
    """
    moves = np.ones(len(size))
    if kind == "capsule":
        moves[1] = 0.0  # its radius moves all of it
    if kind == "ellipsoid":
        moves = size / size.min()  # if all axes grew alike, it would hardly move beside its ends
    more, less = (np.maximum(size[:, None] + np.outer(moves, by), 1e-30) for by in (tol, -tol))
    near, far = reference.interval(kind, list(more), *rays)
    near_less, far_less = reference.interval(kind, list(less), *rays)
    gone, inside = np.isinf(near_less), near <= tol
    missed = gone | (far_less < tol)
    comes_in = (near - tol <= found) & (found <= np.where(gone, far, near_less) + tol)
    comes_out = inside & (np.where(gone, near, far_less) - tol <= found) & (found <= far + tol)
    return np.where(np.isinf(found), missed, comes_in | comes_out)


@pytest.mark.parametrize("kind", SIZES)
@quarter(24)
def test_one_solid_of_any_size_from_anywhere(kind, count):
    rng, hits = np.random.default_rng(sum(map(ord, kind))), 0
    for n in range(count):
        size = np.exp(rng.uniform(np.log(MIN_M), np.log(MAX_M), SIZES[kind]))
        if rng.random() < 0.5:  # as long as wide, or almost
            size = np.clip(size[0] * rng.uniform(0.5, 2.0, len(size)), MIN_M, MAX_M)
        place = FAR_M * unit(rng.normal(size=3)) if n % 2 else rng.uniform(-1, 1, 3)
        attitude = reference.random_quaternion(rng) if rng.random() < 0.7 else np.eye(4)[0]
        pose = f'pos="{numbers(place)}" quat="{numbers(attitude)}"'
        model = model_of(f'type="{kind}" size="{numbers(size)}" {pose}')
        data = data_of(model)
        place, turn = data.geom_xpos[0], data.geom_xmat.reshape(3, 3).astype(np.longdouble)
        points, rays = aimed(rng, features(rng, kind, size), float(size.max()))
        origins = (points @ turn.T + place).astype(np.float64)
        vectors = unit((rays @ turn.T).astype(np.float64))
        ranges = AnalyticEngine.of(model).cast(origins, vectors[:, None], np.inf)[:, 0]
        starts = (origins.astype(np.longdouble) - place) @ turn
        reach = np.sqrt((starts * starts).sum(axis=1)) + np.linalg.norm(size)
        tol = ROUNDINGS * EPSILON * reach
        assert right(kind, size, (starts, vectors @ turn), ranges, tol).all()
        hits += np.isfinite(ranges).sum()
    assert hits > 0.1 * RAYS * count


@pytest.mark.parametrize("name", PROCESSORS)
@pytest.mark.parametrize("stray", [-9e-7, 4.9e-7, "float32"])
def test_units_to_a_millionth_give_metres(name, stray):
    """Balls of 3 cm up to 400 m away, each met head on."""
    rng = np.random.default_rng(8)
    rays, far = unit(rng.normal(size=(300, 3))), np.linspace(1.0, 400.0, 300)
    if stray == "float32":
        rays = rays.astype(np.float32).astype(np.float64)
    else:
        rays *= 1 + stray
    balls = [f'size="0.03" pos="{numbers(place)}"' for place in far[:, None] * unit(rays)]
    ranges = made(name, model_of(*balls)).cast(np.zeros((1, 3)), rays[None], 1e3)[0]
    assert_allclose(ranges, far - 0.03, rtol=0, atol=1e-8)


def random_mesh(rng, scale):
    """A bumpy closed surface, not convex."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    bumps = rng.uniform(0.5, 1.5, (len(ball.vertices), 1)) * rng.uniform(0.4, 1.2)
    vertices = numbers((ball.vertices * bumps + rng.uniform(-1, 1, 3)).ravel())
    faces, scales = numbers(ball.faces.ravel()), numbers([scale] * 3)
    shape = f'vertex="{vertices}" face="{faces}" scale="{scales}"'
    return f'<mesh name="bumps" inertia="shell" {shape}/>'


@pytest.mark.parametrize("shape", ['type="mesh" mesh="bumps"', 'type="hfield" hfield="h"'])
def test_no_ray_leaks_out_of_a_closed_surface(shape, rng):
    """From within, rays at its corners, at the middles of its edges, and anywhere on these, all
    meet it: small and large, near and 900 km from the world's origin."""
    for scale, place in ((MIN_M, 0.0), (1.0, 0.0), (1.0, 100.0), (1.0, FAR_M), (300.0, FAR_M)):
        turn = numbers(reference.random_quaternion(rng))
        geom = f'{shape} pos="{place} 0 0" quat="{turn}"'
        solids = solids_of(model_of(geom, assets=random_mesh(rng, scale)))
        assert solids.mesh_filled.all()
        a, b, c = np.moveaxis(solids.triangles, 1, 0)
        depth = 1e-3 * np.linalg.norm(b - a, axis=1, keepdims=True)
        below = (a + b + c) / 3 - depth * unit(np.cross(b - a, c - a))
        origins = below[rng.integers(0, len(a), 60)]
        share = np.array([0.0, 0.5, *rng.random(3)])[:, None, None]
        edges = np.concatenate([share * u + (1 - share) * v for u, v in ((a, b), (b, c), (c, a))])
        rays = unit(edges.reshape(-1, 3) - origins[:, None])
        assert rays.size > 30_000
        assert np.isfinite(AnalyticEngine(solids).cast(origins, rays, np.inf)).all()
