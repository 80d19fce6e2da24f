"""The loop: motion within its bounds, exact collisions, bits, and robots that behave badly."""

import hashlib
import itertools
import json
import math
import shutil
import subprocess
import sys
from collections import Counter
from contextlib import closing
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_equal
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from lidarsim import AnalyticEngine, GridSpec, Lidar, Pose, cast
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN
from lidarsim.pose import rotate
from scenegen.base.errors import DatasetError, ScenegenError
from scenegen.fly import Rules, Vehicle, suite
from scenegen.fly.course import Course, Recording, flight_log, read_recording, replay
from scenegen.fly.loop import HOVER, fly, scored
from scenegen.fly.missions import Mission, draw_missions, graded, progress
from scenegen.fly.motion import STEP_S, Quadrotor, advance, max_pull, pose_of
from scenegen.fly.pipe import PipeRobot
from scenegen.fly.simulation import Odometry, Simulation, bounded
from scenegen.fly.suite import chosen_courses, coverage_of, frozen_courses, hidden_course
from scenegen.worlds import kinds as recipes
from scenegen.worlds.clearance import Clearance
from scenegen.worlds.world import compile_world
from tests.command_line import ROOT, rows
from tests.conftest import hall_in
from tests.lidarsim.test_movers import three_movers
from tests.refusals import refuses
from tests.scenegen import cases

VEHICLE = Vehicle()
DIGEST = "1942ab986e98128608be499ff806182b54e0ddb0e4a4c057a7526c36a086818a"
VLP = "velodyne-vlp-16"
BALLS = [(3.0, 0.4, 2.0, 0.5), (5.0, -0.9, 2.3, 0.7), (1.5, 2.0, 1.5, 0.6), (6.0, 1.0, 1.2, 0.4)]
"""x, y, z and radius of spheres, metres."""
BOUNDS = ((-1.0, -3.0, 0.5), (9.0, 3.0, 4.0))


AT_REST = np.array([0.0] * 9 + [1.0, 0.0])
"""Of a vehicle at the origin that looks along x."""


@cache
def world_of(*geoms):
    """A world of geoms: a type, a position, and sizes, as MJCF has them."""
    bodies = "".join(f'<geom type="{t}" pos="{pos}" size="{size}"/>' for t, pos, size in geoms)
    bounds = " ".join(str(x) for corner in BOUNDS for x in corner)
    numeric = f'<custom><numeric name="flight_bounds" data="{bounds}"/></custom>'
    return compile_world(f"<mujoco>{numeric}<worldbody>{bodies}</worldbody></mujoco>".encode())


def balls():
    return world_of(*(("sphere", f"{x} {y} {z}", r) for x, y, z, r in BALLS))


FAR = "sphere", "4 90 2", ".1"
"""In nobody's way."""
OPENING = "box", "4 -1 2", ".2 3 9"
"""A wall across the bounds, with an opening of 1 m at its side."""


def flown_by(robot):
    """A flight among the balls."""
    return fly(simulation(balls()), robot)


def simulation(world, **options):
    mission = Mission(start=(0.0, 0.0, 2.0), goal=(8.0, 0.0, 2.0), shortest_m=8.2, bounds=BOUNDS)
    usual = {"sensor": Lidar(rows=4, columns=16), "vehicle": VEHICLE, "rules": Rules()}
    return Simulation(world, mission, **usual | options)


class Scripted:
    """Flies what it was given, and crashes when nothing is left."""

    def __init__(self, commands):
        self.commands, self.seen = iter(commands), []

    def reset(self, about):
        self.seen.append(about)

    def act(self, observation):
        self.seen.append(observation)
        return next(self.commands)


def always(*command):
    return Scripted(itertools.repeat(command))


def straight(y=0.0):
    return always(1.8, y, 0.0, 0.3)


