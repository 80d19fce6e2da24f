"""A policy that stable-baselines3 learns on scenegen's Gymnasium environment."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

import scenegen  # noqa: F401  # so that gymnasium knows the environment


class Felt(gymnasium.ObservationWrapper):
    """One vector: the way to the goal, attitude, velocity, and the nearest of each 4 x 4 rays."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = Box(-1e6, 1e6, (3 + 4 + 3 + 4 * 30,), np.float32)

    def observation(self, seen):
        nearest = seen["ranges"].reshape(4, 4, 30, 4).min(axis=(1, 3))  # of 16 x 120 rays
        parts = (
            seen["goal"] - seen["position"],
            seen["quaternion"],
            seen["velocity"],
            nearest.ravel(),
        )
        return np.concatenate(parts).astype(np.float32)


def make():
    """One environment, with actions between -1 and 1."""
    env = Felt(gymnasium.make("scenegen/Fly-v0", world="pillar"))
    return RescaleAction(env, np.float32(-1), np.float32(1))


if __name__ == "__main__":
    envs = VecNormalize(SubprocVecEnv([make] * 8))
    model = PPO("MlpPolicy", envs, n_steps=512, seed=0, device="cpu")
    model.learn(1_000_000)
    model.save("pilot")
    envs.save("pilot-scales.pkl")  # the policy needs the same scales when it flies
