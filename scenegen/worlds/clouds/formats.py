"""File formats of point clouds, each a function from bytes to a `CloudTable`.

A reader may raise anything: `scenegen.worlds.clouds.read_cloud` makes one line of it."""

import io
import itertools
import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidarsim.grid import Floats
from lidarsim.jit import kernel
from lidarsim.sensors.table import read_npy
from scenegen.base.errors import DatasetError, printable
from scenegen.base.limits import (
    GUARD_BYTES,
    GUARD_S,
    MAX_CLOUD_BYTES,
    MAX_HEADER_BYTES,
    MAX_LINE_BYTES,
    MAX_POINTS,
    MAX_SCAN_BYTES,
)
from scenegen.base.workers import guarded
from scenegen.worlds.clouds.columns import (
    HELP,
    CloudTable,
    fitting_columns,
    origin_fields,
    short_list,
    table_of_array,
    used_fields,
    xyz_of,
)
from scenegen.worlds.clouds.write import read_npz

PLY_TYPES = {
    "char": "int8",
    "uchar": "uint8",
    "short": "int16",
    "ushort": "uint16",
    "int": "int32",
    "uint": "uint32",
    "float": "float32",
    "double": "float64",
}
"""NumPy's names of a PLY's types, which may stand in the file, too."""
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_END = re.compile(rb"^end_header[ \t\r]*\n", re.MULTILINE)
"""The line that ends a PLY's header; a comment may hold the word, too."""
PCD_DATA = re.compile(rb"^[ \t]*DATA[ \t]+([^\n]*)\n", re.MULTILINE | re.IGNORECASE)
"""The line that ends a PCD's header."""
PCD_TYPES = {"I": "<i", "U": "<u", "F": "<f"}
"""How numpy's names of a PCD's types begin, by TYPE; its SIZE ends them."""
NO_VIEWPOINT = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
"""The VIEWPOINT of a PCD whose writer knew none."""
KITTI, NUSCENES = 4, 5
"""Columns of the two .bin formats that are known: x y z intensity, and these with the ring."""
LAS_CHUNK = 1_000_000
"""Points of a LAS file that are unpacked at once."""
LAS_BYTES_IN_S = 1e6
"""A lower bound of the speed at which LAS files are unpacked, bytes a second."""
DEGREES_SCALE = 1e-6
"""Steps of x and y in a LAS file that may hold degrees: 1e-7° are a centimetre."""
DEGREES_TALL = 30
"""A cloud that is this many times as high as wide has its width in degrees."""


def read_ply(content: bytes) -> CloudTable:
    """Read the vertices of a PLY file (Turk 1994), which must come before all other elements.

    Args:
        content: The file's bytes.

    Returns:
        The used columns.

    Raises:
        ValueError: If the header is invalid.
    """
    end = PLY_END.search(content, 0, MAX_HEADER_BYTES)
    if end is None:
        raise ValueError("its header has no end")
    try:
        order, count, properties = _ply_header(content[: end.start()])
    except (ValueError, KeyError, IndexError):
        raise ValueError(
            "expected a header of `format`, then `element vertex`, with x, y and z among its "
            "properties, and no lists"
        ) from None
    rows = [(name, order + np.dtype(kind).str[1:], (1,)) for name, kind in properties.items()]
    layout = np.dtype(rows)
    # no copy: a file may be large
    body = memoryview(content)[end.end() :]
    return _table(body, layout, count, ".ply", "binary" if order else "text")


def _ply_header(head: bytes) -> tuple[str, int, dict[str, str]]:
    """Return byte order ("" for text), number of vertices, and numpy's types of their properties by
    name."""
    magic, *words = [line.split() for line in head.decode("latin-1").splitlines()]
    (_, form, _), (element, vertex, count), *lines = [
        line for line in words if line and line[0] not in ("comment", "obj_info")
    ]
    property_lines = list(itertools.takewhile(lambda line: line[0] == "property", lines))
    names = _lowered([name for _, _, name in property_lines])
    types = [PLY_TYPES.get(kind, kind) for _, kind, _ in property_lines]
    properties = dict(zip(names, types, strict=True))
    is_ply = (magic, element, vertex) == (["ply"], "element", "vertex")
    known = set(types) <= set(PLY_TYPES.values())
    # a dict is shorter than its lines if a name occurs twice
    if not is_ply or len(properties) < len(property_lines) or not known:
        raise ValueError("no vertices, or a property is unknown or there twice")
    return PLY_ORDERS[form], int(count), properties


