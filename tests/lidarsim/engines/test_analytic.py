"""Closed forms, against arithmetic that needs none and against MuJoCo's function for one ray."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import AnalyticEngine, Lidar, MujocoEngine
from lidarsim.engines import analytic
from lidarsim.solids import solids_of
from tests.lidarsim.engines.test_laws import data_of, from_mujoco, random_model, random_rays
from tests.lidarsim.reference import unit


def assert_same(actual, expected, pose=slice(None)):
    """Hits of a pose, to the bit."""
    for name in ("ranges", "geoms", "points", "normals"):
        values = getattr(expected, name)
        assert_array_equal(getattr(actual, name)[pose].reshape(values.shape), values)


def calls_of(name, monkeypatch):
    """The arguments of every call of a function of the engine's module, from now on."""
    function, calls = getattr(analytic, name), []
    monkeypatch.setattr(analytic, name, lambda *given: calls.append(given) or function(*given))
    return calls


@pytest.mark.parametrize("seed", range(4))
def test_hits_are_mujocos(seed):
    """Geoms, points and normals, of every shape at any attitude; and ranges, those of the engine
    of MuJoCo's many-ray function too."""
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    origins, rays = random_rays(rng, 4, 2000)
    data = data_of(model)
    hits = AnalyticEngine.of(model).hits(origins, rays, 1e7)
    for p in range(2):
        few = rays[p, :300]
        ranges, geoms, normals = from_mujoco(model, data, origins[p], few)
        seen = np.where(np.isfinite(ranges), ranges, np.nan)[:, None]
        assert_array_equal(hits.geoms[p, :300], geoms)
        assert_allclose(hits.ranges[p, :300], ranges, rtol=0, atol=1e-6)
        assert_allclose(hits.points[p, :300], origins[p] + seen * few, atol=1e-6)
        assert_allclose(hits.normals[p, :300], normals, rtol=0, atol=1e-5)
    for reach in (6.0, 12.0):
        within = np.where(hits.ranges <= reach, hits.ranges, np.inf)
        assert 100 < np.isfinite(within).sum() < within.size - 100
        for engine in (MujocoEngine, AnalyticEngine):
            ranges = engine.of(model).cast(origins, rays, reach)
            assert_allclose(ranges, within, rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_rays_in_packets_meet_what_each_meets_alone(seed):
    """To the bit: neighbours in a sensor's shape, in a row, apart, and along the axes."""
    rng = np.random.default_rng(seed)
    engine = AnalyticEngine.of(random_model(rng))
    origins, _ = random_rays(rng, 2, 1)
    rays = Lidar(rows=17, columns=120, pitch_deg=0.0).directions_body
    rays = unit(np.where(np.arange(17)[:, None, None] == 8, rays.round(9), rays))
    for order in (slice(None), rng.permutation(rays.size // 3)):  # neighbours, and far apart
        row = rays.reshape(-1, 3)[order]
        both = np.broadcast_to(row.reshape(rays.shape), (2, *rays.shape))
        together = engine.hits(origins, both, 30.0)
        for p in range(2):
            starts = np.broadcast_to(origins[p], row.shape)
            assert_same(together, engine.hits(starts, row[:, None], 30.0), p)
    assert np.isfinite(together.ranges).mean() > 0.2


def test_what_was_cast_is_met_again_without_a_walk(monkeypatch, rng):
    """As a new engine meets it, until solids move, or other rays are asked for."""
    solids = solids_of(random_model(rng))
    parts = np.arange(len(solids)) % 2
    origins, rays = random_rays(rng, 3, 300)
    engine, walks = AnalyticEngine(solids, parts=parts), calls_of("traverse", monkeypatch)

    def walked(pose, reach=12.0, through=-1):
        """How many walks hits take, which are a new engine's."""
        query = origins[pose : pose + 1], rays[pose : pose + 1], reach
        expected = AnalyticEngine(solids, parts=parts).hits(*query, through=[through])
        walks.clear()
        assert_same(engine.hits(*query, through=[through]), expected)
        return len(walks)

    engine.nearest(origins, rays, 12.0, through=[-1, 0, 1])[0][:] = -7.0  # a copy
    assert [walked(2, through=1), walked(0), walked(1, through=0)] == [0, 0, 0]
    assert walked(1, through=1) == 1
    engine.cast(origins, rays, 12.0)
    assert walked(1, 5.0) == 1
    origins[1] += 1e-9
    assert [walked(1, 5.0), walked(1, 5.0)] == [1, 0]
    places = ("position", "lower", "upper", "triangles")
    solids = replace(solids, **{name: getattr(solids, name) + 0.5 for name in places})
    engine.move(solids)
    assert walked(1, 5.0) == 1
    monkeypatch.setattr(analytic, "MAX_KEPT", 100)
    engine.cast(origins, rays, 12.0)
    assert walked(0) == 1


def test_threads_share_poses_and_change_nothing(monkeypatch, rng):
    solids = solids_of(random_model(rng))
    origins, rays = random_rays(rng, 7, 300)
    alone = AnalyticEngine(solids, threads=1).cast(origins, rays, 12.0)
    monkeypatch.setattr(analytic, "RAYS_A_THREAD", 100)
    pools = calls_of("ThreadPoolExecutor", monkeypatch)
    assert_array_equal(AnalyticEngine(solids, threads=3).cast(origins, rays, 12.0), alone)
    AnalyticEngine(solids, threads=3).cast(origins[:1], rays[:1], 12.0)
    assert pools == [(3,)]  # none for one pose
