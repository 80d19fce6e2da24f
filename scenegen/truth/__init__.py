"""Ground truth: the voxels that the solids of a compiled model fill, and distances to the nearest
one."""

from scenegen.truth.distance import distance_field
from scenegen.truth.occupancy import rasterize

__all__ = ["distance_field", "rasterize"]
