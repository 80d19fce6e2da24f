"""Robots among movers: who predicts where a person goes keeps away; braking keeps its promise."""

from dataclasses import replace

import numpy as np
import pytest

from lidarsim.movers import Movers
from lidarsim.solids import CAPSULE
from scenegen.fly import Rules, Vehicle
from scenegen.fly.course import Course
from scenegen.fly.loop import fly
from scenegen.fly.missions import Mission
from scenegen.fly.simulation import Simulation
from scenegen.model.completion.protocol import Prediction, Returns
from scenegen.model.robots import FORESEEING, robot_name, split_robot_name
from scenegen.model.robots.avoiding import TrackingRobot, TruthAmongMovers
from scenegen.model.robots.flights import robot_maker
from scenegen.model.robots.mapping import MappingRobot, TruthRobot
from scenegen.model.robots.steering import stopping_m, stopping_mps
from scenegen.worlds.tables import named_lidar
from scenegen.worlds.world import compile_world

HALL = compile_world(b"""<mujoco>
<custom><numeric name="flight_bounds" data="-5.5 -5.5 0.5 5.5 5.5 1.6"/></custom>
<worldbody><geom type="plane" size="0 0 1"/>
<geom type="box" pos="-6 0 1" size=".1 6 1"/><geom type="box" pos="6 0 1" size=".1 6 1"/>
<geom type="box" pos="0 6 1" size="6 .1 1"/><geom type="box" pos="0 -6 1" size="6 .1 1"/>
</worldbody></mujoco>""")
BOUNDS = ((-5.5, -5.5, 0.5), (5.5, 5.5, 1.6))


def with_person(speed):
    """The hall, and a person who crosses its middle line after two seconds."""
    course = np.zeros((2, 5, 4))
    course[0, 1, :2] = -2 * speed, speed
    course[1, 1, :2] = 2 * speed, -speed
    course[:, 3, 0] = 1.0
    person = Movers(
        kind=np.array([1]),
        owner=np.array([0]),
        shape=np.array([CAPSULE]),
        size=np.array([[0.25, 0.6, 0.0]]),
        offset=np.array([[0.0, 0.0, 0.9]]),
        piece_start=np.array([0, 2]),
        begin_s=np.array([0.0, 4.0]),
        course=course,
        period_s=8.0,
    )
    return replace(HALL, movers=person)


def crossing(world, start, **vehicle):
    """A flight along the middle line."""
    mission = Mission(start=(start, 0.0, 1.0), goal=(4.0, 0.0, 1.0), shortest_m=8.0, bounds=BOUNDS)
    vehicle = Vehicle(radius_m=0.2, **vehicle)
    sensor, rules = named_lidar("raster"), Rules(patience=20)
    return Simulation(world, mission, sensor=sensor, vehicle=vehicle, rules=rules)


def test_who_predicts_keeps_away_from_who_crosses():
    """Others are struck in some of these flights, and come nearer in all of them together."""
    least = dict[str, list[float]]()
    for speed in (1.5, 2.5):
        world = with_person(speed)
        robots = {
            "optimistic": MappingRobot(Returns()),
            "predicting": TrackingRobot(predicts=True),
            "truth": TruthAmongMovers(world, predicts=False),
            FORESEEING: TruthAmongMovers(world, predicts=True),
        }
        for name, robot in robots.items():
            for start in (-4.0, -3.0):
                flown = fly(crossing(world, start), robot)
                least.setdefault(name, []).append(flown.min_clearance_m)
                assert flown.outcome in ("success", "struck")
    radius = 0.2
    assert min(least["predicting"]) > 2 * radius - 1e-6
    assert min(least[FORESEEING]) > 1.5 * radius
    for name in ("optimistic", "truth"):
        assert min(least[name]) <= radius + 1e-3


