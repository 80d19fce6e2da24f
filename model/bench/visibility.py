"""Which part of a map was seen how: a class for every voxel."""

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose, Scan, Sensor, voxelize
from scenegen.sample import Sample

CLASSES = ("observed", "crossed", "occluded", "interior", "out_of_view")
"""observed: holds a return · crossed: free by some ray · interior: never seen, inside a solid, all six neighbours
occupied · occluded: a ray would come by if nothing stood in its way · out_of_view: no ray of the sensor comes by."""
UNOBSERVED = tuple(CLASSES.index(name) for name in ("occluded", "interior", "out_of_view"))
"""The classes of unknown voxels: neither observed nor crossed."""


def classify(sample: Sample, *, lidar: Sensor, grid: GridSpec) -> NDArray[np.uint8]:
    """The class of every voxel of a sample, (*grid.shape), as an index into `CLASSES`."""
    nothing = np.full(lidar.shape, np.inf, dtype=np.float32)
    within_view = voxelize(Scan(nothing, Pose(sample.position, sample.quaternion), lidar), grid, sample.origin).free
    classes = np.where(within_view, np.uint8(CLASSES.index("occluded")), np.uint8(CLASSES.index("out_of_view")))
    classes[_interior(sample.occupancy)] = CLASSES.index("interior")
    classes[sample.free] = CLASSES.index("crossed")
    classes[sample.observed] = CLASSES.index("observed")
    return classes


def _interior(occupancy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Occupied voxels whose six neighbours are occupied; beyond the map counts as occupied."""
    inside = occupancy.copy()
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        inside[tuple(behind)] &= occupancy[tuple(ahead)]
        inside[tuple(ahead)] &= occupancy[tuple(behind)]
    return inside
