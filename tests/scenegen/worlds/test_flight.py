"""Laws of flights: they keep the clearance and the bounds, end in bounded work, and are looked
along by viewpoints."""

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim.solids import solids_of
from scenegen.worlds.clearance import Clearance
from scenegen.worlds.flight import FlightConfig, plan_flight, viewpoints
from tests.refusals import refuses
from tests.scenegen.truth.reference import Shape, world_of

BOUNDS = np.array([[1.0, 1.0, 0.5], [15.0, 13.0, 3.5]])
FLIGHT = FlightConfig(robot_radius_m=0.4, min_distance_m=5.0, step_m=2.0, iterations=1000)
DIAGONAL_M = float(np.linalg.norm(BOUNDS[1] - BOUNDS[0]))


def forest(seed):
    """Round columns that reach from floor to ceiling: x, y and radius (n, 3), and the clearance
    around them."""
    columns = np.random.default_rng(seed).uniform([0.0, 0.0, 0.2], [16.0, 14.0, 0.6], (30, 3))
    shapes = [Shape("cylinder", (radius, 5, 0)).at([x, y, 2]) for x, y, radius in columns]
    return columns, Clearance(solids_of(world_of(*shapes)), BOUNDS)


def plan(clearance, flight, seed):
    """A path within the bounds of a world with this clearance."""
    world = SimpleNamespace(clearance=clearance, room=lambda *_, rng: BOUNDS)
    return plan_flight(world, flight, rng=np.random.default_rng(seed))


def test_flights_keep_clearance_bounds_and_step():
    tight, ends = [], []
    for seed in range(12):
        columns, clearance = forest(seed)
        path = plan(clearance, FLIGHT, seed)
        if path is None:
            continue
        assert ((path >= BOUNDS[0]) & (path <= BOUNDS[1])).all()
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= FLIGHT.step_m + 1e-9
        points = np.concatenate([np.linspace(*pair, 2000) for pair in itertools.pairwise(path)])
        apart = np.linalg.norm(points[:, None, :2] - columns[:, :2], axis=2) - columns[:, 2]
        tight.append(apart.min())
        ends += [path[0], path[-1]]
    assert len(tight) >= 8
    # else no flight passes close to a column
    assert FLIGHT.robot_radius_m - 2e-3 <= min(tight) < FLIGHT.robot_radius_m + 0.1
    assert (np.ptp(ends, axis=0) > 0.6 * (BOUNDS[1] - BOUNDS[0])).all()


@pytest.mark.parametrize(("asked_m", "least_m"), [(1.0, 1.0), (4.0, 4.0), (1e3, DIAGONAL_M / 3)])
def test_start_and_goal_are_the_least_distance_apart(asked_m, least_m):
    """Or a third of the diagonal."""
    _, clearance = forest(0)
    flight = dataclasses.replace(FLIGHT, min_distance_m=asked_m)
    paths = [plan(clearance, flight, seed) for seed in range(60)]
    lengths = [np.linalg.norm(path[-1] - path[0]) for path in paths if path is not None]
    assert len(lengths) > 40
    assert least_m - FLIGHT.goal_tolerance_m <= min(lengths) < least_m + 1.5


CORNERS = "0 0 0, 0 0 2, 3 0 2, 3 4 2, 3 4 5, 3 4 3, 3 1 7, 3 1 8, -2 -4 8"
PATH = np.loadtxt(CORNERS.split(","))
"""Climbs at once, turns left, climbs and sinks in between, turns back while climbing, climbs, and
leaves to the south west."""


@pytest.mark.parametrize("spacing", [0.25, 1.0, 1.7])
def test_viewpoints_lie_on_the_path(spacing):
    """A spacing apart, in an order that the generator decides."""
    ends = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(PATH, axis=0), axis=1)))
    firsts, orders = [], set()
    for seed in range(20):
        (route, views), (_, again) = (
            viewpoints(PATH, spacing, rng=np.random.default_rng(seed)) for _ in "12"
        )
        assert_array_equal(views, again)
        orders.add(tuple(np.argsort(views)))
        flown = np.sort(views)
        firsts.append(flown[0])
        assert_allclose(np.diff(flown), spacing, rtol=0, atol=1e-9)
        assert 0 <= flown[0] < spacing
        assert ends[-1] - spacing <= flown[-1] < ends[-1]
        expected = np.transpose([np.interp(views, ends, along) for along in PATH.T])
        assert_allclose(route.at(views)[0], expected, rtol=0, atol=1e-9)
    assert np.ptp(firsts) > 0.5 * spacing
    assert len(orders) == 20


BAD = itertools.product(FlightConfig.__dataclass_fields__, (-1e9, math.nan, True, (3.0, 1.0)))


@pytest.mark.parametrize(
    ("name", "value"), [*BAD, ("altitude_m", (2.0, 2.0)), ("robot_radius_m", 1.0)]
)
def test_a_bad_value_is_named(name, value):
    assert refuses(f"{name} {value}", FlightConfig, **{name: value}).startswith(f"{name} = ")


def test_margin_and_altitudes_bound_flights():
    flight = FlightConfig(margin_m=3.0, altitude_m=(1.0, 4.0))
    assert_array_equal(flight.bounds((20.0, 12.0, 9.0)), [[3, 3, 1], [17, 9, 4]])
    for size in ((6.0, 12.0, 9.0), (20.0, 5.9, 9.0)):
        refuses(size, flight.bounds, size)


def test_a_flight_of_too_many_places_is_refused(rng):
    """Before they take memory."""
    refuses("a million", viewpoints, np.diag([1e6, 0, 0])[:2], 0.001, rng=rng)
