"""Which voxels of a sample are scored. The bench, pages and pictures share this rule."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lidarsim.grid import Field, GridSpec, Mask
from scenegen.draw.sample import Sample


def scored_voxels(sample: Sample, grid: GridSpec, world: Mapping[str, Any] | None) -> Mask:
    """Select the voxels that are scored: those above the underside of the ground slab (all, if the
    world has none), and in a map of a real place only those that are known.

    No sensor sees below the ground, and no robot flies there, so predictions there are neither
    right nor wrong.

    Args:
        sample: The sample.
        grid: Its grid.
        world: Table `world` of the sample's recipe; None for worlds from files.

    Returns:
        Mask (*grid.shape).
    """
    world = world or {}
    thick_m = world.get("ground_m")  # in a user's own kind, it may have any type
    bottom = -math.inf
    if world.get("ground") is True and isinstance(thick_m, int | float):
        bottom = -thick_m
    tops = sample.origin[2] + grid.voxel_m * np.arange(1, grid.shape[2] + 1)
    # a layer that ends at the underside does not count, however it is rounded
    layers = tops > bottom + 1e-6
    known = np.ones(grid.shape, bool) if sample.known is None else sample.known
    return known & layers


def certain_distances(tudf: Field, known: Mask | None, grid: GridSpec) -> Mask | None:
    """Select the voxels whose true distance is certain: no unknown voxel is nearer than the nearest
    known occupied one.

    Args:
        tudf: True distances (*grid.shape), metres.
        known: Mask of known voxels; None if all are known.
        grid: The grid.

    Returns:
        Mask (*grid.shape); None if all are known.
    """
    if known is None:
        return None
    from scenegen.truth import distance_field  # compiles kernels, which most callers need not

    return tudf <= distance_field(~known, grid)
