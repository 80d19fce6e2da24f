"""What is really there: which voxels the solids of a compiled model fill, and how far the nearest
one is."""

from scenegen.truth.distance import distance_field
from scenegen.truth.occupancy import rasterize

__all__ = ["distance_field", "rasterize"]
