"""Shapes as data: the floor that engines and truth share.

Where a ray meets a solid is decided in `lidarsim.engines`, which voxels touch it in
`scenegen.truth`. The two share this table and nothing else, so that each can check the other.
"""