@pytest.mark.parametrize("seed", range(6))
def test_no_bound_of_the_vehicle_is_exceeded(seed):
    rng, states = np.random.default_rng(seed), [AT_REST[None]]
    speed, pull, jerk = (smallest * 40 ** rng.uniform() for smallest in (0.2, 0.4, 5.0))
    vehicle = Vehicle(speed_mps=speed, acceleration_mps2=pull, jerk_mps3=jerk)
    commands, _ = bounded(rng.normal(0.0, 3 * speed, (6, 4)), vehicle)
    for command in commands.repeat(10, axis=0):  # for a second, or it never comes to what it may
        states.append(advance(states[-1][-1], command, vehicle))
    _, v, a, _ = np.split(np.concatenate(states), (3, 6, 9), axis=1)
    jerks = np.diff(a, axis=0) / STEP_S
    most = [np.linalg.norm(vectors, axis=1).max() for vectors in (v, a, jerks)]
    bounds = speed + jerk * STEP_S**2, max_pull(vehicle) + 1e-9, jerk * (1 + 1e-9)
    assert np.less_equal(most, bounds).all()
    # the integral is exact for a constant jerk
    assert_allclose(v[:-1] + STEP_S * a[:-1] + 0.5 * STEP_S**2 * jerks, v[1:], atol=1e-12)
    turns = [pose_of(period[-1], vehicle).quaternion for period in states]
    up = Rotation.from_quat(turns, scalar_first=True).as_matrix()[:, 2, 2]
    assert up.min() >= math.cos(math.radians(vehicle.tilt_deg) + 1e-9)


def places(flying, count):
    """Positions at moments of every step (count, steps, 3); with constant jerk they are cubic."""
    states = np.concatenate(flying.states)
    times_s = STEP_S * np.arange(len(states))
    path = CubicHermiteSpline(times_s, states[:, :3], states[:, 3:6])
    return path(np.linspace(times_s[:-1], times_s[1:], count))


def test_a_collision_is_what_dense_samples_say():
    """At fifty points of every step, by the distances of spheres alone."""
    hits = 0
    for seed in range(12):
        flying, wild = simulation(balls()), np.random.default_rng(seed).normal(size=(99, 4))
        robot = straight(0.05 * (seed - 6)) if seed < 8 else Scripted(1.5 * wild + [1, 0, 0, 0])
        hit = fly(flying, robot).outcome == "collision"
        gaps = [np.linalg.norm(places(flying, 50) - [x, y, z], axis=2) - r for x, y, z, r in BALLS]
        *before, last = np.min(gaps, axis=(0, 1))
        hits += hit
        assert min(before) >= VEHICLE.radius_m - 1e-3
        assert (last <= VEHICLE.radius_m + 1e-4) == hit
    assert 2 <= hits <= 10


