"""A policy that PPO of stable-baselines3 learns in the environment of `towards.py` beside it."""

import sys
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor
from towards import make


def success(act, flights=100):
    """The share of flights through worlds that the policy never met that reach their goals."""
    env, reached = make(0), 0
    for seed in range(10_000, 10_000 + flights):
        seen, _ = env.reset(options={"seed": seed})
        ended = over = False
        while not (ended or over):
            seen, _, ended, over, info = env.step(act(seen))
        reached += info["outcome"] == "success"
    return reached / flights


if __name__ == "__main__":
    # the file has the outcome of every flight
    envs = VecMonitor(DummyVecEnv([make] * 16), "flights", info_keywords=("outcome",))
    settings: Any = {"n_steps": 128, "batch_size": 256, "gamma": 0.98, "ent_coef": 0.003, "seed": 0}
    start = {"log_std_init": -1.0}
    model = PPO("MlpPolicy", envs, **settings, policy_kwargs=start, device="cpu")
    model.learn(int(sys.argv[1]) if sys.argv[1:] else 40_000)
    model.save("pilot")
    print("straight", success(lambda seen: np.zeros(3)))
    print("learned", success(lambda seen: model.predict(seen, deterministic=True)[0]))