def read_pcd(content: bytes) -> CloudTable:
    """Read the points of a PCD file, and where they were seen from: fields or its VIEWPOINT
    (pointclouds.org, "The PCD file format").

    As in PCL's reader, COLUMNS may stand for FIELDS, and SIZE, TYPE, COUNT and POINTS may be
    missing.

    Args:
        content: The file's bytes.

    Returns:
        The used columns.

    Raises:
        ValueError: If the file is invalid.
    """
    end = PCD_DATA.search(content, 0, MAX_HEADER_BYTES)
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
    table = _table(body, layout, count, ".pcd", coding.decode())
    viewpoint = _numbers_of(header, "VIEWPOINT", NO_VIEWPOINT, float)
    if len(viewpoint) != len(NO_VIEWPOINT):
        raise ValueError(f"VIEWPOINT has {len(viewpoint)} numbers, expected 7")
    # a place for each point says more than one VIEWPOINT for all
    if viewpoint == NO_VIEWPOINT or origin_fields(table.columns):
        return table
    layout_read = f"{table.layout[:-1]}, VIEWPOINT)"
    return table._replace(layout=layout_read, origin=np.array([viewpoint[:3]]))


def _pcd_layout(header: Mapping[str, Sequence[str]]) -> np.dtype:
    """Return NumPy's type of a point, from the lines of a PCD's header by their first words."""
    fields = header.get("FIELDS") or header.get("COLUMNS")
    if not fields:
        raise ValueError("its header has no line FIELDS, expected FIELDS x y z and others")
    # every field that only fills a gap is called "_"
    names = _lowered([f"_{n}" if name == "_" else name for n, name in enumerate(fields)])
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
    """Return how many points a PCD's header promises."""
    if "POINTS" not in header and "WIDTH" not in header:
        raise ValueError("its header has no line POINTS, and no WIDTH and HEIGHT")
    # PCL writes both; POINTS is the total
    sides = ["POINTS"] if "POINTS" in header else ["WIDTH", "HEIGHT"]
    return math.prod(n for side in sides for n in _numbers_of(header, side, [1], int)[:1])


def _numbers_of(
    header: Mapping[str, Sequence[str]], key: str, usual: list[Any], kind: type
) -> list[Any]:
    """Read the numbers in the line `key` of a PCD's header; `usual` if there is no such line."""
    words = header.get(key, usual)
    try:
        return [kind(word) for word in words]
    except ValueError:
        raise ValueError(f"{key} {printable(' '.join(words))[:60]}: expected numbers") from None