def test_a_flight_is_struck_when_dense_samples_say():
    """At five points of every step, by the solids where they are then."""
    struck = 0
    for seed in range(8):
        movers = three_movers(seed)
        flying = simulation(replace(world_of(FAR), movers=movers))
        # to where a mover is after a second, or past it
        way = movers.poses(1.0)[0][seed % 3] + [0.0, 0.3 * (seed // 3), 0.5] - (0.0, 0.0, 2.0)
        hit = fly(flying, Scripted([[*way, 0.0]] * 15)).outcome == "struck"
        moments = places(flying, 5).swapaxes(0, 1)
        gaps = np.empty(moments.shape[:2])
        for n, part in np.ndindex(gaps.shape):
            solids = movers.solids((n + part / 4) * STEP_S)
            gaps[n, part] = Clearance(solids, np.array(BOUNDS)).at(*moments[n, part])
        struck += hit
        assert gaps[: len(gaps) - hit].min() >= VEHICLE.radius_m - 2e-3
        # between two samples, a mover comes 2 cm nearer at most
        assert not hit or gaps[-1].min() <= VEHICLE.radius_m + 0.02
        assert_allclose(flying.clearances_m[1:], gaps[:, 4], atol=1e-9)
    assert 2 <= struck <= 6


@pytest.mark.parametrize("moving", [False, True])
def test_observations_hold_movers_and_earlier_scans(moving):
    course = Course(world="pillar", movers="dense", flights=1, scans=3, moving=moving, lidar=VLP)
    flying = course.simulation(0)
    seen = []
    for _ in range(4):
        seen.append(flying.observe())
        flying.step(HOVER[0])
    last = seen[-1]
    times_s = 0.3 + moving * flying.sensor.times_s
    pose = Pose(last["position"], last["quaternion"])
    # the vehicle hovers: at their own times, its rays start where it is
    caster = flying.world.caster_at(AnalyticEngine.of, times_s)
    assert_allclose(last["ranges"], cast(caster, flying.sensor, pose).ranges, atol=1e-5)
    still = cast(flying.world.caster(AnalyticEngine.of), flying.sensor, pose)
    assert (last["ranges"] != still.ranges).any()
    for name in ("ranges", "position", "quaternion", "time_s"):
        assert_equal(last[f"earlier_{name}"], np.stack([seen[2][name], seen[1][name]]))
    assert_equal(seen[0]["earlier_time_s"], np.zeros((2, 1)))


def test_a_flight_has_the_same_bits_everywhere(rng):
    course = Course(world="pillar", flights=1, noise="range:0.02", moving=True)
    flying = course.simulation(0)
    for _ in range(10):
        flying.observe()
        flying.step(bounded(rng.normal(0.0, 1.0, 4), VEHICLE)[0][0])  # type: ignore[index]
    assert flying.digest == DIGEST


@pytest.mark.parametrize("latency_s", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("dynamics", ["kinematic", "mujoco"])
def test_a_command_is_followed_late(latency_s, dynamics):
    states = []
    for rules in (Rules(), Rules(latency_s=latency_s)):
        flying = simulation(world_of(FAR), vehicle=Vehicle(dynamics=dynamics), rules=rules)
        for command in np.float32([[1.0, 0.5, 0, 0.3], [2, -1, 0, 0], [0, 0, 1, 0]]):
            flying.step(command)
        states.append(np.concatenate(flying.states[1:]))
    steps = round(latency_s / STEP_S)
    assert_equal(states[1][steps:], states[0][:-steps])


def test_drift_is_a_walk_of_the_robots_pose():
    rules = Rules(drift_m=0.5, drift_deg=2.0)
    ends = []
    for seed in range(300):
        odometry = Odometry(np.zeros(3), rules, seed)
        for _ in range(100):
            odometry.move(np.array([0.0, 0.0, 1.0]))
        ends.append([*odometry.position - [0, 0, 100], math.degrees(odometry.yaw_rad)])
    assert_allclose(np.std(ends, axis=0), [0.5, 0.5, 0.5, 2.0], rtol=0.15)


def test_a_robot_whose_yaw_is_wrong_flies_beside_its_course():
    flight = simulation(world_of(FAR), rules=Rules(drift_deg=1e-9))
    flight._odometry.yaw_rad = math.radians(30)
    for _ in range(20):
        flight.step(np.array([1.0, 0, 0, 0], np.float32))
    seen, (x, y, *_) = flight.observe(), flight.state
    assert_allclose(seen["velocity"], [1, 0, 0], atol=1e-3)
    assert_allclose(seen["position"] - [0, 0, 2], [math.hypot(x, y), 0, 0], atol=1e-6)
    assert math.degrees(math.atan2(y, x)) == pytest.approx(-30, abs=1e-4)
    turned = Rotation.from_quat(seen["quaternion"], scalar_first=True)
    assert turned.as_euler("ZYX", degrees=True)[0] == pytest.approx(30)


def test_a_robot_sees_nothing_that_its_sensor_does_not():
    wall, hidden = ("box", "4 0 2.25", ".1 2.999 1.749"), ("sphere", "6 0 2", ".4")
    told = []
    for geoms in ([wall], [wall, hidden]):
        flying, robot = simulation(world_of(*geoms)), Scripted([[0.5, 0.2, 0.1, 0.4]] * 30)
        assert fly(flying, robot).outcome == "crashed"
        told.append(robot.seen)
    assert_equal(*told)
    seen = robot.seen[1]
    names = {"position", "quaternion", "velocity", "goal", "time_s", "ranges", "points"}
    assert set(seen) == names
    hit = np.isfinite(seen["ranges"])
    ends = seen["ranges"][hit, None] * flying.sensor.directions_body[hit]
    assert_allclose(seen["points"][hit], ends, atol=1e-5)
    assert hit.any()


def test_outcomes_and_scores():
    done = fly(simulation(world_of(FAR)), straight())
    assert (done.outcome, done.score, done.spl) == ("success", pytest.approx(0.5), 1.0)
    assert 4.0 < done.time_s < 5.0
    left = flown_by(always(0, -2, 0, 0))
    assert (left.outcome, left.score, left.spl) == ("left", 0.0, 0.0)
    late = flown_by(Scripted(itertools.repeat(None)))
    assert (late.outcome, late.invalid, late.flown_m) == ("timeout", len(late.commands), 0.0)


@pytest.mark.parametrize(("message", "invalid", "speeding"), cases("fly/commands"))
def test_what_a_robot_says_is_counted_and_bounded(message, invalid, speeding):
    flown = flown_by(Scripted([json.loads(message), None]))
    assert (flown.invalid - 1, flown.speeding) == (int(invalid), int(speeding))
    assert np.linalg.norm(flown.commands[:, :3], axis=1).max() <= VEHICLE.speed_mps


def test_of_a_robot_that_says_nothing_the_rest_of_its_plan_is_flown():
    flown = flown_by(Scripted([[[2, 0, 0, 0]] * 3, None, None, None]))
    assert (flown.commands[:, 0] > 1.9).tolist() == [True, True, True, False]


ROBOT = """
import json, os, sys, time
raw, out = sys.stdin.buffer, sys.stdout
what, steps = sys.argv[1], 0
while line := raw.readline():
    told = json.loads(line)
    for name, kind, shape in told["arrays"]:
        size = int(kind[2:])
        for n in shape:
            size *= n
        raw.read(size)
    if told["is"] == "reset":
        print(flush=True)
        continue
    steps += 1
    bad = steps == 3
    if bad and what == "hangs": time.sleep(60)
    if bad and what == "kills": os.kill(os.getppid(), 9)
    if bad and what == "dies": sys.exit(3)
    if bad and what == "eats": bytearray(8 << 30)
    if bad and what == "floods":
        while True: print("x" * 10000, flush=True)
    if bad and what == "says twice": print("[0,0,0,0]")
    print("no" if bad and what == "babbles" else "[1.5, 0.3, 0, 0]", flush=True)
"""


ENDS = """
hangs      → hung
dies       → crashed
kills      → crashed
eats       → crashed
floods     → flooded
says twice → flooded
babbles    → collision
"""


@pytest.mark.parametrize(("what", "outcome"), rows(ENDS))
def test_a_robot_of_its_own_is_cut_off_and_counted(what, outcome, tmp_path):
    file = tmp_path / "robot.py"
    file.write_text(ROBOT)
    command = [sys.executable, str(file), what]
    with closing(PipeRobot(command, seconds=0.5, memory_bytes=1 << 30)) as robot:
        flights = [flown_by(robot) for _ in range(2)]
    assert [flight.outcome for flight in flights] == [outcome] * 2
    assert flights[0].invalid == (what == "babbles")
    assert len(flights[1].commands) >= 2  # the next flight began anew


CHILDREN = """
import os, sys, time
for _ in range(20): os.write(2, b"x" * 4096)
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        open(sys.argv[1], "w").write(f"{os.getpid()} {len(os.sched_getaffinity(0))}")
        time.sleep(60)
    os._exit(0)
while not os.path.exists(sys.argv[1]): time.sleep(0.01)
print(flush=True)
time.sleep(60)
"""


def test_nothing_that_a_robot_began_is_left(tmp_path, capfd):
    """Not even what left its session and lost its parent; and it had one core, and a few words."""
    file, told = tmp_path / "robot.py", tmp_path / "told"
    file.write_text(CHILDREN)
    robot = PipeRobot([sys.executable, str(file), str(told)], seconds=0.2)
    assert flown_by(robot).outcome == "hung"
    child, cores = told.read_text().split()
    assert cores == "1"
    assert not Path(f"/proc/{child}").exists()
    assert 1000 < len(capfd.readouterr().err) < 20_000


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_a_robot_in_another_language_flies(tmp_path):
    source, program = ROOT / "docs" / "examples" / "my_robot.cpp", tmp_path / "my_robot"
    subprocess.run(["g++", "-std=c++17", str(source), "-o", str(program)], check=True)
    with closing(PipeRobot([str(program)])) as robot:
        flown = flown_by(robot)
    assert (flown.outcome, flown.invalid) == ("collision", 0)
    assert_allclose(flown.commands[0], [1.5, 0, 0, 0], atol=1e-6)  # towards the goal


def test_a_robot_that_never_begins_is_asked_a_few_times_only():
    """Its other flights count as hung at once."""
    robot = PipeRobot([sys.executable, "-c", "import time; time.sleep(60)"], start_seconds=0.2)
    flights = [flown_by(robot) for _ in range(5)]
    assert {flown.outcome for flown in flights} == {"hung"}
    asked = ["no answer" in flown.trouble for flown in flights]
    assert asked == [True, True, True, False, False]


@pytest.fixture
def coarse(monkeypatch):
    """Ways take the time."""
    monkeypatch.setattr("scenegen.fly.missions.VOXEL_M", 0.2)


@pytest.mark.usefixtures("coarse")
def test_missions_follow_the_rule():
    world, rules = balls(), Rules(apart_m=5.0)
    missions = draw_missions(world, VEHICLE, rules, 4, seed=1)
    assert missions[:2] == draw_missions(world, VEHICLE, rules, 2, seed=1)
    for mission in missions:
        straight_m = math.dist(mission.start, mission.goal)
        assert 5.0 <= straight_m <= mission.shortest_m + 1e-9
        for end in (mission.start, mission.goal):
            assert world.clearance.at(*end) >= VEHICLE.radius_m + rules.spare_m
    (grade,) = graded(world, VEHICLE.radius_m, [mission])
    assert grade.tortuosity == mission.shortest_m / straight_m
    wall = world_of(("box", "4 0 2", ".2 9 9"))
    assert sides(wall, Rules(apart_m=2.0)) == {True}  # none leads through the wall
    large = Vehicle(radius_m=0.99)
    refuses("large", draw_missions, wall, large, rules, 1, seed=1, error=ScenegenError)


def sides(world, rules):
    """Whether start and goal of some missions lie on one side of a wall at x = 4."""
    missions = draw_missions(world, VEHICLE, rules, 6, seed=1)
    return {(mission.start[0] < 4) == (mission.goal[0] < 4) for mission in missions}


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize(("detour", "blocked"), [(1.0, {False, True}), (1.3, {True})])
def test_missions_are_as_long_as_the_rules_ask(detour, blocked):
    rules, world = Rules(apart_m=2.0, detour=detour, berth_m=0.0), world_of(OPENING)
    missions = draw_missions(world, VEHICLE, rules, 4, seed=1)
    assert min(mission.shortest_m / mission.straight_m for mission in missions) >= detour
    is_free, radius_m = world.clearance.motion_is_free, VEHICLE.radius_m
    assert {not is_free(one.start, one.goal, radius_m) for one in missions} == blocked


@pytest.mark.parametrize(("berth_m", "expected"), [(0.0, {True, False}), (0.8, {True})])
def test_ways_keep_the_berth_of_the_rules(berth_m, expected):
    """The opening, 1 m wide, lets a ball of 0.3 m through, but none of 1.1 m."""
    assert sides(world_of(OPENING), Rules(apart_m=2.0, berth_m=berth_m)) == expected


def test_progress_is_the_share_of_the_shortest_way():
    """Behind a wall with an opening at its side, which is nearer to the goal in a straight line."""
    mission = Mission(start=(3, -2, 2), goal=(5, -2, 2), shortest_m=9.0, bounds=BOUNDS)

    def at(x, y):
        return progress(world_of(OPENING), mission, 0.3, (x, y, 2.0))

    assert (at(3, -2), at(5, -2)) == (0.0, 1.0)
    # at the wall, where it does not fit; in the opening; and on the way
    shares = at(3.65, -2), at(4, 2.5), at(3, 0)
    assert shares == pytest.approx((0.0, 0.5, 0.22), abs=0.05)


def pillars(flights, **options):
    return Course(world="pillar", flights=flights, seed=4, **options)


def test_a_course_draws_by_its_own_recipe():
    recipe = '{"world": {"density": [0.01, 0.02]}, "flight": {"altitude_m": [1.0, 2.0]}}'
    world = pillars(1, recipe=recipe).drawn
    assert_allclose(world.flight_bounds[:, 2], [1.0, 2.0])
    assert world.mjcf.count(b"<geom") < 0.5 * pillars(1).drawn.mjcf.count(b"<geom")
    for case in ("[", "[1]", '{"lidar": {"sensor": "mine:Sensor"}}', '{"world": {"densty": 1}}'):
        refuses(case, lambda: pillars(1, recipe=case).drawn, error=ScenegenError)  # noqa: B023


def entry_of(*flights, suite=None, track=""):
    """A recording of courses with their flights."""
    return Recording(robot="scripted", suite=suite, track=track, courses=list(flights))


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("rules", [Rules(), Rules(latency_s=0.13, drift_m=2.0, drift_deg=5.0)])
def test_a_recording_flies_again(rules, tmp_path):
    course = replace(pillars(2), rules=rules)
    flown = [fly(course.simulation(n), straight(0.1 * n)) for n in range(2)]
    file, content = tmp_path / "flights.json", entry_of((course, flown)).encoded()
    file.write_bytes(content)
    recording = read_recording(file)
    assert recording.robot == "scripted"
    again = replay(*recording.courses[0])
    assert [flight.row() for flight in again] == [flight.row() for flight in flown]
    file.write_bytes(content.replace(course.sha256.encode(), b"0" * 64))
    other = read_recording(file).courses[0]
    refuses("another world", replay, *other, error=ScenegenError)


CHANGES = rows("""
"radius_m": 0.3   → "radius_m": -1
"commands": [[0.0 → "commands": [["0.0"
"flights": 1      → "flights": 2
"courses": [      → "courses": [], "more": [
""")


def test_what_is_no_recording_is_refused(tmp_path):
    file, flown = tmp_path / "flights.json", fly(simulation(world_of(FAR)), Scripted([HOVER[0]]))
    content = (
        entry_of((Course(world="pillar", flights=1, document="0"), [flown])).encoded().decode()
    )
    file.write_text(content)
    read_recording(file)
    damaged = [content.replace(*change) for change in CHANGES]
    assert content not in damaged
    for case, wrong in enumerate(("{}", "[1]", "x", *damaged)):
        file.write_text(wrong)
        refuses(case, read_recording, file, error=DatasetError)


@pytest.mark.usefixtures("coarse")
def test_no_forged_figure_passes(tmp_path):
    """Whatever is changed of a flight, it is refused, when it is read or when it is flown again;
    who flew it alone knows how long it thought, and when it died."""
    course, file = pillars(1), tmp_path / "forged.json"
    flown = fly(course.simulation(0), Scripted([[1.0, 0.0, 0.0, 0.1]] * 6))
    assert flown.outcome == "crashed"
    success = {"outcome": "success", "score": 0.5, "spl": 1.0}
    nothing = {"commands": flown.commands[:0], "digest": hashlib.sha256().hexdigest()}
    raised = "score spl ratio flown_m shortest_m jerk_mps3 speed_mps min_clearance_m"
    forged = [
        *(success, {"outcome": "timeout"}, success | nothing | {"time_s": 0.0}),
        *({"commands": factor * flown.commands} for factor in (0.5, math.nan)),
        *({"time_s": 0.1}, {"score": math.nan}, {"mean_clearance_m": 0.9}),
        *({name: getattr(flown, name) + 0.01} for name in raised.split()),
    ]
    for change in forged:
        file.write_bytes(entry_of((course, [replace(flown, **change)])).encoded())
        with pytest.raises(DatasetError):
            replay(course, read_recording(file).courses[0][1])
    turning = course.simulation(0)  # faster than it may, and true in all else
    for command in (fast := [np.float32([0, 0, 0, 9])] * 3):
        turning.observe()
        turning.step(command)
    turning.outcome = "crashed"
    flights = [scored(turning, fast, [], Counter(), "")]
    refuses("fast", replay, course, flights, error=DatasetError)


@pytest.mark.parametrize(
    "chosen",
    [[3 * n + n % 3 for n in range(10)], pytest.param(range(30), marks=pytest.mark.slow)],
    ids=["some", "all"],
)
def test_the_suite_is_drawn_as_it_was_frozen(chosen):
    """Worlds are those that the suite's file names, one of each kind here, of each kind and
    difficulty among the slow tests, and have missions."""
    courses = frozen_courses("drawn")
    for course in (courses[10 * n] for n in chosen):
        assert course.sha256.startswith(course.document)
    missions = courses[7].missions
    assert [mission.straight_m >= 10 for mission in missions] == [True] * courses[7].flights


FROZEN = {"drawn": (300, "31c17c43"), "movers": (50, "f520d8f4"), "places": (14, "3eb9d0a8")}
"""Courses, or maps, of each track, and the first digits of the SHA-256 of its part of the file."""


@pytest.mark.parametrize("track", FROZEN)
def test_a_track_never_changes(track):
    part = suite.frozen()[track]
    count = len(part) if track == "places" else len(frozen_courses(track))
    assert (count, digest(json.dumps(part), 8)) == FROZEN[track]


def digest(text, digits):
    return hashlib.sha256(text.encode()).hexdigest()[:digits]


HIDDEN_WORLDS = {
    5: (4418664987486324211, "46f2f254f561c0e9"),
    6: (9086653050485294098, "26e27a1d1ac435dd"),
    7: (6997508757783532242, "25ea243a02f8709f"),
    9: (7529006468152587400, "1fd1b265abacbd32"),
}
"""Courses of the hidden track that the number 5 draws: the seed, and the world's first digits."""


def test_the_hidden_track_never_changes(monkeypatch):
    """Its courses and their worlds are those of the day when the suite was frozen, although a kind
    of worlds is added."""
    monkeypatch.setitem(recipes.KINDS.builtin, "attic", "nowhere:Attic")
    assert "attic" in recipes.kind_names()
    courses = chosen_courses(HIDDEN_5, quick=False)
    listed = "\n".join(f"{one.seed} {one.world} {one.level} {one.flights}" for one in courses)
    assert digest(listed, 16) == "717f5a267ea15677"
    for number, frozen in HIDDEN_WORLDS.items():
        course = replace(courses[number], flights=1)  # missions take the time, and change the seed
        drawn = hidden_course(course, 5)
        assert (drawn.seed, drawn.sha256[:16]) == frozen
    assert hidden_course(course, 6).seed != drawn.seed
    other = replace(course, document="0")
    refuses("another world", hidden_course, other, 5, error=ScenegenError)


HIDDEN_5, HIDDEN_7, HIDDEN_8 = (suite.track_name("drawn", number, None) for number in (5, 7, 8))


def part(courses, track="drawn", name="aerial-2"):
    return coverage_of(entry_of(*((course, []) for course in courses), suite=name, track=track))


def test_an_entry_keeps_to_its_suite():
    """Neither an easier vehicle nor a world of one's own, nor the easy ones twice, is an entry."""
    courses = chosen_courses("drawn", quick=True)
    assert str(part(courses)) == "drawn, quick: 19 of 19 courses"
    assert "30 of 300 courses, incomplete" in str(part(frozen_courses("drawn")[::10]))
    slow = [suite.late(course, 0.1) for course in courses]
    assert str(part(slow)) == "drawn, quick: 19 of 19 courses"
    hidden = chosen_courses(HIDDEN_7, quick=False)
    assert (part(hidden, HIDDEN_7).there, part(hidden, "hidden x").of) == (50, 50)
    assert HIDDEN_7 != HIDDEN_8
    first, second, *_ = courses
    forged = {
        "vehicle": replace(first, vehicle=replace(first.vehicle, radius_m=0.03)),
        "rules": replace(first, rules=Rules(apart_m=1.0)),
        "document": replace(first, document=""),
        "twice": second,
        "hidden": hidden[0],
        "latencies": slow[0],
    }
    for case, course in forged.items():
        refuses(case, part, [course, *courses[1:]], error=ScenegenError)
    refuses("easy", part, courses, "easy", error=ScenegenError)
    refuses("aerial-1", part, courses, name="aerial-1", error=ScenegenError)


def test_what_is_unknown_of_a_map_is_flown_through_and_never_flown_to(tmp_path, monkeypatch):
    """A hall of 12 m, of which a slice is unknown, and another is a wall with a hole in it."""
    monkeypatch.setattr("scenegen.fly.missions.VOXEL_M", 0.2)  # as the map's
    states = np.full((60, 60, 15), FREE, np.uint8)
    states[25:30], states[45], states[45, 20:40, 4:12] = UNKNOWN, OCCUPIED, FREE
    course = Course(world=str(hall_in(tmp_path, states)), rules=Rules(apart_m=6.0), flights=8)
    sides = [(mission.start[0] > 5, mission.goal[0] > 5) for mission in course.missions]
    assert set(sides) <= {(True, True), (False, False)}  # a way leads through what is unknown
    flying = course.simulation(sides.index((False, False)))
    while flying.outcome is None:  # a wall is one
        beyond = flying.state[0] >= 6.5
        flying.step(np.float32([1.5, 0, beyond, 0]))
    assert (flying.outcome, bool(beyond)) == ("collision", True)
    assert "known" not in course.simulated.truth(GridSpec(), np.zeros(3))


def test_the_track_places_is_of_these_maps_alone(tmp_path, monkeypatch):
    track = partial(chosen_courses, "places", tmp_path, quick=False)
    refuses("absent", track, error=ScenegenError)
    states = np.full((6, 6, 5), FREE, np.uint8)
    hall_in(tmp_path, states)
    monkeypatch.setattr(suite, "frozen", lambda: {"places": {"hall.npz": "0" * 16}})
    courses = track()
    assert [course.seed for course in courses] == [0, 1, 2, 3]
    refuses("another world", lambda: courses[0].drawn, error=ScenegenError)


def test_a_quadrotor_of_mujocos_tracks_the_kinematic_motion_and_leans_as_its_thrust_takes():
    """It lags by decimetres and comes to rest where that does."""
    vehicle = Vehicle(dynamics="mujoco", tilt_deg=60)
    lead = np.array([0.0, 0.0, 1.5, *[0.0] * 6, 0.6, 0.8])
    quadrotor = Quadrotor(lead, vehicle)
    commands = [[2.0, 0.0, 0.0, 0.5]] * 15 + [[0.0, -1.9, 0.5, -1.0]] * 15 + [[0.0] * 4] * 30
    lags = []
    for command in np.float32(commands):
        state = quadrotor.advance(command)[-1]
        lead = advance(lead, command, vehicle)[-1]
        lags.append(math.dist(state[:3], lead[:3]))
        up, expected = (
            rotate(pose.quaternion, np.eye(3)[2:])[0]
            for pose in (quadrotor.pose, pose_of(state, vehicle))
        )
        assert up @ expected > 1 - 1e-9
    assert 0.02 < max(lags) < 0.2
    assert lags[-1] < 0.01
    assert_allclose(lead[9:], state[9:], atol=0.01)


def test_the_log_of_a_flight_has_true_poses():
    course = replace(pillars(1), rules=Rules(drift_m=5.0, drift_deg=20.0))
    flown = fly(course.simulation(0), straight())
    positions = [scan.pose.position for scan in flight_log(course, 0, flown)]
    assert_allclose(positions, flown.path[:-1], atol=1e-12)
