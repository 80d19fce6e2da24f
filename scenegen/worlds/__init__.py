"""Worlds: what an MJCF document holds, where one may fly in it, and what stands where."""

MAPS = (".bt", ".ot")
"""How the names of maps of real places end."""
