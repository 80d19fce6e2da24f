"""Point clouds whose files name the fields of a point: PLY, PCD, LAS and LAZ."""

import io
import itertools
import math
import os
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from lidarsim.grid import Floats
from lidarsim.jit import kernel
from scenegen.errors import DatasetError, printable
from scenegen.limits import (
    GUARD_BYTES,
    GUARD_S,
    MOST_CLOUD_BYTES,
    MOST_HEADER_BYTES,
    MOST_LINE_BYTES,
    MOST_POINTS,
)
from scenegen.run.workers import guarded

Table: TypeAlias = tuple[np.ndarray, str]
"""Points (N, 3), or (N, 6) with where each was seen from behind its position, as the file has
them; and what was taken of the file, in words: "x y z intensity (.pcd, binary)"."""
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
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_END = re.compile(rb"^end_header[ \t\r]*\n", re.MULTILINE)
"""The line that ends a PLY's header; a comment may hold the word, too."""
PCD_DATA = re.compile(rb"^[ \t]*DATA[ \t]+([^\n]*)\n", re.MULTILINE | re.IGNORECASE)
"""The line that ends a PCD's header."""
PCD_TYPES = {"I": "<i", "U": "<u", "F": "<f"}
"""How numpy's names of a PCD's types begin, by TYPE; its SIZE ends them."""
SENSOR_FIELDS = ("vp_", "viewpoint_", "sensor_", "origin_")
"""What the names of fields begin with that say where a point was seen from, before x, y and z: the
first are those of PCL's PointWithViewpoint."""
NOWHERE = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
"""The VIEWPOINT that a PCD has whose writer knew none."""
MAX_NAMES = 12
"""Fields of a point that are named to people."""
LAS_CHUNK = 1_000_000
"""Points of a LAS file that are unpacked at once."""
LAS_BYTES_IN_S = 1e6
"""How many bytes of a LAS file are unpacked in a second, at the least."""
DEGREES_SCALE = 1e-6
"""A LAS file whose x and y have steps as fine as this may hold degrees: 1e-7° are a centimetre."""
DEGREES_TALL = 30
"""A cloud that is so many times as high as it is wide has degrees for its width."""


def read_ply(content: bytes) -> Table:
    """The vertices of a PLY file (Turk 1994), which must come before all other elements."""
    end = PLY_END.search(content, 0, MOST_HEADER_BYTES)
    if end is None:
        raise ValueError("its header has no end")
    try:
        order, count, properties = _ply_header(content[: end.start()])
    except (ValueError, KeyError, IndexError):
        raise ValueError(
            "expected a header of `format`, then `element vertex`, with x, y and z among its "
            "properties, and no lists"
        ) from None
    layout = np.dtype([(name, order + kind, (1,)) for name, kind in properties.items()])
    points = _points(memoryview(content)[end.end() :], layout, count, text=not order)
    return points, f"{named(layout.names or ())} (.ply, {'binary' if order else 'text'})"


def _ply_header(head: bytes) -> tuple[str, int, dict[str, str]]:
    """Byte order ("" for text), number of vertices, and numpy's types of their properties by
    name."""
    magic, *rest = [line.split() for line in head.decode("latin-1").splitlines()]
    (_, form, _), (element, vertex, count), *lines = [
        line for line in rest if line and line[0] not in ("comment", "obj_info")
    ]
    own = list(itertools.takewhile(lambda line: line[0] == "property", lines))
    names = _lowered([name for _, _, name in own])
    properties = {name: PLY_TYPES[kind] for name, (_, kind, _) in zip(names, own, strict=True)}
    is_ply = (magic, element, vertex) == (["ply"], "element", "vertex")
    if not is_ply or len(properties) < len(own) or not properties.keys() >= set("xyz"):
        raise ValueError("no vertices, or a property is there twice or missing")
    return PLY_ORDERS[form], int(count), properties


