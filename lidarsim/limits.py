"""How large things may be that a sensor and its engine handle. `scenegen.limits` has those of
worlds and datasets."""

MOST_RAYS = 1_000_000
"""The most rays of one scan."""
LEAST_RANGE_M, MOST_RANGE_M = 1e-3, 1e4
"""A range is stored in float32, which here still tells millimetres apart."""
MOST_LENGTH_M = 1e6
"""Sizes and places in a world, metres: float64 then keeps a tenth of a nanometre."""
MOST_TRIANGLES = 5_000_000
"""The most triangles of a world's meshes and height fields, each counted as often as a geom uses
it: 360 MB."""