def _unpacked(content: memoryview, layout: np.dtype, count: int) -> memoryview:
    """Unpack a compressed PCD, point after point.

    It holds two sizes, and the LZF of one field's values after the other's. Raises ValueError if
    they do not fit."""
    packed, size = np.frombuffer(content, "<u4", min(2, len(content) // 4)).tolist()
    if size != count * layout.itemsize or size > MAX_CLOUD_BYTES:
        raise ValueError(f"unpacks to {size} bytes, expected {layout.itemsize} for each point")
    columns = np.zeros(size, np.uint8)
    if _unpack_lzf(np.frombuffer(content, np.uint8)[8 : 8 + packed], columns) != size:
        raise ValueError("its compressed points are damaged, or end early")
    rows, first = np.zeros(count, layout), 0
    for name in layout.names or ():
        last = first + rows[name].nbytes
        # from field after field to point after point
        rows[name] = columns[first:last].view(layout[name].base).reshape(rows[name].shape)
        first = last
    return memoryview(rows.tobytes())


@kernel
def _unpack_lzf(packed, unpacked):
    """Undo LZF.

    A byte below 32 is a count, less one, of literal bytes that follow; another byte holds a length
    and the high bits of a distance, of bytes to repeat from the output. Returns how many bytes were
    written, fewer than `unpacked` holds if the input is damaged."""
    offset, written = 0, 0
    while offset < len(packed):
        control = int(packed[offset])
        offset += 1
        if control < 32:
            length, source = control + 1, -1
        else:
            # of three bits for a length, 7 says that another byte adds to it
            length, distance = control >> 5, (control & 31) << 8
            if length == 7 and offset < len(packed):
                length += int(packed[offset])
                offset += 1
            if offset == len(packed):
                return 0
            length, source = length + 2, written - distance - int(packed[offset]) - 1
            offset += 1
            if source < 0:
                return 0
        if written + length > len(unpacked) or (source < 0 and offset + length > len(packed)):
            return 0
        # byte by byte: a repeat may read bytes that it has just written
        for _ in range(length):
            if source < 0:
                unpacked[written] = packed[offset]
                offset += 1
            else:
                unpacked[written] = unpacked[source]
                source += 1
            written += 1
    return written


def read_las(content: bytes) -> CloudTable:
    """Read the points of a LAS or LAZ file (ASPRS LAS 1.4) by laspy, scaled and with its offset.

    Damaged files can make laspy hang, so it runs guarded, in another process."""
    return guarded(
        _unpack_las,
        content,
        seconds=GUARD_S + len(content) / LAS_BYTES_IN_S,
        memory_bytes=GUARD_BYTES + len(content),
    )


def _unpack_las(content: bytes) -> CloudTable:
    import laspy

    # of this process only: its decoder prints when it fails
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    # on one thread: this process is a fork, in which lazrs would wait for ever for the threads that
    # it has begun in the parent, if that has read a LAZ file before
    backends = laspy.LazBackend.Lazrs, laspy.LazBackend.Laszip
    with laspy.open(io.BytesIO(content), laz_backend=backends, read_evlrs=False) as file:
        count = file.header.point_count
        if count > MAX_POINTS:
            raise DatasetError(f"promises {count} points, expected {MAX_POINTS} at most")
        dimensions = file.header.point_format.dimensions
        scalars = {dimension.name for dimension in dimensions if dimension.num_elements == 1}
        names = sorted(scalars | set("xyz"))
        chunks = [
            {name: np.asarray(chunk[name], float) for name in used_fields(names)}
            for chunk in file.chunk_iterator(LAS_CHUNK)
        ]
        columns = {
            name: np.concatenate([np.empty(0), *(chunk[name] for chunk in chunks)])
            for name in used_fields(names)
        }
        _check_metric(file.header, *(columns[axis] for axis in "xyz"))
        form = file.header.point_format.id
    if len(columns["x"]) != count:
        raise DatasetError(f"promises {count} points and holds {len(columns['x'])}")
    fields = [*"xyz", *origin_fields(names)]
    return CloudTable(columns, f"{short_list(fields)} (LAS, point format {form})")


def _check_metric(header: Any, x: Floats, y: Floats, z: Floats) -> None:
    """Raise DatasetError for a LAS file in degrees, judged by its numbers: many files name no
    coordinate system."""
    if not len(x):
        return
    fine, tall = header.scales[:2].max(), DEGREES_TALL * max(np.ptp(x), np.ptp(y))
    on_earth = np.abs(x).max() <= 180 and np.abs(y).max() <= 90
    # fine steps of x and y beside coarse or tall heights: degrees beside metres
    if on_earth and fine <= DEGREES_SCALE and (header.scales[2] >= 100 * fine or np.ptp(z) > tall):
        raise DatasetError(
            "has geographic coordinates, degrees; expected metres, z up: project it first, to UTM "
            "or so (pdal translate with filters.reprojection)"
        )


def _lowered(names: list[str]) -> list[str]:
    """Lower the case of names, since some programs write X Y Z, unless two would then be the
    same."""
    lowered = [name.lower() for name in names]
    return lowered if len(set(lowered)) == len(names) else names


def _table(content: memoryview, layout: np.dtype, count: int, kind: str, coding: str) -> CloudTable:
    """Read the used fields of `count` points, each a line of text or bytes of type `layout`.

    Fields are arrays, of which the first number is read. Raises ValueError for too many points, or
    fewer than promised."""
    if not 0 <= count <= MAX_POINTS:
        raise ValueError(f"promises {count} points, expected {MAX_POINTS} at most")
    names = layout.names or ()
    fields = used_fields(names)
    if coding in ("text", "ascii"):
        starts = np.cumsum([0, *(layout[name].shape[0] for name in names)]).tolist()
        columns = text_columns(content, {n: starts[names.index(n)] for n in fields}, count)
    else:
        # fewer points than promised are refused below, with both counts
        rows = np.frombuffer(content, layout, min(count, len(content) // layout.itemsize))
        columns = {name: rows[name][:, 0] for name in fields}
    if (held := len(columns["x"])) != count:
        raise ValueError(f"promises {count} points and holds {held}")
    return CloudTable(columns, f"{short_list(names)} ({kind}, {coding})")


def text_columns(
    text: bytes | memoryview, places: Mapping[str, int], max_rows: int
) -> dict[str, Floats]:
    """Read columns of a text's first lines.

    Args:
        text: The lines.
        places: Numbers of columns by name.
        max_rows: The greatest number of lines.

    Returns:
        The columns by name, (N,).

    Raises:
        ValueError: If a line is far longer than a point, or has a word in these columns.
    """
    # checked first: loadtxt reads a line of any length into memory
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n"))
    if np.diff(ends, prepend=-1, append=len(text)).max() > MAX_LINE_BYTES:
        raise ValueError(
            f"a line of more than {MAX_LINE_BYTES} bytes, expected x y z and little more"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about empty lines
        rows = np.loadtxt(
            io.BytesIO(text),
            ndmin=2,
            usecols=[*places.values()],
            max_rows=max_rows,
            encoding="ascii",
        )
    return dict(zip(places, rows.T, strict=True))


def read_xyz(content: bytes) -> CloudTable:
    """Read text: x, y and z are the first numbers of each line, unless its first line names others.

    Args:
        content: The file's bytes.

    Returns:
        x, y and z.

    Raises:
        ValueError: If numbers have decimal commas.
    """
    head, _, body = content.partition(b"\n")
    words = head.decode("latin-1").lower().replace(",", " ").strip("#/ \r").split()
    places = dict(zip("xyz", range(3), strict=True))
    if set(words) >= set("xyz"):
        # others may be words, such as a time of day
        places, content = {axis: words.index(axis) for axis in "xyz"}, body
    # else the commas would make two numbers of one
    if re.search(rb"(?<!,)\b\d+,\d+[ \t]+[-+]?\d+,\d", content):
        raise ValueError("has commas within numbers, expected 3.5 and not 3,5")
    # one more than allowed, so that `read_cloud` sees that there are too many
    columns = text_columns(content.replace(b",", b" "), places, MAX_POINTS + 1)
    return CloudTable(columns, "x y z (.xyz, text)")


def read_bin(content: bytes, columns: int | None, usual: int | None = None) -> CloudTable:
    """Read float32, point after point.

    Args:
        content: The file's bytes.
        columns: Numbers of a point; None lets `fitting_columns` determine it.
        usual: The number of columns if the numbers do not determine it.

    Returns:
        x, y and z.

    Raises:
        ValueError: If the size is no multiple of a point's.
    """
    if len(content) % 4:
        raise ValueError(f"{len(content)} bytes, no multiple of 4: cut off, or no float32")
    values = np.frombuffer(content, "<f4")
    count = columns or fitting_columns(values, usual)
    if len(content) % (4 * count):
        raise ValueError(f"{len(content)} bytes, no multiple of {count} float32; {HELP}")
    fields = "x y z intensity (KITTI .bin" if count == KITTI else "x y z (.bin"
    return CloudTable(xyz_of(values.reshape(-1, count)), f"{fields}, {count} columns)")


def read_kitti(content: bytes, columns: int | None) -> CloudTable:
    """Read a .bin in a folder of KITTI's layout.

    Args:
        content: The file's bytes.
        columns: Numbers of a point; None to determine it, 4 if the numbers do not.

    Returns:
        x, y and z.
    """
    return read_bin(content, columns, KITTI)


def read_nuscenes(content: bytes, columns: int | None) -> CloudTable:
    """Read nuScenes' .pcd.bin: float32, x y z intensity ring, point after point.

    Args:
        content: The file's bytes.
        columns: Numbers of a point; 5 if None.

    Returns:
        x, y, z and ring.
    """
    count = columns or NUSCENES
    layout = f"x y z intensity ring (nuScenes .pcd.bin, {count} columns)"
    fields = read_bin(content, count).columns
    rings = np.frombuffer(content, "<f4")[NUSCENES - 1 :: count]
    return CloudTable({**fields, "ring": rings} if count == NUSCENES else fields, layout)


def read_array(content: bytes, columns: int | None) -> CloudTable:
    """Read NumPy's .npy file.

    Args:
        content: The file's bytes.
        columns: As for `table_of_array`.

    Returns:
        The used columns.
    """
    return table_of_array(read_npy(content), columns, ".npy")


def read_archive(content: bytes, columns: int | None) -> CloudTable:
    """Read the array `points` of NumPy's archive.

    Args:
        content: The file's bytes.
        columns: As for `table_of_array`.

    Returns:
        The used columns.
    """
    (points,) = read_npz(content, "points", max_bytes=MAX_SCAN_BYTES)
    return table_of_array(points, columns, ".npz")
