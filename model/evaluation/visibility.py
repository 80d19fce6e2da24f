"""Which part of a map was seen how: a class for every voxel."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lidarsim import GridSpec, Sensor
from scenegen.model.inputs import within_view
from scenegen.sample import Sample

CLASSES = ("observed", "crossed", "occluded", "interior", "out_of_view")
"""How a voxel was seen. An `observed` voxel holds a return. A `crossed` one holds none, and some
ray passes through it. All others are unknown: an `interior` voxel is occupied, and so are its six
neighbours; an `occluded` one lies on the way of some ray that ended before it; an `out_of_view` one
lies on the way of none."""
UNOBSERVED = tuple(CLASSES.index(name) for name in ("occluded", "interior", "out_of_view"))
"""The classes of unknown voxels: neither observed nor crossed."""
UNSCORED = 255
"""Stands in place of a class where a voxel lies below the ground: no score counts it."""


def scored_layers(sample: Sample, grid: GridSpec, tables: Mapping[str, Any]) -> NDArray[np.bool_]:
    """Which layers of a map, (grid.shape[2],) from below, scores count: those that reach above the
    underside of the ground slab, all where the world has none. `tables` are those of the sample's
    recipe.

    No sensor sees below the ground and no robot flies there, so what is said of that space is
    neither right nor wrong.
    """
    world = tables.get("world") or {}
    thick_m = world.get("ground_m")  # parameters of somebody's own kind may be anything
    bottom = -math.inf
    if world.get("ground") is True and isinstance(thick_m, int | float):
        bottom = -thick_m
    tops = sample.origin[2] + grid.voxel_m * np.arange(1, grid.shape[2] + 1)
    # a layer that ends at the underside does not count, however it is rounded
    return np.asarray(tops > bottom + 1e-6)


def classify(
    sample: Sample, *, lidar: Sensor, grid: GridSpec, scored: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """The class of every voxel of a sample, (*grid.shape), as an index into `CLASSES`; `UNSCORED`
    in the layers that are not `scored`, where these are given."""
    in_view = within_view(sample, grid, lidar)
    classes = np.where(
        in_view, np.uint8(CLASSES.index("occluded")), np.uint8(CLASSES.index("out_of_view"))
    )
    six = ndimage.generate_binary_structure(3, 1)
    inside = ndimage.binary_erosion(
        sample.occupancy, six, border_value=1
    )  # beyond the map counts as occupied
    classes[inside] = CLASSES.index("interior")
    classes[sample.free] = CLASSES.index("crossed")
    classes[sample.observed] = CLASSES.index("observed")
    if scored is not None:
        classes[..., ~scored] = UNSCORED
    return classes
