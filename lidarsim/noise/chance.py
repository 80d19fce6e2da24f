"""Normal numbers with the same bits on every processor: numpy's own go through the mathematical
library."""

import math

import numpy as np
from numpy.typing import NDArray

from lidarsim.elementary import log, sin_cos


def normal(shape: tuple[int, ...], *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Standard normal numbers of any shape, two of each pair of even ones (Box and Muller 1958)."""
    count = math.prod(shape)
    length, angle = rng.random((2, (count + 1) // 2))
    sine, cosine = sin_cos(2 * math.pi * angle)
    both = np.sqrt(-2.0 * log(1.0 - length)) * np.stack([cosine, sine])
    return both.reshape(-1)[:count].reshape(shape)
