"""Movers of drawn worlds: their courses against bounds, and against solids by dense sampling."""

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim import AnalyticEngine
from lidarsim.movers import find_piece
from lidarsim.parameters import MAX_LENGTH_M
from scenegen.draw.source import DrawnWorlds
from scenegen.worlds.courses import TICK_S, from_stop_to_stop, without_stop
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.movers import read_text
from scenegen.worlds.recipe import preset
from scenegen.worlds.traffic import KINDS, PERIOD_S, PRESETS, Traffic
from scenegen.worlds.world import with_movers
from tests.lidarsim.reference import unit
from tests.refusals import refuses
from tests.scenegen import each_case

LIMITS = {"person": (1.7, 1.0), "vehicle": (8.0, 2.0), "drone": (3.0, 3.0)}
"""Greatest speed and acceleration of the preset."""
STEP_S = 2.0**-7


def world_with_movers(kind, seed=0, traffic=PRESETS["light"]):
    recipe = preset(kind)
    world = DrawnWorlds(recipe).world("train", 0, rng=np.random.default_rng(seed))
    zones = recipe.mover_zones(world.flight_bounds)
    return with_movers(world, zones, traffic, seed=[seed], name=kind)


@pytest.fixture(scope="module", params=["pillar", "street", "rooms", "cave"])
def world(request):
    return world_with_movers(request.param)


@pytest.fixture(scope="module")
def motion(world):
    """Positions, headings, velocities and rates of turn (T, M, n) all through a period, STEP_S
    apart."""
    return motions(world.movers, np.arange(0, PERIOD_S, STEP_S))


def motions(movers, times_s):
    """The same at some times."""
    return [np.array(values) for values in zip(*map(movers.poses, times_s), strict=True)]


def test_speeds_accelerations_and_turns_keep_their_bounds(world, motion):
    _, _, velocity, turn = motion
    speed, acceleration = np.transpose([LIMITS[KINDS[kind - 1]] for kind in world.movers.kind])
    assert (np.linalg.norm(velocity, axis=2) <= speed * (1 + 1e-9)).all()
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=2) / STEP_S
    assert (change <= acceleration * (1 + 1e-6)).all()
    assert np.abs(turn).max() <= 2 * PRESETS["light"].turn_rad_s


def test_those_on_the_ground_have_ground_below_them(world, motion):
    place = motion[0][::64, world.movers.kind != 3].reshape(-1, 3)
    down = np.tile([0.0, 0.0, -1.0], (len(place), 1, 1))
    depth = world.caster(AnalyticEngine.of).cast(np.add(place, [0, 0, 0.1]), down, 10.0)[:, 0]
    # some kinds have no ground
    assert ((depth < 1.0) | (np.isinf(depth) & (place[:, 2] < 1.0))).all()


def test_courses_have_no_jumps(world):
    """Where one piece ends and the next one begins, the first after the last, too."""
    movers = world.movers
    begins = np.unique(movers.begin_s) + PERIOD_S
    (place, heading, *_), (before, heading_before, *_) = (
        motions(movers, times_s) for times_s in (begins, begins - 1e-9)
    )
    assert_allclose(place, before, atol=1e-7)
    assert_allclose(heading, heading_before, atol=1e-7)


def surface(shape, size, ways):
    """Points of a solid's surface, from its centre, in some directions."""
    if shape == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return size[0] * ways + np.outer(np.sign(ways[:, 2]), [0, 0, size[1]])
    if shape == mujoco.mjtGeom.mjGEOM_BOX:
        return size * ways / np.abs(ways).max(axis=1, keepdims=True)
    return size * ways


def test_movers_pass_through_no_solid(rng):
    """By rays from within them, which the certificate's cells and balls do not use."""
    world = world_with_movers("pillar", seed=3, traffic=PRESETS["dense"])
    caster = world.caster(AnalyticEngine.of)
    for time_s in rng.uniform(0, PERIOD_S, 20).tolist():
        solids = world.movers.solids(time_s)
        for n, (shape, size) in enumerate(zip(solids.shape, solids.size, strict=True)):
            ways = unit(rng.normal(size=(60, 3)))
            points = surface(shape, size, ways) @ solids.rotation[n].T
            points = points[points[:, 2] + solids.position[n, 2] > 0.1]  # above the ground
            reach = np.linalg.norm(points, axis=1)
            ranges = caster.cast(solids.position[n, None], unit(points)[None], 10.0)[0]
            assert (ranges > reach).all()


