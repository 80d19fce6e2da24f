"""What a map is worth: a path planned on it, refined on it, and measured in the truth.

All coordinates here are in the map frame: metres from the grid's least corner, axes as the world's.
"""
