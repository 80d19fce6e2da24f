"""scenegen's Gymnasium environment for a policy that begins by flying straight to the goal, and
learns how to turn away from that."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box

import scenegen  # noqa: F401  # so that gymnasium knows the environment

SECTORS, BANDS, PERIODS = 36, 3, 2


class Towards(gymnasium.Wrapper):
    """Sees the nearest return of each sector around, from the goal's direction on, below, at and
    above its height, the way to the goal, and its velocity. Acts by a turn away from the goal's
    direction, a climb and a speed, each from -1 to 1; all 0 is straight to the goal."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = Box(-1, 1, (SECTORS * BANDS + 2 + 3,), np.float32)
        self.action_space = Box(-1, 1, (3,), np.float32)
        self.speed_mps = env.unwrapped.action_space.high.flat[0]

    def observe(self, seen):
        away, (w, x, y, z) = seen["goal"] - seen["position"], seen["quaternion"]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        self.away, self.course = away, np.arctan2(away[1], away[0])
        points = seen["points"][seen["points"].any(axis=-1)]
        turn = np.arctan2(points[:, 1], points[:, 0]) + yaw - self.course
        sector = np.floor(turn / (2 * np.pi) * SECTORS + 0.5).astype(int) % SECTORS
        nearest = np.full((SECTORS, BANDS), 10.0)
        band = np.digitize(points[:, 2], (-0.5, 0.5))
        np.minimum.at(nearest, (sector, band), np.hypot(points[:, 0], points[:, 1]))
        vx, vy, vz = seen["velocity"] / (2 * self.speed_mps)
        c, s = np.cos(self.course), np.sin(self.course)
        felt = [*(1 - nearest.ravel() / 10), np.hypot(*away[:2]) / 60, np.tanh(away[2])]
        return np.array([*felt, c * vx + s * vy, c * vy - s * vx, vz], np.float32).clip(-1, 1)

    def reset(self, **options):
        seen, info = self.env.reset(**options)
        return self.observe(seen), info

    def step(self, action):
        turn, climb, speed = np.clip(action, -1, 1)
        angle = self.course + turn * np.pi / 2
        rise = self.away[2] / np.linalg.norm(self.away) + 0.5 * climb
        way = np.array([np.cos(angle), np.sin(angle), rise])
        way *= self.speed_mps * (0.7 + 0.3 * speed) / np.linalg.norm(way)
        seen, *rest = self.env.step(np.array([[*way, 0.0]] * PERIODS, np.float32))
        return self.observe(seen), *rest


def make(worlds=128):
    """One environment; those of a process share their worlds."""
    options = {"world": "pillar", "difficulty": "easy", "worlds": worlds, "periods": PERIODS}
    return Towards(gymnasium.make("scenegen/Fly-v0", **options))
