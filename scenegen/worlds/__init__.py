"""Worlds: what an MJCF document or a map holds, where one may fly in it, and what stands where."""

import zipfile
from pathlib import Path

MAPS = (".bt", ".ot", ".npz")
"""How the names of maps of real places end."""
CLOUDS = (".ply", ".pcd", ".las", ".laz", ".xyz", ".npy", ".yaml")
"""How the names of point clouds end, and of ROS's plans, which become maps. `scenegen map` reads
all that `scenegen.clouds.READERS` names; an .npz file is taken for a map here."""
MESHES = (".obj", ".glb", ".stl")
"""How the names of meshes end that are worlds of their own."""
WORLD_FILES = (".xml", *MAPS, *CLOUDS, *MESHES)
"""How the names of all files end that are worlds."""


def is_map(path: Path) -> bool:
    """Whether a file is a map of a real place by its name; an .npz file, which may be a scan, by
    what it holds, too."""
    if path.suffix != ".npz":
        return path.suffix in MAPS
    if not path.is_file():  # a pipe would never end
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return "states.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
