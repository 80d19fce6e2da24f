"""Which voxels of a sample count in scores: one rule for the bench, pages and pictures."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lidarsim.grid import Field, GridSpec, Mask
from scenegen.draw.sample import Sample


def scored_voxels(sample: Sample, grid: GridSpec, world: Mapping[str, Any] | None) -> Mask:
    """Which voxels of a map, (*grid.shape), scores count: those that reach above the underside of
    the ground slab, all where the world has none; and in a map of a real place those that are
    known. `world` is the table of the sample's recipe, None for worlds from files.

    No sensor sees below the ground and no robot flies there, so what is said of that space is
    neither right nor wrong.
    """
    world = world or {}
    thick_m = world.get("ground_m")  # parameters of somebody's own kind may be anything
    bottom = -math.inf
    if world.get("ground") is True and isinstance(thick_m, int | float):
        bottom = -thick_m
    tops = sample.origin[2] + grid.voxel_m * np.arange(1, grid.shape[2] + 1)
    # a layer that ends at the underside does not count, however it is rounded
    layers = tops > bottom + 1e-6
    known = np.ones(grid.shape, bool) if sample.known is None else sample.known
    return known & layers


def certain_distances(tudf: Field, known: Mask | None, grid: GridSpec) -> Mask | None:
    """The voxels (*grid.shape) whose true distance `tudf` is certain: no unknown voxel is nearer
    than the nearest `known` to be occupied. None if all is known."""
    if known is None:
        return None
    from scenegen.truth import distance_field  # which compiles

    return tudf <= distance_field(~known, grid)
