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


def check_suffix(path: Path) -> None:
    """Raise DatasetError for a name that says none of the kinds."""
    if path.suffix not in SUFFIXES:
        raise DatasetError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")


def write_points(
    path: Path,
    points: NDArray[np.float64],
    intensity: NDArray[np.float64] | None,
    about: Mapping[str, Any],
) -> None:
    """Write points (M, 3), metres, with their intensities (M,), if there are any, in the kind of
    file that the name says.

    An .npz holds `about`, too: arrays and texts by name. A .bin has intensities of 0 where there
    are none. Raises DatasetError as `check_suffix`.
    """
    check_suffix(path)
    content = encode_points(path.suffix, points, intensity, about)
    write_result(path, content)


def encode_points(
    suffix: str,
    points: NDArray[np.float64],
    intensity: NDArray[np.float64] | None = None,
    about: Mapping[str, Any] | None = None,
) -> bytes:
    """What a file of the kind `suffix` holds; see `write_points`."""
    if suffix == ".npz":
        file = io.BytesIO()
        more = {} if intensity is None else {"intensity": intensity}
        np.savez_compressed(file, allow_pickle=False, points=points, **more, **(about or {}))
        return file.getvalue()
    columns = {name: points[:, n] for n, name in enumerate("xyz")}
    if intensity is not None or suffix == ".bin":
        columns["intensity"] = np.zeros(len(points)) if intensity is None else intensity
    content = np.stack(list(columns.values()), axis=1).astype("<f4").tobytes()
    if suffix == ".bin":
        return content
    count, names = len(points), list(columns)
    if suffix == ".ply":
        properties = "".join(f"property float {name}\n" for name in names)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    else:
        rows = {
            "FIELDS": names,
            "SIZE": ["4"] * len(names),
            "TYPE": ["F"] * len(names),
            "COUNT": ["1"] * len(names),
        }
        lines = "".join(f"{key} {' '.join(row)}\n" for key, row in rows.items())
        head = f"VERSION 0.7\n{lines}WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    return head.encode() + content
