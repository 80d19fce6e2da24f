"""Movers of drawn worlds: their courses against bounds, and against solids by dense sampling."""

import dataclasses

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import AnalyticEngine
from lidarsim.parameters import MAX_LENGTH_M
from scenegen.draw.source import DrawnWorlds
from scenegen.truth.shapes import distance
from scenegen.worlds.courses import TICK_S, from_stop_to_stop, without_stop
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.movers import read_text
from scenegen.worlds.recipe import preset
from scenegen.worlds.traffic import KINDS, PERIOD_S, PRESETS, Traffic
from scenegen.worlds.world import compile_world, populated
from tests.refusals import refuses

LIMITS = {"person": (1.7, 1.0), "vehicle": (8.0, 2.0), "drone": (3.0, 3.0)}
"""Greatest speed and acceleration of the preset."""


def world_with_movers(kind, seed=0, traffic=PRESETS["light"]):
    recipe = preset(kind)
    world = DrawnWorlds(recipe).world("train", 0, rng=np.random.default_rng(seed))
    zones = recipe.world.mover_zones(world.flight_bounds)
    for attempt in range(20):
        found = populated(world, zones, traffic, rng=np.random.default_rng([seed, attempt]))
        if found is not None:
            return found
    raise AssertionError("no movers in twenty draws")


@pytest.fixture(scope="module", params=["pillar", "street", "rooms", "cave"])
def world(request):
    return world_with_movers(request.param)


def motions(movers, times_s):
    """Positions, headings and velocities (T, M, n) at times."""
    return (np.array(values) for values in zip(*map(movers.poses, times_s), strict=True))


def test_speeds_and_accelerations_keep_their_bounds(world):
    step_s = 2.0**-7
    times_s = np.arange(0, PERIOD_S, step_s)
    _, _, velocity, _ = motions(world.movers, times_s)
    for m, kind in enumerate(world.movers.kind):
        speed, acceleration = LIMITS[KINDS[kind - 1]]
        assert np.linalg.norm(velocity[:, m], axis=1).max() <= speed * (1 + 1e-9)
        change = np.diff(velocity[:, m], axis=0) / step_s
        assert np.linalg.norm(change, axis=1).max() <= acceleration * (1 + 1e-6)


def test_turns_keep_their_rate(world):
    times_s = np.arange(0, PERIOD_S, 2.0**-7)
    _, _, _, turn = motions(world.movers, times_s)
    assert np.abs(turn).max() <= 2 * PRESETS["light"].turn_rad_s


def test_those_on_the_ground_have_ground_below_them(world):
    movers = world.movers
    caster, down = world.caster(AnalyticEngine.of), np.array([[[0.0, 0.0, -1.0]]])
    for time_s in np.linspace(0, PERIOD_S, 60):
        position, _, _, _ = movers.poses(time_s)
        for place in position[movers.kind != 3]:
            depth = caster.cast(place[None] + [[0, 0, 0.1]], down, 10.0)[0, 0]
            # some kinds have no ground
            assert depth < 1.0 or (np.isinf(depth) and place[2] < 1.0)


def test_courses_have_no_jumps(world):
    step_s = TICK_S
    times_s = np.arange(0, PERIOD_S + 1.0, step_s)
    position, heading, velocity, _ = motions(world.movers, times_s)
    middle = (velocity[1:] + velocity[:-1]) / 2 * step_s
    assert_allclose(np.diff(position, axis=0), middle, atol=2e-5)
    assert np.abs(np.diff(heading, axis=0)).max() < 0.02


