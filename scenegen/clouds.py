"""Point clouds on disk, read here so that no file takes more memory than it has content."""

import io
import itertools
import os
import re
import warnings
import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.grid import Floats
from lidarsim.jit import kernel
from lidarsim.sensors.table import read_npy
from scenegen.errors import DatasetError, needs, printable
from scenegen.files import read_bounded
from scenegen.limits import (
    GUARD_BYTES,
    GUARD_S,
    MOST_CLOUD_BYTES,
    MOST_HEADER_BYTES,
    MOST_LINE_BYTES,
    MOST_POINTS,
    MOST_SCAN_BYTES,
)
from scenegen.run.workers import guarded

PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
MOST_SCANS = 100_000
"""The most scans of a folder."""
MOST_DIGITS = 255
"""The most digits of a number in a file's name."""
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
SENSOR_FIELDS = ("vp_", "viewpoint_", "sensor_", "origin_")
"""What the names of fields begin with that say where a point was seen from, before x, y and z: the
first are those of PCL's PointWithViewpoint."""
NOWHERE = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
"""The VIEWPOINT that a PCD has whose writer knew none."""
LAS_CHUNK = 1_000_000
"""Points of a LAS file that are unpacked at once."""
LAS_BYTES_IN_S = 1e6
"""How many bytes of a LAS file are unpacked in a second, at the least."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points, and where they were seen from."""

    points: Floats
    """(N, 3), metres; a point of NaN or infinity is a ray that returned nothing."""
    sensors: Floats | None = None
    """(N, 3) or, the same for all, (1, 3): where the sensor was, in the points' frame, metres. None
    where the file does not say."""


def read_points(path: Path) -> Floats:
    """The points of a scan, as `Cloud` has them. Raises as `read_cloud`."""
    return read_cloud(path).points


def read_cloud(path: Path, most_bytes: int = MOST_SCAN_BYTES) -> Cloud:
    """The points of a file of at most `most_bytes` bytes.

    Raises DatasetError for a file that holds none, that holds fewer than it promises, or that is
    too large.
    """
    if (suffix := path.suffix.lower()) not in READERS:
        raise DatasetError(
            f"{path}: neither a dataset's folder nor a scan; expected one of {', '.join(READERS)}"
        )
    content = read_bounded(path, most_bytes)
    try:
        found = READERS[suffix](content)
    except ModuleNotFoundError:
        raise DatasetError(f"{path}: {needs('laspy and lazrs', 'las')}") from None
    except Exception as error:  # numpy's parsers raise anything
        raise DatasetError(
            f"{path}: cannot be read as {suffix}: {printable(error)[:200]}"
        ) from None
    if found.ndim != 2 or found.shape[1] < 3 or not len(found) or found.dtype.kind not in "fiu":
        raise DatasetError(
            f"{path}: holds {found.dtype} of shape {found.shape}, expected (N, 3) numbers, N "
            f"from 1 on: x, y, z in metres"
        )
    if len(found) > MOST_POINTS:
        raise DatasetError(
            f"{path}: holds more than {MOST_POINTS} points; give one scan, not a map of many"
        )
    says = suffix in NAMED and found.shape[1] == 6
    sensors = found[:, 3:].astype(np.float64) if says else None
    return Cloud(found[:, :3].astype(np.float64), sensors)


def _fields(names: Collection[str]) -> list[str]:
    """Those of `names` that are a point's position, and after them, if they are there, those that
    say where it was seen from."""
    for first in SENSOR_FIELDS:
        sensor = [first + axis for axis in "xyz"]
        if set(sensor) <= set(names):
            return [*"xyz", *sensor]
    return [*"xyz"]


def _read_xyz(content: bytes) -> np.ndarray:
    if re.search(rb"(?<!,)\b\d+,\d+[ \t]+[-+]?\d+,\d", content):
        raise ValueError("has commas within numbers, expected 3.5 and not 3,5")
    return _numbers(content.replace(b",", b" "), (0, 1, 2), MOST_POINTS + 1)


