"""The methods that need no learning: what a network has to beat."""

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from lidarsim.jit import kernel
from scenegen.model.completion.protocol import Prediction


class Returns:
    """Occupied where something returned, free elsewhere: what a robot does that trusts its map as
    it is."""

    name = "returns"
    learned = False

    def complete(
        self, observed: NDArray[np.bool_], free: NDArray[np.bool_], *, grid: GridSpec
    ) -> Prediction:
        """See `MapCompleter.complete`."""
        return Prediction(occupancy_probability=observed.astype(np.float32))


class Conservative:
    """Whatever no ray crossed is occupied: what a robot does that trusts nothing unseen."""

    name = "conservative"
    learned = False

    def complete(
        self, observed: NDArray[np.bool_], free: NDArray[np.bool_], *, grid: GridSpec
    ) -> Prediction:
        """See `MapCompleter.complete`."""
        return Prediction(occupancy_probability=(~free).astype(np.float32))


class Extrude:
    """Returns, extended up and down their columns through unknown voxels until a free one: what a
    network for pillars has to beat."""

    name = "extrude"
    learned = False

    def complete(
        self, observed: NDArray[np.bool_], free: NDArray[np.bool_], *, grid: GridSpec
    ) -> Prediction:
        """See `MapCompleter.complete`."""
        extended = np.zeros(observed.shape, dtype=np.float32)
        _extend(observed, free, extended)
        return Prediction(occupancy_probability=extended)


@kernel
def _extend(observed, free, extended):
    """Set to 1 every run of voxels along z that holds no free one and at least one observed."""
    nx, ny, nz = observed.shape
    for i in range(nx):
        for j in range(ny):
            start = 0
            seen = False
            for k in range(nz + 1):
                if k == nz or free[i, j, k]:
                    if seen:
                        extended[i, j, start:k] = 1.0
                    start, seen = k + 1, False
                elif observed[i, j, k]:
                    seen = True
