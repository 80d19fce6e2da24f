"""Worlds: what an MJCF document holds, where one may fly in it, and what stands where."""
