"""How a quadrotor leans: its attitude from the acceleration of its flight.

A quadrotor's thrust is along its body's z axis, so that its acceleration decides which way that
axis points, and its heading is free (Mellinger and Kumar 2011, ICRA, section III).
"""

import math

import numpy as np
from numpy.typing import NDArray

from lidarsim import Pose
from lidarsim.elementary import sin_cos

GRAVITY = 9.81
"""Metres a second squared."""
LEAST_THRUST = 0.5
"""The vertical part of the thrust, a share of what hovering takes, is never less."""


def acceleration(
    turns: NDArray[np.float64],
    ends_m: NDArray[np.float64],
    flown_m: float,
    *,
    speed_mps: float,
    settle_s: float,
) -> tuple[float, float, float]:
    """Acceleration, metres a second squared, `flown_m` along a path of straight legs that is flown
    at `speed_mps`.

    `turns` (n, 3) say how the direction, a unit vector, changes at the path's points, `ends_m` (n,)
    along it. Each change of velocity is spread over `settle_s` before and after, by a triangle:
    this is the second derivative of the path smoothed by that triangle.
    """
    total = [0.0, 0.0, 0.0]
    for turn, end in zip(turns.tolist(), ends_m.tolist(), strict=True):
        share = 1.0 - abs((flown_m - end) / speed_mps) / settle_s
        if share > 0.0:
            for axis in range(3):
                total[axis] += speed_mps * turn[axis] * share / settle_s
    return total[0], total[1], total[2]


def leaning(pose: Pose, pull: tuple[float, float, float], *, most_deg: float) -> Pose:
    """The level `pose` of a body that accelerates by `pull`, metres a second squared, as its thrust
    has it: turned the shortest way, so that its heading stays. It leans by `most_deg` at most."""
    up = max(GRAVITY + pull[2], LEAST_THRUST * GRAVITY)
    w, _, _, z = pose.quaternion.tolist()
    cosine, sine = w * w - z * z, 2 * w * z
    forward, left = cosine * pull[0] + sine * pull[1], cosine * pull[1] - sine * pull[0]
    sideways = math.sqrt(forward * forward + left * left)
    most_sine, most_cosine = (float(value) for value in sin_cos(math.radians(most_deg)))
    if sideways * most_cosine > up * most_sine:
        share = up * most_sine / (most_cosine * sideways)
        forward, left = forward * share, left * share
    length = math.sqrt(forward * forward + left * left + up * up)
    half = math.sqrt(0.5 + 0.5 * up / length)
    x, y = -left / (2 * half * length), forward / (2 * half * length)
    return Pose(pose.position, np.array([w * half, w * x - z * y, w * y + z * x, z * half]))