def _read_ply(content: bytes) -> np.ndarray:
    """The vertices of a PLY file (Turk 1994), which must come before all other elements, and where
    they were seen from."""
    head, end, _ = content[:MOST_HEADER_BYTES].partition(b"end_header")
    start = content.find(b"\n", len(head)) + 1
    if not end or not start:
        raise ValueError("its header has no end")
    try:
        order, count, properties = _ply_header(head)
    except (ValueError, KeyError, IndexError):
        raise ValueError(
            "expected a header of `format`, then `element vertex`, with x, y and z among its "
            "properties, and no lists"
        ) from None
    layout = np.dtype([(name, order + kind, (1,)) for name, kind in properties.items()])
    return _points(memoryview(content)[start:], layout, count, text=not order)


def _points(content: memoryview, layout: np.dtype, count: int, *, text: bool) -> Floats:
    """Where `count` points are, and what they were seen from, see `_fields`: the first numbers of
    these. `layout` is the type of a point, whose fields are arrays: a line of `text` a point, or
    point after point. Raises ValueError for too many points, or fewer than that."""
    if not 0 <= count <= MOST_POINTS:
        raise ValueError(f"promises {count} points, expected {MOST_POINTS} at most")
    names = layout.names or ()
    fields = _fields(names)
    if text:
        starts = np.cumsum([0, *(layout[name].shape[0] for name in names)]).tolist()
        points = _numbers(content, [starts[names.index(name)] for name in fields], count)
    else:
        rows = np.frombuffer(content, layout, min(count, len(content) // layout.itemsize))
        points = np.stack([rows[name][:, 0].astype(np.float64) for name in fields], axis=1)
    if len(points) != count:
        raise ValueError(f"promises {count} points and holds {len(points)}")
    return points


def _ply_header(head: bytes) -> tuple[str, int, dict[str, str]]:
    """Byte order ("" for text), number of vertices, and numpy's types of their properties by
    name."""
    magic, *rest = [line.split() for line in head.decode("latin-1").splitlines()]
    (_, form, _), (element, vertex, count), *lines = [
        line for line in rest if line and line[0] not in ("comment", "obj_info")
    ]
    own = list(itertools.takewhile(lambda line: line[0] == "property", lines))
    properties = {name: PLY_TYPES[kind] for _, kind, name in own}
    is_ply = (magic, element, vertex) == (["ply"], "element", "vertex")
    if not is_ply or len(properties) < len(own) or not properties.keys() >= set("xyz"):
        raise ValueError("no vertices, or a property is there twice or missing")
    return PLY_ORDERS[form], int(count), properties


def _numbers(text: bytes | memoryview, columns: Sequence[int], most: int) -> Floats:
    """`columns` of the first `most` lines. Raises ValueError where a line holds far more than a
    point."""
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n"))
    if np.diff(ends, prepend=-1, append=len(text)).max() > MOST_LINE_BYTES:
        raise ValueError(
            f"a line of more than {MOST_LINE_BYTES} bytes, expected x y z and little more"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of lines that hold nothing
        return np.loadtxt(
            io.BytesIO(text), ndmin=2, usecols=columns, max_rows=most, encoding="ascii"
        )


def _read_pcd(content: bytes) -> np.ndarray:
    """The points of a PCD file, and where they were seen from: fields or its VIEWPOINT
    (pointclouds.org, "The PCD file format")."""
    head, mark, rest = content[:MOST_HEADER_BYTES].partition(b"\nDATA ")
    coding, _, _ = rest.partition(b"\n")
    body = memoryview(content)[len(head + mark + coding) + 1 :]
    coding = coding.strip()
    if coding not in (b"ascii", b"binary", b"binary_compressed"):
        raise ValueError(
            f"DATA is {printable(coding.decode('latin-1'))[:30]!r}, expected ascii, binary or "
            "binary_compressed"
        )
    lines = [line.split() for line in head.decode("latin-1").splitlines() if line[:1] != "#"]
    header = {line[0]: line[1:] for line in lines if line}
    layout, count = _pcd_layout(header), int(header["POINTS"][0])
    if coding == b"binary_compressed":
        body = _unpacked(body, layout, count)
    points = _points(body, layout, count, text=coding == b"ascii")
    viewpoint = list(map(float, header.get("VIEWPOINT", NOWHERE)))
    if points.shape[1] == 3 and viewpoint != NOWHERE:
        sensors = np.broadcast_to(viewpoint[:3], points.shape)
        return np.concatenate([points, sensors], axis=1)
    return points


def _pcd_layout(header: Mapping[str, Sequence[str]]) -> np.dtype:
    """NumPy's type of a point, from the lines of a PCD's header by their first words."""
    # what only fills a gap is called "_", as often as there are gaps
    names = [f"_{n}" if name == "_" else name for n, name in enumerate(header["FIELDS"])]
    if not set("xyz") <= set(names) or len(set(names)) < len(names):
        raise ValueError(f"has points of {' '.join(names)[:60]}, expected x, y and z once each")
    counts = map(int, header.get("COUNT", ["1"] * len(names)))
    rows = zip(names, header["TYPE"], header["SIZE"], counts, strict=True)
    return np.dtype([(name, PCD_TYPES[kind] + size, (count,)) for name, kind, size, count in rows])


def _unpacked(content: memoryview, layout: np.dtype, count: int) -> memoryview:
    """Point after point what a compressed PCD holds: two sizes, and what LZF made of one field's
    values after the other's. Raises ValueError where they do not fit."""
    packed, size = np.frombuffer(content, "<u4", min(2, len(content) // 4)).tolist()
    if size != count * layout.itemsize or size > MOST_CLOUD_BYTES:
        raise ValueError(f"unpacks to {size} bytes, expected {layout.itemsize} for each point")
    columns = np.zeros(size, np.uint8)
    if _unpack_lzf(np.frombuffer(content, np.uint8)[8 : 8 + packed], columns) != size:
        raise ValueError("its compressed points are damaged, or end early")
    rows, first = np.zeros(count, layout), 0
    for name in layout.names or ():
        last = first + rows[name].nbytes
        rows[name] = columns[first:last].view(layout[name].base).reshape(rows[name].shape)
        first = last
    return memoryview(rows.tobytes())


@kernel
def _unpack_lzf(packed, unpacked):
    """Undo LZF: a byte below 32 says how many bytes follow as they are, less one; another byte, of
    a length and the high bits of a distance, has bytes repeated that were written before. Gives
    how many bytes were written; fewer than `unpacked` holds where what is packed is damaged."""
    at, written = 0, 0
    while at < len(packed):
        control = int(packed[at])
        at += 1
        if control < 32:
            length, source = control + 1, -1
        else:
            length, distance = control >> 5, (control & 31) << 8
            if length == 7 and at < len(packed):
                length += int(packed[at])
                at += 1
            if at == len(packed):
                return 0
            length, source = length + 2, written - distance - int(packed[at]) - 1
            at += 1
            if source < 0:
                return 0
        if written + length > len(unpacked) or (source < 0 and at + length > len(packed)):
            return 0
        for _ in range(length):
            if source < 0:
                unpacked[written] = packed[at]
                at += 1
            else:
                unpacked[written] = unpacked[source]
                source += 1
            written += 1
    return written


def _read_las(content: bytes) -> np.ndarray:
    """The points of a LAS or LAZ file (ASPRS LAS 1.4), scaled and with its offset, by laspy, which
    damaged files can make hang."""
    return guarded(
        _unpack_las,
        content,
        seconds=GUARD_S + len(content) / LAS_BYTES_IN_S,
        memory_bytes=GUARD_BYTES + len(content),
    )


def _unpack_las(content: bytes) -> Floats:
    import laspy

    # this process's own: its decoder prints as it dies
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    with laspy.open(io.BytesIO(content), read_evlrs=False) as file:
        count = file.header.point_count
        if count > MOST_POINTS:
            raise ValueError(f"promises {count} points, expected {MOST_POINTS} at most")
        fields = _fields(set(file.header.point_format.dimension_names) | set("xyz"))
        parts = [
            np.stack([np.asarray(chunk[name], float) for name in fields], axis=1)
            for chunk in file.chunk_iterator(LAS_CHUNK)
        ]
    points = np.concatenate([np.zeros((0, len(fields))), *parts])
    if len(points) != count:
        raise ValueError(f"promises {count} points and holds {len(points)}")
    return points


def _read_bin(content: bytes) -> np.ndarray:
    """KITTI's: x, y, z and intensity, float32, point after point."""
    if len(content) % 16:
        raise ValueError(f"{len(content)} bytes, expected four float32 a point as in KITTI")
    return np.frombuffer(content, "<f4").reshape(-1, 4)


def _read_npz(content: bytes) -> np.ndarray:
    """The array `points` of NumPy's archive."""
    return read_npz(content, "points", most_bytes=MOST_SCAN_BYTES)[0]


def read_npz(content: bytes, *names: str, most_bytes: int) -> list[np.ndarray]:
    """The arrays `names` of NumPy's archive, of at most `most_bytes` bytes each. Raises whatever a
    crafted file leads to."""
    found = list[np.ndarray]()
    with zipfile.ZipFile(io.BytesIO(content)) as members:
        for name in names:
            about = members.getinfo(f"{name}.npy")
            if about.file_size > most_bytes:
                raise ValueError(
                    f"{name} of {about.file_size} bytes, expected {most_bytes} at most"
                )
            found.append(read_npy(members.read(about)))
    return found


def encode_npz(fields: Mapping[str, Any], level: int = 1) -> bytes:
    """NumPy's archive of arrays and texts by name, compressed at a zlib `level`, of which 1 is
    several times as fast as the usual one: the same bytes whenever it is made."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as members:
        for name, values in fields.items():
            with members.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
    return file.getvalue()


PCD_TYPES = {"I": "<i", "U": "<u", "F": "<f"}
"""How numpy's names of a PCD's types begin, by TYPE; its SIZE ends them."""
READERS = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".bin": _read_bin,
    ".npz": _read_npz,
    ".xyz": _read_xyz,
    ".npy": read_npy,
    ".las": _read_las,
    ".laz": _read_las,
}
"""File types of scans, and what reads each: bytes to points (N, 3 or more), of which the first
three columns count, and six where `NAMED` says so. A reader may raise anything: `read_cloud` makes
one line of it."""
NAMED = (".ply", ".pcd", ".las", ".laz")
"""Those whose columns have names, so that three of them can say where a point was seen from."""


def scans_in(folder: Path) -> list[Path]:
    """Files of these types in a folder and those below it, sorted, numbers in their names by value.
    Raises DatasetError for more than `MOST_SCANS`."""
    found = list(
        itertools.islice(
            (path for path in folder.rglob("*") if path.suffix.lower() in READERS), MOST_SCANS + 1
        )
    )
    if len(found) > MOST_SCANS:
        raise DatasetError(f"{folder}: holds more than {MOST_SCANS} scans; give a folder of fewer")
    return sorted(found, key=_by_number)


def _by_number(path: Path) -> tuple[Path, str, str]:
    """A path's place in its folder: 2.ply comes before 10.ply, scan_2.ply before scan_10.ply, and
    digits before letters. What follows a point are decimals."""
    padded = re.sub(r"(?<![\d.])\d+", lambda digits: digits[0].zfill(MOST_DIGITS), path.stem)
    return path.parent, padded, path.name