def test_movers_do_not_meet():
    movers = world_with_movers("street", traffic=PRESETS["dense"]).movers
    place, *_ = motions(movers, np.arange(0, PERIOD_S, 0.05))
    radius = np.array([movers.size[movers.owner == m][:, :2].min() for m in range(len(movers))])
    gaps = np.linalg.norm(place[:, :, None] - place[:, None], axis=3).min(axis=0)
    assert (gaps + np.diag([np.inf] * len(movers)) > radius[:, None] + radius).all()


@pytest.mark.parametrize("kind", kind_names())
def test_every_kind_has_room_for_movers(kind):
    movers, belonging = world_with_movers(kind).movers, preset(kind).world.movers
    for number, name in enumerate(KINDS, start=1):
        low, high = PRESETS["light"].counts(name)
        least = 0 if name == "vehicle" and name not in belonging else low
        assert least <= (movers.kind == number).sum() <= high


SQUARE = np.array([[0.0, 0, 1], [4, 0, 1], [4, 4, 1], [0, 4, 1]])


def test_a_loop_runs_at_one_speed_but_for_corners():
    """Whose pieces meet where corners differ, too."""
    course = without_stop(np.insert(SQUARE, 3, [2, 5, 1], axis=0), 2.0, 1.5, 3.0)
    assert course.begin_s[0] == 0
    assert (course.begin_s / TICK_S % 1 == 0).all()
    start, linear, square, _ = np.moveaxis(course.pieces[:, :3], 2, 0)
    speeds = np.linalg.norm(linear, axis=1)
    assert_allclose(speeds, speeds[0], rtol=1e-3)
    lasting = np.diff(course.begin_s, append=PERIOD_S)[:, None]
    ends = start + lasting * (linear + lasting * square)
    assert_allclose(ends, np.roll(start, -1, axis=0), atol=1e-9)


def test_a_course_that_begins_later_goes_the_same_way():
    course = from_stop_to_stop(SQUARE, 2.0, 1.5, 3.0, [0.0] * 4)
    later = course.begun_at(9001).table  # within a piece
    for time_s in np.arange(0, 22, 0.37):
        expected = find_piece(0, time_s + 9001 * TICK_S, course.table)[2:]
        assert_allclose(find_piece(0, time_s, later)[2:], expected, atol=1e-9)


def test_movers_do_not_stand_together(motion):
    """Tours begin at rest, and movers somewhere on them."""
    speed = np.linalg.norm(motion[2], axis=2).mean(axis=1)
    assert speed[: int(2 / STEP_S)].mean() > speed.mean() / 2


@pytest.mark.parametrize("bend_m", [1e-6, 1e-3, 0.02])
def test_slight_turns_fit_into_tables(bend_m):
    bent = np.array([[0.0, 0, 1], [2, 0, 1], [4, bend_m, 1], [6, 0, 1]])
    course = from_stop_to_stop(bent, 2.0, 1.5, 10.0, [0.0] * 4)
    assert np.abs(course.pieces).max() <= MAX_LENGTH_M


@each_case("worlds/tours", "numbers why")
def test_tours_that_do_not_fit_give_no_course(numbers, why):
    """Of a speed, an acceleration and a rate of turn."""
    assert without_stop(SQUARE, *map(float, numbers.split())) is None, why


def test_a_way_that_takes_longer_than_a_period_gives_no_course():
    assert from_stop_to_stop(SQUARE, 0.2, 1.0, 1.0, [0.0] * 4) is None


@each_case("worlds/movers", "damage text")
def test_damaged_tables_are_refused_in_a_line(damage, text):
    """The heading through zero is 1 - t / 32, which would be 0 at the end of the period."""
    refuses(damage, read_text, text, error=ValueError)


def test_more_movers_than_tables_hold_are_refused():
    with pytest.raises(ValueError, match="at most"):
        Traffic(people=(20, 24), drones=(1, 2))
