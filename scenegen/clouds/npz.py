"""NumPy's archives of arrays, read with bounded memory, and written with reproducible bytes."""

import io
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from lidarsim.sensors.table import read_npy
from scenegen.clouds.columns import short_list


def read_npz(content: bytes, *names: str, max_bytes: int) -> list[np.ndarray]:
    """Read the arrays `names` of an archive, each of at most `max_bytes` bytes.

    Raises:
        ValueError: An array is missing or too large.
        Exception: Whatever a crafted file leads to.
    """
    arrays = list[np.ndarray]()
    with zipfile.ZipFile(io.BytesIO(content)) as members:
        for name in names:
            if f"{name}.npy" not in members.namelist():
                raise ValueError(_missing(name, members.namelist()))
            member = members.getinfo(f"{name}.npy")
            if member.file_size > max_bytes:
                raise ValueError(
                    f"{name} of {member.file_size} bytes, expected {max_bytes} at most"
                )
            arrays.append(read_npy(members.read(member)))
    return arrays


def _missing(name: str, members: list[str]) -> str:
    """The message for an archive without the array `name`."""
    if "states.npy" in members:  # see `scenegen.worlds.place`
        return (
            f"a map that scenegen map made, expected an array {name}; scenegen inspect tells of "
            "maps, scan and generate --scene fly through them"
        )
    arrays = [member.removesuffix(".npy") for member in members]
    return f"holds {short_list(arrays) or 'nothing'}, expected an array {name}"


def encode_npz(fields: Mapping[str, Any], level: int = 1) -> bytes:
    """Encode arrays and texts by name as an archive: the same bytes whenever it is made.

    A zlib `level` of 1 is several times as fast as the usual one.
    """
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as members:
        for name, values in fields.items():
            with members.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
    return file.getvalue()
