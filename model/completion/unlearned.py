"""The methods that need no learning: what a network has to beat."""

import numpy as np
from scipy import ndimage

from lidarsim.grid import GridSpec, Mask
from scenegen.model.completion.protocol import Prediction

UPRIGHT = np.zeros((3, 3, 3), bool)
UPRIGHT[1, 1] = True
"""A voxel's neighbours in its column."""


class Returns:
    """Occupied where something returned, free elsewhere: what a robot does that trusts its map as
    it is."""

    name = "returns"
    learned = False

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`."""
        return Prediction(occupancy_probability=observed.astype(np.float32))


class Empty:
    """Free everywhere, every distance at the truncation: how much success needs no map."""

    name = "empty"
    learned = False

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`."""
        return Prediction(occupancy_probability=np.zeros(observed.shape, np.float32))


class Conservative:
    """Whatever no ray crossed is occupied: what a robot does that trusts nothing unseen."""

    name = "conservative"
    learned = False

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`."""
        return Prediction(occupancy_probability=(~free).astype(np.float32))


class Extrude:
    """Returns, extended up and down their columns through unknown voxels until a free one: what a
    network for pillars has to beat."""

    name = "extrude"
    learned = False

    def complete(self, observed: Mask, free: Mask, *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`."""
        runs, count = ndimage.label(~free, UPRIGHT)
        met = np.zeros(count + 1, np.float32)
        met[runs[observed & ~free]] = 1.0
        return Prediction(occupancy_probability=met[runs])
