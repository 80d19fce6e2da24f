"""Clouds of points as files: .ply and .pcd (binary), .npz (NumPy) and .bin (x y z intensity in float32, as KITTI has
them)."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen.errors import DatasetError
from scenegen.files import make_parent, write_whole

SUFFIXES = (".ply", ".pcd", ".npz", ".bin")
"""Kinds of files."""


def check_suffix(path: Path) -> None:
    """Raise DatasetError for a name that says none of the kinds."""
    if path.suffix not in SUFFIXES:
        raise DatasetError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")


def write_points(
    path: Path, points: NDArray[np.float64], intensity: NDArray[np.float64] | None, about: Mapping[str, Any]
) -> None:
    """Write points (M, 3), metres, with their intensities (M,), if there are any, in the kind of file that the name
    says.

    An .npz holds `about`, too: arrays and texts by name. A .bin has intensities of 0 where there are none. Raises
    DatasetError as `check_suffix`.
    """
    check_suffix(path)
    columns = {name: points[:, n] for n, name in enumerate("xyz")}
    if intensity is not None or path.suffix == ".bin":
        columns["intensity"] = np.zeros(len(points)) if intensity is None else intensity
    table = np.stack(list(columns.values()), axis=1).astype("<f4")
    content = table.tobytes()
    if path.suffix == ".ply":
        properties = "".join(f"property float {name}\n" for name in columns)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
        content = head.encode() + content
    elif path.suffix == ".pcd":
        each = len(columns)
        head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(columns)}\nSIZE{' 4' * each}\nTYPE{' F' * each}\n"
        head += f"COUNT{' 1' * each}\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        content = f"{head}POINTS {len(points)}\nDATA binary\n".encode() + content
    elif path.suffix == ".npz":
        file = io.BytesIO()
        more = {} if intensity is None else {"intensity": intensity}
        np.savez_compressed(file, allow_pickle=False, points=points, **more, **about)
        content = file.getvalue()
    make_parent(path)
    write_whole(path, content)
