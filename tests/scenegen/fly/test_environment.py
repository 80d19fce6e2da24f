"""The Gymnasium environment: bounded spaces, copies that fly on alike, clear errors, learning."""

import copy
import pickle

import numpy as np
import pytest
from numpy.testing import assert_equal

import scenegen
from lidarsim import Lidar
from lidarsim.engines.voxels import FREE, OCCUPIED
from scenegen.base.errors import ScenegenError
from scenegen.fly import Rules, Vehicle
from scenegen.fly.course import Course
from tests.command_line import ROOT, page
from tests.conftest import hall_in
from tests.scenegen import cases

gymnasium = pytest.importorskip("gymnasium")
pytestmark = pytest.mark.filterwarnings("ignore")
NEAR = Rules(apart_m=4.0)
SMALL = {"rules": NEAR, "lidar": Lidar(rows=4, columns=32)}


@pytest.fixture(autouse=True, scope="module")
def coarse():
    """Missions on coarse voxels: they take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenegen.fly.missions.VOXEL_M", 0.5)
        yield


def made(**options):
    return gymnasium.make("scenegen/Fly-v0", **SMALL | options)


def test_gymnasium_checks_and_flies_it():
    from gymnasium.utils.env_checker import check_env

    named = made(lidar="velodyne-vlp-16", noise="datasheet")
    assert named.observation_space["ranges"].shape == (16, 1808)
    env = made(world="pillar", lidar="raster")
    check_env(env.unwrapped)
    check_env(made(world="pillar", worlds=2).unwrapped)  # whose flights share a sensor
    first, about = env.reset(options={"seed": 3})
    assert set(about["about"]) >= {"goal", "bounds", "radius_m"}
    towards = (first["goal"] - first["position"]) / 10
    plan = np.tile(np.float32([*towards, 0.0]), (3, 1))
    steps = [env.step(command) for command in plan]
    rewards, ends = [step[1] for step in steps], [step[2:4] for step in steps]
    assert ends == [(False, False)] * 3
    assert 0.0 < rewards[0] < 0.2
    plans = scenegen.Flight("cave", periods=3, rules=NEAR)
    plans.reset(options={"seed": 3, "world": "pillar"})
    seen, reward, *_ = plans.step(plan)
    assert plan in plans.action_space
    assert reward == sum(rewards)
    assert_equal(seen, steps[-1][0])


SETTINGS = {
    "plain": {},
    "noise": {"noise": "range:0.02", "moving": True},
    "rotors": {"vehicle": Vehicle(dynamics="mujoco", speed_mps=4.0, acceleration_mps2=10.0)},
    "sensor": {"lidar": Lidar(rows=4, columns=16, max_range_m=3.0), "difficulty": "easy"},
    "movers": {"movers": "light", "scans": 3},
}


def sampled(env, count):
    """Actions at random."""
    env.action_space.seed(count)
    return [env.action_space.sample() for _ in range(count)]


def flown(env, actions):
    """All that some steps give, up to the end of a flight; and how the next one begins."""
    steps = []
    for action in actions:
        steps.append(env.step(action))
        if steps[-1][2] or steps[-1][3]:
            break
    return [*steps, env.reset()]


@pytest.mark.parametrize("name", SETTINGS)
def test_observations_lie_in_bounded_spaces(name):
    """Their ranges are those of a robot, but for the maximum range where nothing returned."""
    env = made(**SETTINGS[name])
    assert all(box.is_bounded() for box in env.observation_space.values())
    seen, info = env.reset(seed=1)
    settings = SMALL | SETTINGS[name]
    course = Course(world="pillar", flights=1, seed=info["seed"], **settings)
    robots = course.simulation(0).observe()
    assert np.isinf(robots["ranges"]).any()
    max_range_m = np.float32(course.sensor.max_range_m)
    ranges = {name: values for name, values in robots.items() if name.endswith("ranges")}
    limited = {name: np.minimum(values, max_range_m) for name, values in ranges.items()}
    assert_equal(seen, robots | limited)
    full = np.float32([0, 0, env.unwrapped.action_space.high[0], 0])  # up, and out of the bounds
    for step in [*flown(env, sampled(env, 30)), *flown(env, [full] * 60)]:
        assert step[0] in env.observation_space


@pytest.mark.parametrize("name", ["noise", "rotors", "movers", "map"])
def test_a_copy_flies_on_as_the_original(name, tmp_path):
    """Also after the end of the flight: the next world is the same, too."""
    states = np.full((60, 60, 15), FREE, np.uint8)
    states[30, :40] = OCCUPIED
    settings = SETTINGS | {"map": {"world": str(hall_in(tmp_path, states))}}
    env = made(**settings[name])
    env.reset(seed=2)
    actions = sampled(env, 12)
    env.step(actions.pop())
    copies = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    for _ in range(2):
        expected = flown(env, actions)
        for other in copies:
            assert_equal(flown(other, actions), expected)


def test_kept_worlds_and_many_environments_change_no_bit():
    """Of three environments in one, each sees what it would alone, whose worlds are drawn anew."""
    options = {"vectorization_mode": "sync", "worlds": 2, "difficulty": "easy"}
    many = gymnasium.make_vec("scenegen/Fly-v0", 3, **SMALL | options)
    begun, about = many.reset(seed=[5, 6, 7])
    assert set(about["seed"].tolist()) == {0, 1}
    up = np.float32([0.1, 0, 2, 0])
    together = [begun, *(many.step(np.tile(up, (3, 1)))[0] for _ in range(4))]
    for number, seed in enumerate(about["seed"].tolist()):
        env = made(difficulty="easy")
        first, _ = env.reset(options={"seed": seed})
        single = [first, *(env.step(up)[0] for _ in range(4))]
        seen = [{name: values[number] for name, values in each.items()} for each in together]
        assert_equal(seen, single)


@pytest.fixture(scope="module")
def states():
    """An environment before its first flight, one in a flight, and one after it."""
    env, begun, ended = (scenegen.Flight(rules=NEAR) for _ in range(3))
    begun.reset(seed=0)
    ended.reset(seed=0)
    while not ended.step([0, 0, 2, 0])[2]:  # up
        pass
    return {"env": env, "begun": begun, "ended": ended}


@pytest.mark.parametrize(("code", "message"), cases("fly/environment"))
def test_misuse_ends_in_one_line(states, code, message):
    with pytest.raises(ScenegenError) as caught:
        eval(code, {"make": scenegen.Flight, "np": np, **states})
    assert message in str(caught.value)


@pytest.mark.slow
def test_stable_baselines_checks_it_and_learns(monkeypatch, tmp_path):
    """By the recipe of docs/examples, but for the number of steps, and of processes: none."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "docs" / "examples")
    names = {"__name__": "learn"}
    exec(page("examples/learn.py"), names)
    check_env(made(world="pillar"))
    check_env(names["make"]())
    envs = VecCheckNan(DummyVecEnv([names["make"]] * 2), raise_exception=True)
    model = PPO("MlpPolicy", envs, n_steps=512, seed=0, device="cpu")
    before = copy.deepcopy(model.policy.state_dict())
    model.learn(3000)
    assert 0.0 <= names["success"](lambda seen: model.predict(seen)[0], 2) <= 1.0
    after = model.policy.state_dict()
    assert [name for name, values in after.items() if values.equal(before[name])] == []
    whole = PPO("MultiInputPolicy", DummyVecEnv([made]), n_steps=64, device="cpu")
    whole.learn(64)  # all observations as they are
    for values in (*after.values(), *whole.policy.state_dict().values()):
        assert values.isfinite().all()
