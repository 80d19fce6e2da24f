"""Robots among movers: who predicts where a person goes keeps away; braking keeps its promise."""

from dataclasses import replace

import numpy as np
import pytest

from lidarsim.movers import Movers
from lidarsim.solids import CAPSULE
from scenegen.fly import Rules, Vehicle
from scenegen.fly.loop import fly
from scenegen.fly.missions import Mission
from scenegen.fly.simulation import Simulation
from scenegen.model.completion.protocol import Prediction, ReturnsCompleter
from scenegen.model.robots import robot_name, split_robot_name
from scenegen.model.robots.avoiding import TrackingRobot, TruthAmongMovers
from scenegen.model.robots.flights import robot_maker
from scenegen.model.robots.mapping import MappingRobot
from scenegen.model.robots.steering import stopping_m, stopping_mps
from scenegen.worlds.tables import named_lidar
from scenegen.worlds.world import compile_world
from tests.command_line import beside

HALL = compile_world(beside(__file__, "hall.xml").encode())


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
    ends = {"start": (start, 0.0, 1.0), "goal": (4.0, 0.0, 1.0), "shortest_m": 8.0}
    mission = Mission(**ends, bounds=world.flight_bounds)
    vehicle, rules = Vehicle(radius_m=0.2, **vehicle), Rules(patience=20)
    return Simulation(world, mission, sensor=named_lidar("raster"), vehicle=vehicle, rules=rules)


def test_who_predicts_keeps_away_from_who_crosses():
    """Others are struck in some of these flights, and come nearer in all of them together."""
    least = np.inf
    for speed in (1.5, 2.5):
        world = with_person(speed)
        robots = (
            TrackingRobot(predicts=True),
            TruthAmongMovers(world, predicts=True),
            MappingRobot(ReturnsCompleter()),
            TruthAmongMovers(world, predicts=False),
        )
        flights = [fly(crossing(world, -4.0), robot) for robot in robots]
        assert {flown.outcome for flown in flights} <= {"success", "struck"}
        least = np.minimum(least, [flown.min_clearance_m for flown in flights])
    predicting, foreseeing, *others = least / 0.2  # in radii
    assert predicting > 2 - 5e-6
    assert foreseeing > 1.5
    assert max(others) <= 1.005


def test_what_moved_on_is_forgotten():
    world = with_person(1.5)
    robots = MappingRobot(ReturnsCompleter()), TrackingRobot(predicts=False)
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


def test_braking_keeps_the_stopping_distance():
    about = {"acceleration_mps2": 4.0, "jerk_mps3": 30.0, "latency_s": 0.05}
    for length in (0.7, 1.5, 6.0):
        assert stopping_m(stopping_mps(length, about), about) == pytest.approx(length)
    assert stopping_mps(-1.0, about) == 0.25


def test_a_robot_that_brakes_could_stop_before_what_it_has_not_seen(monkeypatch):
    """Nothing is seen beyond x = 0."""
    fastest = []
    for brakes in (None, 0.0):
        robot = MappingRobot(ReturnsCompleter(), brakes=brakes)
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


def test_names_tell_how_a_robot_brakes():
    for brakes in (None, 0.0, 0.3):
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
