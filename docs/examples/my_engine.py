"""A ray engine of your own: MuJoCo's function for one ray."""

import mujoco
import numpy as np


class OneByOne:
    """Each ray by MuJoCo's own function for one ray: slow, and simple."""

    def __init__(self, model, data):
        self.model, self.data = model, data

    @classmethod
    def of(cls, model, data=None):
        """The engine of a compiled world, as `data` stands where given."""
        if data is None:
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
        return cls(model, data)

    def cast(self, origins, directions, max_range_m):
        """Metres (P, *shape) along unit vectors (P, *shape, 3) from origins (P, 3), world
        frame; inf where nothing is."""
        ranges = np.full(directions.shape[:-1], np.inf)
        geom = np.zeros(1, np.int32)
        for place in np.ndindex(ranges.shape):
            origin, ray = origins[place[0]], directions[place]
            found = mujoco.mj_ray(self.model, self.data, origin, ray, None, True, -1, geom, None)
            if 0.0 <= found <= max_range_m:
                ranges[place] = found
        return ranges