def surface_points(movers, solid, rng):
    """Random points of a solid's surface, in the mover's frame."""
    ways = rng.normal(size=(60, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    size = movers.size[solid]
    if movers.shape[solid] == mujoco.mjtGeom.mjGEOM_CAPSULE:
        ends = np.array([0, 0, size[1]]) * np.sign(ways[:, 2:])
        return movers.offset[solid] + size[0] * ways + ends
    if movers.shape[solid] == mujoco.mjtGeom.mjGEOM_BOX:
        return movers.offset[solid] + size * ways / np.abs(ways).max(axis=1, keepdims=True)
    return movers.offset[solid] + size * ways


def test_movers_pass_through_no_solid():
    """By distances to every primitive, which the certificate's cells and balls do not use."""
    world, rng = (
        world_with_movers("pillar", seed=3, traffic=PRESETS["dense"]),
        np.random.default_rng(0),
    )
    movers, solids = world.movers, world.solids
    for time_s in rng.uniform(0, PERIOD_S, 20).tolist():
        position, heading, _, _ = movers.poses(time_s)
        for solid, m in enumerate(movers.owner):
            (x, y), points = heading[m], surface_points(movers, solid, rng)
            turned = points @ np.array([[x, y, 0], [-y, x, 0], [0, 0, 1]])
            for point in position[m] + turned:
                gaps = [
                    distance(shape, size, *(rotation.T @ (point - centre)))
                    for shape, size, centre, rotation in zip(
                        solids.shape, solids.size, solids.position, solids.rotation, strict=True
                    )
                    if np.abs(point[:2] - centre[:2]).max() < 3.0
                ]
                assert min(gaps, default=1.0) > 0.0


def test_movers_do_not_meet():
    movers = world_with_movers("street", traffic=PRESETS["dense"]).movers
    times_s = np.arange(0, PERIOD_S, 0.05)
    position, _, _, _ = motions(movers, times_s)
    radius = np.array([movers.size[movers.owner == m][:, :2].min() for m in range(len(movers))])
    for first in range(len(movers)):
        for second in range(first):
            gap = np.linalg.norm(position[:, first] - position[:, second], axis=1).min()
            assert gap > radius[first] + radius[second]


@pytest.mark.parametrize("kind", kind_names())
def test_every_kind_has_room_for_movers(kind):
    movers = world_with_movers(kind).movers
    counts = [int((movers.kind == 1 + n).sum()) for n in range(len(KINDS))]
    bounds = [PRESETS["light"].counts(name) for name in KINDS]
    vehicles = "vehicle" in preset(kind).world.movers
    for name, count, (low, high) in zip(KINDS, counts, bounds, strict=True):
        assert (low if name != "vehicle" or vehicles else 0) <= count <= high


def test_documents_keep_movers_to_the_bit(world):
    again = compile_world(world.mjcf, world.assets).movers
    for field in dataclasses.fields(again):
        assert_array_equal(getattr(again, field.name), getattr(world.movers, field.name))


SQUARE = np.array([[0.0, 0, 1], [4, 0, 1], [4, 4, 1], [0, 4, 1]])


def test_a_loop_runs_at_one_speed_but_for_corners():
    course = without_stop(SQUARE, 2.0, 1.5, 3.0)
    assert course.begin_s[0] == 0
    assert (course.begin_s / TICK_S % 1 == 0).all()
    speeds = np.linalg.norm(course.pieces[:, :3, 1], axis=1)
    assert_allclose(speeds, speeds[0], rtol=1e-3)


@pytest.mark.parametrize("bend_m", [1e-6, 1e-3, 0.02])
def test_slight_turns_fit_into_tables(bend_m):
    bent = np.array([[0.0, 0, 1], [2, 0, 1], [4, bend_m, 1], [6, 0, 1]])
    course = from_stop_to_stop(bent, 2.0, 1.5, 10.0, [0.0] * 4)
    assert np.abs(course.pieces).max() <= MAX_LENGTH_M


@pytest.mark.parametrize(
    "course",
    [
        lambda: without_stop(SQUARE, 0.1, 1.0, 3.0),  # slower than a round in a period
        lambda: without_stop(SQUARE, 4.0, 0.5, 3.0),  # corners longer than legs
        lambda: without_stop(SQUARE, 4.0, 9.0, 0.2),  # turns slower than legs last
        lambda: from_stop_to_stop(SQUARE, 0.2, 1.0, 1.0, [0.0] * 4),
    ],
)
def test_tours_that_do_not_fit_give_no_course(course):
    assert course() is None


DAMAGES = {
    "no table": "{}",
    "no json": "{",
    "another period": '{"period_s":7,"movers":[]}',
    "an unknown kind": '{"period_s":32,"movers":[{"kind":"cat","solids":[],"begin_s":[],'
    '"course":[]}]}',
    "a plane": '{"period_s":32,"movers":[{"kind":"drone","solids":[[0,1,1,1,0,0,0]],'
    '"begin_s":[0],"course":[[0,0,0,0,0,0,0,0,0,0,0,0,1,0,0,0,0,0,0,0]]}]}',
    "not a number": '{"period_s":32,"movers":[{"kind":"drone","solids":[[4,1,1,NaN,0,0,0]],'
    '"begin_s":[0],"course":[[0,0,0,0,0,0,0,0,0,0,0,0,1,0,0,0,0,0,0,0]]}]}',
    "no course": '{"period_s":32,"movers":[{"kind":"drone","solids":[[4,1,1,1,0,0,0]],'
    '"begin_s":[],"course":[]}]}',
    "falling times": '{"period_s":32,"movers":[{"kind":"drone","solids":[[4,1,1,1,0,0,0]],'
    '"begin_s":[0,0],"course":[[0,0,0,0,0,0,0,0,0,0,0,0,1,0,0,0,0,0,0,0],'
    "[0,0,0,0,0,0,0,0,0,0,0,0,1,0,0,0,0,0,0,0]]}]}",
    # 1 - t / 32 would be 0 at the end of the period
    "a heading through zero": '{"period_s":32,"movers":[{"kind":"drone",'
    '"solids":[[4,1,1,1,0,0,0]],"begin_s":[0],'
    '"course":[[0,0,0,0,0,0,0,0,0,0,0,0,1,-0.03125,0,0,0,0,0,0]]}]}',
    "a cubic place": '{"period_s":32,"movers":[{"kind":"drone","solids":[[4,1,1,1,0,0,0]],'
    '"begin_s":[0],"course":[[0,0,0,0.01,0,0,0,0,0,0,0,0,1,0,0,0,0,0,0,0]]}]}',
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_tables_are_refused_in_a_line(damage):
    refuses(damage, read_text, DAMAGES[damage], error=ValueError)


def test_more_movers_than_tables_hold_are_refused():
    with pytest.raises(ValueError, match="at most"):
        Traffic(people=(20, 24), drones=(1, 2))