def read_pcd(content: bytes) -> Table:
    """The points of a PCD file, and where they were seen from: fields or its VIEWPOINT
    (pointclouds.org, "The PCD file format"). As in PCL's reader, COLUMNS may stand for FIELDS, and
    SIZE, TYPE, COUNT and POINTS may be missing."""
    end = PCD_DATA.search(content, 0, MOST_HEADER_BYTES)
    if end is None:
        raise ValueError("its header has no line DATA, expected DATA ascii, binary or so")
    coding = end[1].strip().lower()
    if coding not in (b"ascii", b"binary", b"binary_compressed"):
        raise ValueError(
            f"DATA is {printable(coding.decode('latin-1'))[:30]!r}, expected ascii, binary or "
            "binary_compressed"
        )
    text, body = content[: end.start()].decode("latin-1"), memoryview(content)[end.end() :]
    lines = [line.split() for line in text.splitlines() if not line.lstrip().startswith("#")]
    header = {line[0].upper(): line[1:] for line in lines if line}
    layout, count = _pcd_layout(header), _pcd_count(header)
    if coding == b"binary_compressed":
        body = _unpacked(body, layout, count)
    points = _points(body, layout, count, text=coding == b"ascii")
    taken = f"{named(layout.names or ())} (.pcd, {coding.decode()}"
    viewpoint = _numbers_of(header, "VIEWPOINT", NOWHERE, float)
    if len(viewpoint) != len(NOWHERE):
        raise ValueError(f"VIEWPOINT has {len(viewpoint)} numbers, expected 7")
    if points.shape[1] == 3 and viewpoint != NOWHERE:
        sensors = np.broadcast_to(viewpoint[:3], points.shape)
        return np.concatenate([points, sensors], axis=1), f"{taken}, VIEWPOINT)"
    return points, f"{taken})"


def _pcd_layout(header: Mapping[str, Sequence[str]]) -> np.dtype:
    """NumPy's type of a point, from the lines of a PCD's header by their first words."""
    fields = header.get("FIELDS") or header.get("COLUMNS")
    if not fields:
        raise ValueError("its header has no line FIELDS, expected FIELDS x y z and others")
    # what only fills a gap is called "_", as often as there are gaps
    names = _lowered([f"_{n}" if name == "_" else name for n, name in enumerate(fields)])
    if not set("xyz") <= set(names) or len(set(names)) < len(names):
        raise ValueError(f"has points of {' '.join(names)[:60]}, expected x, y and z once each")
    sizes, counts = (
        _numbers_of(header, key, [usual] * len(names), int)
        for key, usual in (("SIZE", 4), ("COUNT", 1))
    )
    types = [kind.upper() for kind in header.get("TYPE", ["F"] * len(names))]
    if {len(sizes), len(counts), len(types)} != {len(names)}:
        raise ValueError(
            f"has {len(names)} FIELDS, {len(sizes)} SIZE, {len(types)} TYPE and {len(counts)} "
            "COUNT, expected as many of each"
        )
    if unknown := set(types) - PCD_TYPES.keys():
        raise ValueError(f"TYPE {printable(min(unknown))[:30]}, expected I, U or F")
    rows = zip(names, types, sizes, counts, strict=True)
    return np.dtype([(n, f"{PCD_TYPES[kind]}{size}", (count,)) for n, kind, size, count in rows])


def _pcd_count(header: Mapping[str, Sequence[str]]) -> int:
    """How many points a PCD's header promises."""
    if "POINTS" not in header and "WIDTH" not in header:
        raise ValueError("its header has no line POINTS, and no WIDTH and HEIGHT")
    sides = ["POINTS"] if "POINTS" in header else ["WIDTH", "HEIGHT"]
    return math.prod(n for side in sides for n in _numbers_of(header, side, [1], int)[:1])


def _numbers_of(
    header: Mapping[str, Sequence[str]], key: str, usual: list[Any], kind: type
) -> list[Any]:
    """The numbers in the line `key` of a PCD's header, `usual` where there is no such line."""
    words = header.get(key, usual)
    try:
        return [kind(word) for word in words]
    except ValueError:
        raise ValueError(f"{key} {printable(' '.join(words))[:60]}: expected numbers") from None


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


