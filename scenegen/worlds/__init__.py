"""Worlds: what an MJCF document or a map holds, where one may fly in it, and what stands where."""
