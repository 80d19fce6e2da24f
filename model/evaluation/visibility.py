"""Which part of a map was seen how: a class for every voxel."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lidarsim import GridSpec, Sensor
from scenegen.model.inputs import within_view
from scenegen.sample import Sample

CLASSES = ("observed", "crossed", "occluded", "interior", "out_of_view")
"""How a voxel was seen. An `observed` voxel holds a return. A `crossed` one holds none, and some ray passes through it.
All others are unknown: an `interior` voxel is occupied, and so are its six neighbours; an `occluded` one lies on the
way of some ray that ended before it; an `out_of_view` one lies on the way of none."""
UNOBSERVED = tuple(CLASSES.index(name) for name in ("occluded", "interior", "out_of_view"))
"""The classes of unknown voxels: neither observed nor crossed."""


def classify(sample: Sample, *, lidar: Sensor, grid: GridSpec) -> NDArray[np.uint8]:
    """The class of every voxel of a sample, (*grid.shape), as an index into `CLASSES`."""
    in_view = within_view(sample, grid, lidar)
    classes = np.where(in_view, np.uint8(CLASSES.index("occluded")), np.uint8(CLASSES.index("out_of_view")))
    six = ndimage.generate_binary_structure(3, 1)
    inside = ndimage.binary_erosion(sample.occupancy, six, border_value=1)  # beyond the map counts as occupied
    classes[inside] = CLASSES.index("interior")
    classes[sample.free] = CLASSES.index("crossed")
    classes[sample.observed] = CLASSES.index("observed")
    return classes
