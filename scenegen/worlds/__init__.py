"""Worlds: MJCF documents and maps, the flights in them, and the classes of their solids."""
