"""Point clouds: what three formats hold comes back, and files that promise more than they hold
are refused."""

import struct

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scenegen.worlds.clouds import read_cloud, scans_in
from scenegen.worlds.clouds.write import write_points
from tests.refusals import refuses
from tests.scenegen import cases, each_case

POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)


HEAD = """ply
format binary_big_endian 1.0
comment caf\xe9
element vertex 50
property uchar i
property double z
property float y
property float x
element face 1
property list uchar int vertex_indices
end_header
"""


def test_big_endian_vertices_in_any_order_come_back(tmp_path):
    """And before faces."""
    vertices = np.zeros(50, [("i", "u1"), ("z", ">f8"), ("y", ">f4"), ("x", ">f4")])
    for axis, column in zip("xyz", POINTS.T, strict=True):
        vertices[axis] = column
    content = HEAD.encode("latin-1") + vertices.tobytes() + b"\3" + bytes(12)
    (tmp_path / "scan.ply").write_bytes(content)
    assert_array_equal(read_cloud(tmp_path / "scan.ply").points, POINTS)


def test_text_comes_back(tmp_path):
    (tmp_path / "scan.XYZ").write_text("# x y z\n1 2 3 9\n\n4,5,nan,9\n")
    assert_array_equal(read_cloud(tmp_path / "scan.XYZ").points, [[1, 2, 3], [4, 5, np.nan]])


@each_case("clouds/names", "head row")
def test_a_first_line_of_names_says_where_x_y_and_z_are(tmp_path, head, row):
    rows = "".join(f"{row.replace('xyz', point)}\n" for point in ("1 2 3", "4 5 6"))
    (tmp_path / "a.xyz").write_text(f"{head}\n{rows}")
    assert_array_equal(read_cloud(tmp_path / "a.xyz").points, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("suffix", [".pcd", ".bin", ".npz", ".ply"])
def test_what_scan_writes_comes_back(tmp_path, suffix):
    points = POINTS * np.array([9, 9, 1], "f4")  # as places are wider than high
    for intensity in (None, np.linspace(0, 1, 50)):
        write_points(tmp_path / f"scan{suffix}", points.astype(np.float64), intensity, {})
        assert_array_equal(read_cloud(tmp_path / f"scan{suffix}").points, points)


def pcd(form, n=3, fields="intensity _ z y x", type="U U F F F", count="1 3 1 1 1"):
    head = f"VERSION .7\nFIELDS {fields}\nSIZE 2 1 8 4 4\nTYPE {type}\nCOUNT {count}\n"
    return f"{head}WIDTH {n}\nPOINTS {n}\nDATA {form}\n".encode()


def test_pcd_with_fields_of_any_kind_in_any_order(tmp_path):
    points = POINTS[:3].astype(np.float64)
    text = "".join(f"7 0 0 0 {z!r} {y!r} {x!r}\n" for x, y, z in points.tolist())
    rows = b"".join(struct.pack("<HBBBdff", 7, 0, 0, 0, z, y, x) for x, y, z in points)
    # as LZF has it: the fields one after the other, of which five bytes are repeated
    fields = np.frombuffer(rows, "<u2,3u1,<f8,<f4,<f4")
    columns = b"".join(fields[name].tobytes() for name in fields.dtype.names)
    assert columns[:15] == b"\7\0" * 3 + bytes(9)
    packed = b"\1\7\0\x40\1\0\0\xe0\0\0"  # 7 0, four bytes from two before, 0, nine from one before
    for n in range(16, len(columns), 32):
        packed += bytes([len(columns[n : n + 32]) - 1]) + columns[n : n + 32]
    sizes = struct.pack("<II", len(packed), len(columns))
    bodies = {"ascii": text.encode(), "binary": rows, "binary_compressed": sizes + packed}
    for form, body in bodies.items():
        (tmp_path / "a.pcd").write_bytes(b"# made by hand\n" + pcd(form) + body)
        assert_array_equal(read_cloud(tmp_path / "a.pcd").points, points)


LONG = [("endless.ply", "ply\n" * 10_000), ("nested.npy", "\x93NUMPY\1\0\x28\x23" + "(" * 9000)]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("name", "content"), [*cases("clouds/broken"), *LONG])
def test_files_that_promise_more_than_they_hold_are_refused(tmp_path, name, content):
    """What stands in the table has Python's escapes."""
    content = content.encode("latin-1").decode("unicode_escape").encode("latin-1")
    (tmp_path / name).write_bytes(content)
    refuses(name, read_cloud, tmp_path / name)


def test_an_archive_that_unpacks_to_more_than_a_scan_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("scenegen.worlds.clouds.formats.MAX_SCAN_BYTES", 10_000)
    np.savez_compressed(tmp_path / "bomb.npz", points=np.zeros((10_000, 3)))
    assert (tmp_path / "bomb.npz").stat().st_size < 10_000
    refuses("10000 at most", read_cloud, tmp_path / "bomb.npz")


def test_scans_are_found_below_a_folder_and_sorted_by_their_numbers(tmp_path):
    velodyne = "00/velodyne/2.bin", "00/velodyne/9.5.bin", "00/velodyne/10.bin"
    names = *velodyne, "01/a2.pcd", "01/a10.PCD"
    for name in (*reversed(names), "01/times.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert [str(path.relative_to(tmp_path)) for path in scans_in(tmp_path)] == list(names)