def test_what_moved_on_is_forgotten():
    world = with_person(1.5)
    robots = MappingRobot(Returns()), TrackingRobot(predicts=False)
    held = []
    for robot in robots:
        flying = crossing(world, -3.0)
        robot.reset(flying.about())
        for _ in range(60):
            robot.act(flying.observe())
            flying.step(np.zeros(4, np.float32))
        taken = np.argwhere(robot.taken()) * 0.2 + robot._start + 0.1
        trail = (np.abs(taken[:, 0]) < 0.4) & (np.abs(taken[:, 1]) < 4) & (taken[:, 2] < 1.4)
        held.append(np.count_nonzero(trail))
    remembered, forgotten = held
    assert remembered > 30 > 3 * forgotten


@pytest.mark.parametrize("name", ["truth", FORESEEING])
def test_who_knows_a_world_without_movers_plans_by_it_alone(name):
    robot = robot_maker(name, None)(Course(world="pillar", flights=1))
    assert type(robot) is TruthRobot


def test_braking_keeps_the_stopping_distance():
    facts = {"acceleration_mps2": 4.0, "jerk_mps3": 30.0, "latency_s": 0.05}
    about = {name: np.array(value) for name, value in facts.items()}
    for length in (0.7, 1.5, 6.0):
        assert stopping_m(stopping_mps(length, about), about) == pytest.approx(length)
    assert stopping_mps(-1.0, about) == 0.25


def test_a_robot_that_brakes_could_stop_before_what_it_has_not_seen(monkeypatch):
    """Nothing is seen beyond x = 0."""
    fastest = []
    for brakes in (None, 0.0):
        robot = MappingRobot(Returns(), brakes=brakes)
        monkeypatch.setattr(robot, "_known_at", lambda points: points[:, 0] < 0)
        flying = crossing(HALL, -4.0, speed_mps=4.0)
        fly(flying, robot)
        states = np.concatenate(flying.states)
        before = states[states[:, 0] < 0]
        speed = np.linalg.norm(before[:, 3:6], axis=1)
        # at once, at its full acceleration
        needed = 0.1 * speed + speed**2 / (2 * 4.0)
        fastest.append((needed + before[:, 0]).max())
    assert fastest[0] > 0.5
    # at its slowest, 0.25 m/s, it goes on
    assert fastest[1] < 0.04


class Doubtful:
    """Predicts .5 beyond x = 1 m, and .05 before."""

    def complete(self, observed, free, *, grid, seen):
        beyond = grid.centres(seen.origin)[..., 0] > 1
        return Prediction(np.where(beyond, 0.5, 0.05).astype(np.float32))


@pytest.mark.parametrize(("brakes", "clear"), [(0.0, False), (0.3, True)])
def test_what_is_likely_free_counts_as_seen(brakes, clear):
    robot = MappingRobot(Doubtful(), brakes=brakes)
    flying = crossing(HALL, -4.0)
    robot.reset(flying.about())
    blind = flying.observe()
    blind["ranges"][:] = np.nan
    robot.act(blind)
    # likely free; doubtful; not in the window yet
    points = np.array([[-3.0, 0.0, 1.0], [2.0, 0.0, 1.0], [5.0, 0.0, 1.0]])
    assert robot._known_at(points).tolist() == [clear, False, False]


@pytest.mark.parametrize("brakes", [None, 0.0, 0.3])
def test_names_tell_how_a_robot_brakes(brakes):
    assert split_robot_name(robot_name("anywhere", brakes)) == ("anywhere", brakes)


@pytest.mark.parametrize("name", ["optimistic", "predicting"])
def test_a_position_that_drifts_far_beyond_the_bounds_crashes_no_robot(name):
    robot = robot_maker(name, None)(None)
    flying = crossing(HALL, -4.0)
    robot.reset(flying.about())
    for metres in (-50.0, 50.0):
        seen = flying.observe()
        action = robot.act(seen | {"position": seen["position"] + metres})
        assert np.isfinite(action).all()
