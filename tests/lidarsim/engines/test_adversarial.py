"""Worlds made to break ray casters, as a law: every range is that of almost the same world.

Rays start inside solids, on them, and 900 km away, touch them, run along their faces, and aim at
their edges, rims, seams and corners; solids measure 0.1 mm to 1 km, share surfaces, and stand
900 km from the world's origin. The reference, `reference.interval`, computes in numpy's longest
floats.

A range is right if some solids, larger or smaller than the world's by a tolerance, give it within
that tolerance. So a ray that touches a solid may hit or miss it, and nothing else may be missed.
"""

from typing import Any

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from lidarsim import AnalyticEngine
from lidarsim.solids import solids_of
from tests.conftest import quarter
from tests.lidarsim import reference
from tests.lidarsim.engines.test_laws import HFIELD, PROCESSORS, made
from tests.lidarsim.reference import Body, Geom, unit

FAR_M = 9e5
SIZES = {"sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3}
LEAST_M, MOST_M = 1e-4, 1e3
EPSILON = 2.0**-52
ROUNDINGS = 8
SLIPS = {("mujoco", kind): 0.02 for kind in ("capsule", "cylinder", "box", "many")}
"""The share of rays that may be wrong, where it is not 0. In MuJoCo, some rays slip through the
edges, rims and seams that they aim at: they meet what is behind, or from inside nothing."""
Floats = NDArray[Any]


def tolerance_m(name, size, distance_m):
    """How far a solid's surface may seem to lie from where it is, for rays from such distances.

    An origin, a direction and a point met are each rounded a few times, in shares of the distance
    and of the solid's size; where the world's origin is does not matter. MuJoCo solves a quadratic
    equation for the distance, so that a share of its square hides the square of the size.
    """
    reach = distance_m + np.linalg.norm(size)
    return ROUNDINGS * EPSILON * (reach if name == "analytic" else reach**2 / size.min())


def features(rng, kind, size, count):
    """Points on a solid and normals there, in its frame; many on edges, rims, seams and corners."""
    ball = unit(rng.normal(size=(count, 3)))
    sign = rng.choice([-1.0, 1.0], (count, 3))
    ends = rng.random((count, 3)) < 0.5
    if kind in ("sphere", "ellipsoid"):
        axes = np.broadcast_to(size, 3)
        return axes * ball, unit(ball / axes)
    if kind == "box":
        ends[np.arange(count), rng.integers(0, 3, count)] = True
    if kind in ("box", "plane"):
        share = np.where(ends, sign, rng.uniform(-1, 1, (count, 3)))
        if kind == "box":
            return share * size, unit(np.where(ends, share * rng.random((count, 3)), 0.0))
        return share * [size[0] or 3.0, size[1] or 3.0, 0.0], np.tile([0.0, 0.0, 1.0], (count, 1))
    radius, half = size
    ring, up = unit(ball * [1.0, 1.0, 0.0]), sign[:, :1] * [0.0, 0.0, 1.0]
    side = radius * ring + half * up * np.where(ends[:, :1], 1.0, rng.random((count, 1)))
    flat = half * up + radius * ring * np.where(ends[:, 1:2], 1.0, rng.random((count, 1)))
    round_end = radius * ball + half * np.sign(ball) * [0.0, 0.0, 1.0]
    cap, out = (flat, up) if kind == "cylinder" else (round_end, ball)
    capped = rng.random((count, 1)) < 0.3
    return np.where(capped, cap, side), np.where(capped, out, ring)


def aimed(rng, points, normals, size_m):
    """Rays at points of a solid: random, touching, along axes, from right there, from inside."""
    count = len(points)
    sort = rng.integers(0, 5, (count, 1))
    rays = unit(rng.normal(size=(count, 3)))
    tilt = rng.choice([0, 0, 1e-16, -1e-16, 1e-14, -1e-12, 1e-8, -1e-4], (count, 1))
    touching = unit(rays - (rays * normals).sum(axis=1, keepdims=True) * normals) + tilt * normals
    axes = rng.permuted(np.tile([1.0, 0.0, 0.0], (count, 1)), axis=1)
    rays = np.select([sort == 1, sort == 2], [touching, axes * rng.choice([-1, 1])], rays)
    away = size_m * 10.0 ** rng.uniform(-2, 2, (count, 1))
    away[rng.random(count) < 0.2] = FAR_M
    share = rng.random((count, 1))
    inside = share * rng.permutation(points) + (1 - share) * rng.permutation(points)
    origins = np.select([sort == 3, sort == 4], [points, inside], points - away * rays)
    return origins, unit(np.where(sort == 4, points - inside, rays))


def right(kind, size, rays, found, tol):
    """Whether each of the ranges `found` is a solid's, and the greatest that would be."""
    if kind == "plane":
        return _right_of_plane(size, rays, found, tol)
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
    last = np.where(inside, far, np.where(gone, far, near_less)) + tol
    comes_in = (near - tol <= found) & (found <= np.where(gone, far, near_less) + tol)
    comes_out = inside & (np.where(gone, near, far_less) - tol <= found) & (found <= far + tol)
    return np.where(np.isinf(found), missed, comes_in | comes_out), np.where(missed, np.inf, last)


def _right_of_plane(size, rays, found, tol):
    """Planes are seen from above, within half sizes where these are not 0. What is rounded of a
    direction moves a point farther away by more."""
    half, slack = np.where(size[:2] > 0, size[:2], np.inf), ROUNDINGS * EPSILON
    start, along = rays
    height, falling = start[:, 2], -along[:, 2]

    def aside(t, by):
        at = start + np.where(np.isfinite(t), t, 0.0)[:, None] * along
        return (np.abs(at[:, :2]) > half + by[:, None]).any(axis=1)

    facing = falling > slack
    down = np.where(facing, falling, 1.0)
    way = height / down
    there = tol + slack * np.abs(way)
    first, last = way - there / down, way + there / down
    missed = ~facing | (height < tol) | aside(first, -there) | aside(last, -there)
    there = tol + slack * np.where(np.isfinite(found), found, 0.0)
    with np.errstate(invalid="ignore"):
        on_it = (falling > -slack) & (np.abs(height - found * falling) <= there)
    hit = on_it & ~aside(found, there)
    return np.where(np.isinf(found), missed, hit), np.where(missed, np.inf, last)


def turned(rng, geoms, far):
    """A world of geoms, moved and turned as one."""
    place = FAR_M * unit(rng.normal(size=3)) if far else rng.uniform(-1, 1, 3)
    attitude = reference.random_quaternion(rng) if rng.random() < 0.7 else [1.0, 0.0, 0.0, 0.0]
    inertia = '<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'  # too small of itself
    body = Body(tuple(geoms), tuple(place), tuple(attitude), inertia)
    return mujoco.MjModel.from_xml_string(reference.world_xml([], [body]))


def wrong_rays(name, model, rays_at):
    """Of rays aimed at each geom of a world, in its frame: how many are wrong, hit, are there."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    places, turns = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3).astype(np.longdouble)
    kinds = [mujoco.mjtGeom(int(code)).name[len("mjGEOM_") :].lower() for code in model.geom_type]
    sizes = [size[: SIZES.get(kind, 3)] for kind, size in zip(kinds, model.geom_size, strict=True)]
    geoms = list(zip(kinds, sizes, places, turns, strict=True))
    given = [(rays_at(kind, size), place, turn) for kind, size, place, turn in geoms]
    origins = np.concatenate([points @ turn.T + place for (points, _), place, turn in given])
    vectors = np.concatenate([unit(rays @ turn.T) for (_, rays), _, turn in given])
    origins, vectors = origins.astype(np.float64), unit(vectors.astype(np.float64))
    found = made(name, model).cast(origins, vectors[:, None], np.inf)[:, 0]
    anyones, latest = np.isinf(found), np.full(len(found), np.inf)
    for kind, size, place, turn in geoms:
        starts = (origins.astype(np.longdouble) - place) @ turn
        distance = np.sqrt((starts * starts).sum(axis=1))
        tol = tolerance_m("analytic" if kind == "plane" else name, size, distance)
        fits, last = right(kind, size, (starts, vectors @ turn), found, tol)
        latest = np.minimum(latest, last)
        anyones |= fits & np.isfinite(found)
    wrong = ~anyones | (found > latest)
    return np.array([wrong.sum(), np.isfinite(found).sum(), len(found)])


def assert_right(name, kind, wrong, hits, count):
    assert 0.1 * count < hits
    assert wrong <= SLIPS.get((name, kind), 0.0) * count


def at_features(rng, count):
    return lambda kind, size: aimed(rng, *features(rng, kind, size, count), float(size.max()))


@pytest.mark.parametrize("kind", [*SIZES, "plane"])
@pytest.mark.parametrize("name", PROCESSORS)
@quarter(24)
def test_one_solid_of_any_size_from_anywhere(name, kind, count):
    rng = np.random.default_rng(sum(map(ord, kind)))
    total = np.zeros(3, int)
    for n in range(count):
        size = np.exp(rng.uniform(np.log(LEAST_M), np.log(MOST_M), SIZES.get(kind, 3)))
        if rng.random() < 0.5:  # as long as wide, or almost
            size = np.clip(size[0] * rng.uniform(0.5, 2.0, len(size)), LEAST_M, MOST_M)
        if kind == "plane":
            size[:2] *= rng.random(2) < 0.7
        model = turned(rng, [Geom(kind, tuple(size))], far=n % 2)
        total += wrong_rays(name, model, at_features(rng, 400))
    assert_right(name, kind, *total)


@pytest.mark.parametrize("name", PROCESSORS)
@quarter(24)
def test_solids_that_share_surfaces(name, rng, count):
    """On a floor: faces in faces, balls and rounds that touch them, a twin, one inside another."""
    total = np.zeros(3, int)
    for n, scale in enumerate(np.geomspace(LEAST_M, MOST_M / 3, count)):
        geoms = [
            Geom(kind, tuple(scale * np.array(size)), tuple(scale * np.array(place)))
            for kind, size, place in (
                ("plane", (0, 0, 1), (0, 0, 0)),
                ("plane", (2, 1, 1), (0, 0, 0)),
                ("box", (1, 1, 0.5), (0, 0, 0.5)),
                ("box", (0.5, 1, 0.5), (1.5, 0, 0.5)),
                ("box", (0.5, 1, 0.5), (1.5, 0, 0.5)),
                ("cylinder", (0.5, 0.5), (0, 0, 1.5)),
                ("sphere", (0.5,), (0, -1.5, 0.5)),
                ("capsule", (0.5, 0.5), (0, 0, 1.5)),
                ("ellipsoid", (0.5, 0.3, 0.5), (0, 1.3, 0.5)),
            )
        ]
        total += wrong_rays(name, turned(rng, geoms, far=n % 2), at_features(rng, 100))
    assert_right(name, "many", *total)


@pytest.mark.parametrize("name", PROCESSORS)
@pytest.mark.parametrize("stray", [-9e-7, 4.9e-7, "float32"])
def test_units_to_a_millionth_give_the_metres_of_units(name, stray):
    """Balls of 3 cm up to 400 m away, each met head on."""
    rng = np.random.default_rng(8)
    rays, far = unit(rng.normal(size=(300, 3))), np.linspace(1.0, 400.0, 300)[:, None]
    short = unit(rays.astype(np.float32)).astype(np.float64)
    given = short if stray == "float32" else rays * (1 + stray)
    balls = [Geom("sphere", (0.03,), tuple(place)) for place in far * unit(given)]
    model = mujoco.MjModel.from_xml_string(reference.world_xml(balls))
    found = made(name, model).cast(np.zeros((1, 3)), given[None], 1e3)[0]
    assert_allclose(found, far[:, 0] - 0.03, rtol=0, atol=1e-8)


def random_mesh(rng, scale):
    """A bumpy closed surface, not convex."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    bumps = rng.uniform(0.5, 1.5, (len(ball.vertices), 1)) * rng.uniform(0.4, 1.2)
    vertices = reference.numbers((ball.vertices * bumps + rng.uniform(-1, 1, 3)).ravel())
    faces = " ".join(map(str, ball.faces.ravel()))
    return (
        f'<mesh name="m" inertia="shell" vertex="{vertices}" face="{faces}" '
        f'scale="{scale} {scale} {scale}"/>'
    )


@pytest.mark.parametrize("shape", ["mesh", "hfield"])
def test_no_ray_leaks_out_of_a_closed_surface(shape, rng):
    """From within, rays at its corners, at the middles of its edges, and anywhere on these, all
    meet it: small and large, near and 900 km from the world's origin."""
    cast = 0
    for scale, place in ((LEAST_M, 0.0), (1.0, 0.0), (1.0, 100.0), (1.0, FAR_M), (300.0, FAR_M)):
        mesh = random_mesh(rng, scale)
        turn = reference.numbers(reference.random_quaternion(rng))
        geom = f'<geom type="{shape}" {shape}="{shape[0]}" pos="{place} 0 0" quat="{turn}"/>'
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco><asset>{mesh}{HFIELD}</asset><worldbody>{geom}</worldbody></mujoco>"
        )
        solids = solids_of(model)
        assert solids.mesh_filled.all()
        a, b, c = np.moveaxis(solids.triangles, 1, 0)
        depth = 1e-3 * np.linalg.norm(b - a, axis=1, keepdims=True)
        below = (a + b + c) / 3 - depth * unit(np.cross(b - a, c - a))
        origins = below[rng.integers(0, len(a), 60)]
        share = np.concatenate([[0.0, 0.5], rng.random(3)])[:, None, None]
        edges = np.concatenate([share * u + (1 - share) * v for u, v in ((a, b), (b, c), (c, a))])
        rays = unit(edges.reshape(-1, 3) - origins[:, None])
        found = AnalyticEngine(solids).cast(origins, rays, np.inf)
        assert np.isfinite(found).all()
        cast += found.size
    assert cast >= 100_000