def read_las(content: bytes) -> Table:
    """The points of a LAS or LAZ file (ASPRS LAS 1.4), scaled and with its offset, by laspy, which
    damaged files can make hang."""
    points, taken = guarded(
        _unpack_las,
        content,
        seconds=GUARD_S + len(content) / LAS_BYTES_IN_S,
        memory_bytes=GUARD_BYTES + len(content),
    )
    return points, taken


def _unpack_las(content: bytes) -> Table:
    import laspy

    # this process's own: its decoder prints as it dies
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    # on one thread: this process is a fork, in which lazrs would wait for ever for the threads that
    # it has begun in the parent, if that has read a LAZ file before
    backends = laspy.LazBackend.Lazrs, laspy.LazBackend.Laszip
    with laspy.open(io.BytesIO(content), laz_backend=backends, read_evlrs=False) as file:
        count = file.header.point_count
        if count > MOST_POINTS:
            raise DatasetError(f"promises {count} points, expected {MOST_POINTS} at most")
        fields = sensor_fields(set(file.header.point_format.dimension_names) | set("xyz"))
        parts = [
            np.stack([np.asarray(chunk[name], float) for name in fields], axis=1)
            for chunk in file.chunk_iterator(LAS_CHUNK)
        ]
        points = np.concatenate([np.zeros((0, len(fields))), *parts])
        _check_metric(file.header, points)
        form = file.header.point_format.id
    if len(points) != count:
        raise DatasetError(f"promises {count} points and holds {len(points)}")
    return points, f"{named(fields)} (LAS, point format {form})"


def _check_metric(header: Any, points: Floats) -> None:
    """Raise DatasetError for a LAS file in degrees: by its numbers, since many files name no
    coordinate system."""
    if not len(points):
        return
    x, y, z = np.ptp(points[:, :3], axis=0)
    fine, tall = header.scales[:2].max(), DEGREES_TALL * max(x, y)
    on_earth = (np.abs(points[:, :2]).max(axis=0) <= (180, 90)).all()
    if on_earth and fine <= DEGREES_SCALE and (header.scales[2] >= 100 * fine or z > tall):
        raise DatasetError(
            "has geographic coordinates, degrees; expected metres, z up: project it first, to UTM "
            "or so (pdal translate with filters.reprojection)"
        )


def sensor_fields(names: Collection[str]) -> list[str]:
    """Those of `names` that are a point's position, and after them, if they are there, those that
    say where it was seen from."""
    for first in SENSOR_FIELDS:
        sensor = [first + axis for axis in "xyz"]
        if set(sensor) <= set(names):
            return [*"xyz", *sensor]
    return [*"xyz"]


def named(names: Sequence[str]) -> str:
    """The names of a point's fields, for people; those that only fill gaps are left out."""
    shown = [printable(name)[:30] for name in names if not re.fullmatch(r"_\d+", name)]
    more = len(shown) - MAX_NAMES
    return " ".join(shown[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")


def _lowered(names: list[str]) -> list[str]:
    """Names in small letters, for some programs write X Y Z, unless two would then be the same."""
    lowered = [name.lower() for name in names]
    return lowered if len(set(lowered)) == len(names) else names


def _points(content: memoryview, layout: np.dtype, count: int, *, text: bool) -> Floats:
    """Where `count` points are, and what they were seen from, see `sensor_fields`: the first
    numbers of these. `layout` is the type of a point, whose fields are arrays: a line of `text` a
    point, or point after point. Raises ValueError for too many points, or fewer than that."""
    if not 0 <= count <= MOST_POINTS:
        raise ValueError(f"promises {count} points, expected {MOST_POINTS} at most")
    names = layout.names or ()
    fields = sensor_fields(names)
    if text:
        starts = np.cumsum([0, *(layout[name].shape[0] for name in names)]).tolist()
        points = text_numbers(content, [starts[names.index(name)] for name in fields], count)
    else:
        rows = np.frombuffer(content, layout, min(count, len(content) // layout.itemsize))
        points = np.stack([rows[name][:, 0].astype(np.float64) for name in fields], axis=1)
    if len(points) != count:
        raise ValueError(f"promises {count} points and holds {len(points)}")
    return points


def text_numbers(text: bytes | memoryview, columns: Sequence[int], most: int) -> Floats:
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
