"""Points and arrays as files: NumPy's archives, read with bounded memory and written with
reproducible bytes; and points as .ply and .pcd (binary), .npz, .bin (x y z intensity, float32, as
in KITTI)."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.grid import Floats
from lidarsim.sensors.table import read_npy
from scenegen.base.files import write_result
from scenegen.worlds.clouds.columns import short_list


def read_npz(content: bytes, *names: str, max_bytes: int) -> list[np.ndarray]:
    """Read arrays of an archive.

    Args:
        content: The archive's bytes.
        names: Of the arrays.
        max_bytes: The greatest size of each.

    Returns:
        The arrays, in the order of `names`.

    Raises:
        ValueError: If an array is missing or too large.
        Exception: Whatever a crafted file leads to.
    """
    arrays = list[np.ndarray]()
    with zipfile.ZipFile(io.BytesIO(content)) as members:
        for name in names:
            if f"{name}.npy" not in members.namelist():
                raise ValueError(_missing(name, members.namelist()))
            member = members.getinfo(f"{name}.npy")
            # before it is unpacked: a small archive may unpack to gigabytes
            if member.file_size > max_bytes:
                raise ValueError(
                    f"{name} of {member.file_size} bytes, expected {max_bytes} at most"
                )
            arrays.append(read_npy(members.read(member)))
    return arrays


def _missing(name: str, members: list[str]) -> str:
    """Word the message for an archive without the array `name`."""
    if "states.npy" in members and name == "points":  # see `scenegen.worlds.place`
        return (
            f"a map that scenegen map made, expected an array {name}; scenegen inspect tells of "
            "maps, scan and generate --scene fly through them"
        )
    arrays = [member.removesuffix(".npy") for member in members]
    return f"holds {short_list(arrays) or 'nothing'}, expected an array {name}"


def encode_npz(fields: Mapping[str, Any], level: int = 1) -> bytes:
    """Encode arrays and texts as an archive: the same bytes whenever it is made.

    Args:
        fields: Arrays and texts by name.
        level: Of zlib; 1 is several times as fast as the default.

    Returns:
        The archive's bytes.
    """
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as members:
        for name, values in fields.items():
            # opened by name, a member gets the epoch as its date, not the current time
            with members.open(f"{name}.npy", "w") as member:
                # a pickle runs code when it is read, so objects are refused
                np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
    return file.getvalue()


SUFFIXES = (".ply", ".pcd", ".bin", ".npz")
"""File types that `write_points` writes."""


def write_points(
    path: Path,
    points: Floats,
    intensity: Floats | None,
    about: Mapping[str, Any],
) -> None:
    """Write points in the file type of the path's suffix, one of `SUFFIXES`.

    Args:
        path: The file.
        points: Positions (M, 3), metres.
        intensity: Of each point (M,), if there is any; a .bin has 0 without it.
        about: Further arrays and texts by name, for an .npz. If `frame` is "world", a .pcd has
            `sensor_position` as its viewpoint.
    """
    write_result(path, encode_points(path.suffix, points, intensity, about))


def encode_points(
    suffix: str,
    points: Floats,
    intensity: Floats | None = None,
    about: Mapping[str, Any] | None = None,
) -> bytes:
    """Encode points as a file.

    Args:
        suffix: The file type, one of `SUFFIXES`.
        points, intensity, about: As for `write_points`.

    Returns:
        The file's bytes.
    """
    about = about or {}
    if suffix == ".npz":
        optional = {} if intensity is None else {"intensity": intensity}
        return encode_npz({"points": points, **optional, **about})
    names, columns = ["x", "y", "z"], [points]
    # KITTI's readers expect four numbers a point, so a .bin has a column of zeros without it
    if intensity is not None or suffix == ".bin":
        names.append("intensity")
        columns.append(np.zeros((len(points), 1)) if intensity is None else intensity[:, None])
    head, count, width = "", len(points), len(names)
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
SIZE{" 4" * width}
TYPE{" F" * width}
COUNT{" 1" * width}
WIDTH {count}
HEIGHT 1
VIEWPOINT {stood} 1 0 0 0
POINTS {count}
DATA binary
"""
    return head.encode() + np.concatenate(columns, axis=1).astype("<f4").tobytes()
