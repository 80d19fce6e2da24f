"""Points in files: .ply and .pcd (binary), .npz (NumPy), .bin (x y z intensity, float32, as in
KITTI)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.grid import Floats
from scenegen.clouds.npz import encode_npz
from scenegen.files import write_result

SUFFIXES = (".ply", ".pcd", ".bin", ".npz")
"""Kinds of files."""


def write_points(
    path: Path,
    points: Floats,
    intensity: Floats | None,
    about: Mapping[str, Any],
) -> None:
    """Writes points in the kind of file that the name says, one of `SUFFIXES`.

    Args:
        path: The file.
        points: Positions (M, 3), metres.
        intensity: Of each point (M,), if there is any; a .bin has 0 where there is none.
        about: Arrays and texts by name that an .npz holds, too. Where `frame` is "world", a .pcd
            has `sensor_position` as its viewpoint.
    """
    write_result(path, encode_points(path.suffix, points, intensity, about))


def encode_points(
    suffix: str,
    points: Floats,
    intensity: Floats | None = None,
    about: Mapping[str, Any] | None = None,
) -> bytes:
    """What a file of the kind `suffix` holds; for the arguments see `write_points`."""
    about = about or {}
    if suffix == ".npz":
        more = {} if intensity is None else {"intensity": intensity}
        return encode_npz({"points": points, **more, **about})
    names, columns = ["x", "y", "z"], [points]
    if intensity is not None or suffix == ".bin":
        names.append("intensity")
        columns.append(np.zeros((len(points), 1)) if intensity is None else intensity[:, None])
    head, count, many = "", len(points), len(names)
    if suffix == ".ply":
        properties = "".join(f"property float {name}\n" for name in names)
        head = f"""ply
format binary_little_endian 1.0
element vertex {count}
{properties}end_header
"""
    elif suffix == ".pcd":
        place = about["sensor_position"].tolist() if about.get("frame") == "world" else (0, 0, 0)
        stood = " ".join(map(repr, place))
        head = f"""VERSION 0.7
FIELDS {" ".join(names)}
SIZE{" 4" * many}
TYPE{" F" * many}
COUNT{" 1" * many}
WIDTH {count}
HEIGHT 1
VIEWPOINT {stood} 1 0 0 0
POINTS {count}
DATA binary
"""
    return head.encode() + np.concatenate(columns, axis=1).astype("<f4").tobytes()
