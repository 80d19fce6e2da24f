"""Closed forms, against arithmetic that needs none and against MuJoCo's function for one ray."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import AnalyticEngine, MujocoEngine
from lidarsim.engines import analytic
from lidarsim.solids import solids_of
from tests.lidarsim.engines.test_laws import from_mujoco, model_of, random_model, random_rays
from tests.lidarsim.reference import unit
from tests.refusals import refuses


def assert_same(found, expected, pose):
    """Hits of a pose, to the bit."""
    for name in ("ranges", "geoms", "points", "normals"):
        one, other = getattr(found, name)[pose], getattr(expected, name)
        assert_array_equal(one.reshape(other.shape), other)


@pytest.mark.parametrize("seed", range(4))
def test_hits_are_mujocos(seed):
    """Geoms, points and normals, of every shape at any attitude; and ranges, those of the engine
    of MuJoCo's many-ray function too."""
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    origins, rays = random_rays(rng, 4, 2000)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hits = AnalyticEngine.of(model).hits(origins, rays, 1e7)
    for p in range(2):
        first = slice(300)
        ranges, geoms, normals = from_mujoco(model, data, origins[p], rays[p, first])
        assert_array_equal(hits.geoms[p, first], geoms)
        assert_allclose(hits.ranges[p, first], ranges, rtol=0, atol=1e-6)
        seen = np.isfinite(ranges)
        points = (origins[p] + ranges[:, None] * rays[p, first])[seen]
        assert_allclose(hits.points[p, first][seen], points, atol=1e-6)
        assert_allclose(hits.normals[p, first], normals, rtol=0, atol=1e-5)
        assert np.isnan(hits.points[p, first][~seen]).all()
    for reach in (6.0, 12.0):
        within = np.where(hits.ranges <= reach, hits.ranges, np.inf)
        assert 100 < np.isfinite(within).sum() < within.size - 100
        for engine in (MujocoEngine, AnalyticEngine):
            found = engine.of(model).cast(origins, rays, reach)
            assert_allclose(found, within, rtol=0, atol=1e-6)


def test_an_empty_world_and_a_crowded_one():
    ray = [[[1.0, 0.0, 0.0]]]
    assert AnalyticEngine.of(model_of()).hits([[0.0, 0.0, 0.0]], ray, 10.0).geoms == -1
    one = solids_of(model_of('type="sphere" size="1" pos="5 0 0"'))
    many = 100_000
    fields = ("shape", "size", "position", "rotation", "lower", "upper")
    crowd = replace(
        one,
        **{name: np.repeat(getattr(one, name), many, axis=0) for name in fields},
        geom=np.arange(many),
    )
    hits = AnalyticEngine(crowd).hits([[0.0, 0.0, 0.0]], ray, 10.0)
    assert hits.ranges == 4.0
    assert hits.geoms == 0  # the first of those that are as near
    refuses("a crowd in place of one", AnalyticEngine(one).move, crowd)


@pytest.mark.parametrize("seed", range(2))
def test_rays_in_packets_meet_what_each_meets_alone(seed):
    """To the bit: neighbours in a sensor's shape, in a row, apart, and along the axes."""
    rng = np.random.default_rng(seed)
    engine = AnalyticEngine.of(random_model(rng))
    origins, _ = random_rays(rng, 2, 1)
    yaw, pitch = np.meshgrid(np.linspace(-np.pi, np.pi, 121)[:-1], np.linspace(-0.5, 0.5, 17))
    level = np.cos(pitch)
    rays = np.stack([level * np.cos(yaw), level * np.sin(yaw), np.sin(pitch)], axis=-1)
    rays[8] = rays[8].round(9)  # some of its slopes are 0
    rays = unit(rays)
    for order in (slice(None), rng.permutation(rays.size // 3)):  # neighbours, and far apart
        shown = rays.reshape(-1, 3)[order]
        both = np.broadcast_to(shown.reshape(rays.shape), (2, *rays.shape))
        together = engine.hits(origins, both, 30.0)
        for p in range(2):
            starts = np.broadcast_to(origins[p], shown.shape)
            assert_same(together, engine.hits(starts, shown[:, None], 30.0), p)
    assert np.isfinite(together.ranges).mean() > 0.2


def test_what_was_cast_is_met_again_without_a_walk(monkeypatch, rng):
    """As a new engine meets it, until solids move, or other rays are asked for."""
    solids = solids_of(random_model(rng))
    parts = np.arange(len(solids)) % 2
    origins, rays = random_rays(rng, 3, 300)
    engine, walks = AnalyticEngine(solids, parts=parts), []
    walk = analytic.traverse
    monkeypatch.setattr(analytic, "traverse", lambda *given: walks.append(0) or walk(*given))

    def same(pose, reach, through, solids, number):
        """Whether hits are a new engine's, and how many walks that takes."""
        asked = origins[pose : pose + 1], rays[pose : pose + 1], reach
        expected = AnalyticEngine(solids, parts=parts).hits(*asked, through=[through])
        walks.clear()
        hits = engine.hits(*asked, through=[through])
        assert_same(hits, expected, slice(None))
        assert len(walks) == number

    engine.nearest(origins, rays, 12.0, through=[-1, 0, 1])[0][:] = -7.0  # a copy
    for pose, through in ((2, 1), (0, -1), (1, 0)):
        same(pose, 12.0, through, solids, 0)
    same(1, 12.0, 1, solids, 1)
    engine.cast(origins, rays, 12.0)
    same(1, 5.0, -1, solids, 1)
    origins[1] += 1e-9
    same(1, 5.0, -1, solids, 1)
    same(1, 5.0, -1, solids, 0)
    moved = replace(
        solids,
        position=solids.position + 0.5,
        lower=solids.lower + 0.5,
        upper=solids.upper + 0.5,
        triangles=solids.triangles + 0.5,
    )
    engine.move(moved)
    same(1, 5.0, -1, moved, 1)
    monkeypatch.setattr(analytic, "MAX_KEPT", 100)
    engine.cast(origins, rays, 12.0)
    same(0, 12.0, -1, moved, 1)


def test_threads_share_poses_and_change_nothing(monkeypatch, rng):
    solids = solids_of(random_model(rng))
    origins, rays = random_rays(rng, 7, 300)
    alone = AnalyticEngine(solids, threads=1).cast(origins, rays, 12.0)
    monkeypatch.setattr(analytic, "RAYS_A_THREAD", 100)
    pools = []
    monkeypatch.setattr(
        analytic, "ThreadPoolExecutor", lambda n: pools.append(n) or ThreadPoolExecutor(n)
    )
    assert_array_equal(AnalyticEngine(solids, threads=3).cast(origins, rays, 12.0), alone)
    AnalyticEngine(solids, threads=3).cast(origins[:1], rays[:1], 12.0)
    assert pools == [3]  # none for one pose
