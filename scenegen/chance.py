"""Random draws whose bits are the same on every processor: no library's sine, exponential or
logarithm is in them.

Uniform and whole numbers come straight from numpy's generator, which makes them by exact
arithmetic. Its normal draws do not serve: their tails go through the mathematical library.
"""

import numpy as np
from numpy.typing import NDArray

from lidarsim.elementary import exp, log


def log_uniform(low: float, high: float, *, rng: np.random.Generator) -> float:
    """One number between `low` and `high`, both above 0, whose logarithm is uniform."""
    return float(exp(rng.uniform(*log([low, high]))))


def normal(shape: tuple[int, ...], *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Standard normal numbers of any shape, two from each point of a disc (Marsaglia's polar
    method)."""
    count = int(np.prod(shape))
    points, square = _disc((count + 1) // 2, rng=rng)
    return (
        (points * np.sqrt(-2.0 * log(square) / square)[:, None]).reshape(-1)[:count].reshape(shape)
    )


def attitudes(count: int, tilted_share: float, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Unit quaternions (count, 4), w x y z: uniform over all attitudes for a share (Marsaglia
    1972), turned about the vertical alone for the rest."""
    tilted = rng.random(count) < tilted_share
    turn, square = _disc(count, rng=rng)
    tilt, other = _disc(count, rng=rng)
    tilt *= np.where(tilted, np.sqrt((1.0 - square) / other), 0.0)[:, None]
    turn /= np.where(tilted, 1.0, np.sqrt(square))[:, None]
    return np.stack([turn[:, 0], tilt[:, 0], tilt[:, 1], turn[:, 1]], axis=1)


def _disc(
    count: int, *, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (count, 2) uniform in the unit disc less its centre, and their squared distances
    (count,) from it."""
    points, square = np.zeros((count, 2)), np.zeros(count)
    missing = np.arange(count)
    while len(missing):
        drawn = 2.0 * rng.random((len(missing), 2)) - 1.0
        points[missing] = drawn
        square[missing] = drawn[:, 0] * drawn[:, 0] + drawn[:, 1] * drawn[:, 1]
        missing = missing[(square[missing] >= 1.0) | (square[missing] == 0.0)]
    return points, square
