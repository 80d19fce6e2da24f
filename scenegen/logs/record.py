"""A log recorded in a world: the scans of a sensor along a flight, at the sensor's own rate."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from lidarsim import Pose, Sensor, cast
from lidarsim.engines import Caster
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Motion
from lidarsim.pose import rotate
from scenegen.draw import observed
from scenegen.logs import LogScan
from scenegen.worlds.world import AnyWorld

USUAL_S = 0.1
"""From scan to scan, of a sensor that does not say."""


def period_s(sensor: Sensor) -> float:
    """Seconds from one scan to the next: by the sensor's `rate_hz`, or as long as a scan takes."""
    rate = getattr(sensor, "rate_hz", 0.0)
    return 1.0 / rate if rate else float(np.max(sensor.times_s)) or USUAL_S


def record(
    world: AnyWorld,
    caster: Caster,
    sensor: Sensor,
    poses: Sequence[Pose],
    noise: Noise,
    *,
    seed: int,
    moving: bool = False,
    corrected: bool = False,
) -> Iterator[LogScan]:
    """The scans of a log.

    Args:
        world: The world.
        caster: What casts rays in it.
        sensor: The sensor.
        poses: The body's, level, one `period_s` after the other.
        noise: What becomes of the clean ranges.
        seed: What the noise is drawn by.
        moving: Whether each ray is cast from where the sensor is when its turn comes, instead of
            all at once when the scan begins. The motion is even from pose to pose.
        corrected: With `moving`: whether points are where the rays met them, seen from the pose at
            which the scan began, and not where a sensor that stands still would have met them.

    Raises:
        GenerationError: The noise does not suit.
    """
    every, arm = period_s(sensor), getattr(sensor, "lever_arm_m", (0.0, 0.0, 0.0))
    rings = np.broadcast_to(np.arange(sensor.shape[0])[:, None], (*sensor.shape[:1], 1))
    for number, pose in enumerate(poses):
        chain = noise
        if moving:
            first = min(number, len(poses) - 2)
            pace = _pace(poses[first], poses[first + 1], every, corrected)
            chain = Noise((pace, *noise.stages))
        rng = np.random.default_rng([seed, number])
        seen = observed(cast(caster, sensor, pose), chain, world.albedo, caster, rng)
        at = Pose(pose.position + rotate(pose.quaternion, [arm])[0], pose.quaternion)
        points = np.concatenate([seen.points(echo) for echo in range(len(seen.ranges))])
        hit = np.isfinite(seen.ranges)
        times = np.broadcast_to(sensor.times_s * moving, hit.shape)
        more = {"t": times[hit].astype(np.float32)}
        if seen.intensity is not None:
            more["intensity"] = seen.intensity[hit].astype(np.float32)
        if len(sensor.shape) == 2:
            more["ring"] = np.broadcast_to(rings, hit.shape)[hit].astype(np.uint16)
        yield LogScan(number * every, at, at.to_body(points), more)


def _pace(here: Pose, there: Pose, every_s: float, corrected: bool) -> Any:
    """The arc from one level pose to the next."""
    yaws = [2.0 * math.atan2(pose.quaternion[3], pose.quaternion[0]) for pose in (here, there)]
    turn = math.remainder(yaws[1] - yaws[0], math.tau)
    # the chord of an arc points halfway between its ends, `Motion` where it begins
    halfway = Pose.level((0.0, 0.0, 0.0), -(yaws[0] + turn / 2)).quaternion
    moved = rotate(halfway, [there.position - here.position])[0] / every_s
    forward, left, up = moved.tolist()
    return Motion(
        forward_mps=forward,
        left_mps=left,
        up_mps=up,
        yaw_rate_deg_s=math.degrees(turn) / every_s,
        corrected=corrected,
    )
