"""Clouds of points as files: .ply and .pcd (binary), .npz (NumPy), and .bin (x y z intensity,
float32, as in KITTI)."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen.errors import DatasetError
from scenegen.files import write_result

SUFFIXES = (".ply", ".pcd", ".npz", ".bin")
"""Kinds of files."""


def write_points(
    path: Path,
    points: NDArray[np.float64],
    intensity: NDArray[np.float64] | None = None,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Writes points in the kind of file that the name says.

    Args:
        path: The file.
        points: Positions (M, 3), metres.
        intensity: Of each point (M,), if there is any; a .bin has 0 where there is none.
        about: Arrays and texts by name that an .npz holds, too. Where `frame` is "world", a .pcd
            has `position` as its viewpoint.

    Raises:
        DatasetError: The name says none of the kinds.
    """
    if path.suffix not in SUFFIXES:
        raise DatasetError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    write_result(path, encode_points(path.suffix, points, intensity, about))


def encode_points(
    suffix: str,
    points: NDArray[np.float64],
    intensity: NDArray[np.float64] | None = None,
    about: Mapping[str, Any] | None = None,
) -> bytes:
    """What a file of the kind `suffix` holds; for the arguments see `write_points`."""
    if suffix == ".npz":
        file = io.BytesIO()
        more = {} if intensity is None else {"intensity": intensity}
        np.savez_compressed(file, allow_pickle=False, points=points, **more, **(about or {}))
        return file.getvalue()
    names, columns = ["x", "y", "z"], [points]
    if intensity is not None or suffix == ".bin":
        names.append("intensity")
        columns.append(np.zeros((len(points), 1)) if intensity is None else intensity[:, None])
    content = np.concatenate(columns, axis=1).astype("<f4").tobytes()
    count, fields = len(points), len(names)
    match suffix:
        case ".ply":
            head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
            head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
        case ".pcd":
            head = (
                f"VERSION 0.7\nFIELDS {' '.join(names)}\nSIZE{' 4' * fields}\nTYPE{' F' * fields}"
            )
            stood = "0 0 0"
            if about and about.get("frame") == "world":
                stood = " ".join(map(repr, about["position"].tolist()))
            head += f"\nCOUNT{' 1' * fields}\nWIDTH {count}\nHEIGHT 1\n"
            head += f"VIEWPOINT {stood} 1 0 0 0\nPOINTS {count}\nDATA binary\n"
        case _:
            head = ""
    return head.encode() + content
