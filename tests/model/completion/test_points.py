"""Clouds of points: what three formats hold comes back, and files that promise more than they hold are refused."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from scenegen.errors import DatasetError
from scenegen.model.completion.points import read_points

POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
HEAD = "element vertex {count}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
@pytest.mark.parametrize("coloured", [False, True])
def test_what_trimesh_writes_as_ply_comes_back(tmp_path: Path, encoding: str, coloured: bool) -> None:
    colours = np.full((50, 4), 7, np.uint8) if coloured else None
    cloud = trimesh.PointCloud(POINTS, colors=colours)
    (tmp_path / "scan.ply").write_bytes(cloud.export(file_type="ply", encoding=encoding))
    np.testing.assert_allclose(read_points(tmp_path / "scan.ply"), POINTS, atol=1e-7)


def test_big_endian_vertices_in_any_order_and_before_faces_come_back(tmp_path: Path) -> None:
    head = (
        "ply\nformat binary_big_endian 1.0\ncomment caf\xe9\nelement vertex 50\nproperty uchar i\nproperty double z\n"
        "property float y\nproperty float x\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(50, dtype=[("i", "u1"), ("z", ">f8"), ("y", ">f4"), ("x", ">f4")])
    for axis, column in zip("xyz", POINTS.T, strict=True):
        rows[axis] = column
    (tmp_path / "scan.ply").write_bytes(head.encode("latin-1") + rows.tobytes() + b"\3" + bytes(12))
    np.testing.assert_array_equal(read_points(tmp_path / "scan.ply"), POINTS)


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_come_back(tmp_path: Path, order: str) -> None:
    np.save(tmp_path / "scan.npy", np.asarray(POINTS, order=order))
    np.testing.assert_array_equal(read_points(tmp_path / "scan.npy"), POINTS)


def test_text_comes_back_by_spaces_or_commas(tmp_path: Path) -> None:
    (tmp_path / "scan.xyz").write_text("# x y z\n1 2 3 9\n\n4,5,nan,9\n")
    np.testing.assert_array_equal(read_points(tmp_path / "scan.xyz"), [[1, 2, 3], [4, 5, np.nan]])


def npy(header: str) -> str:
    """An array file that holds nothing but its header."""
    return "\x93NUMPY\1\0\x50\0" + header.ljust(80)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.ply", "ply\nformat ascii 1.0\n" + HEAD.format(count=10**12) + "1 2 3\n" * 3, "promises 1000000000000"),
        ("b.ply", "ply\nformat ascii 1.0\n" + HEAD.format(count=5) + "1 2 3\n" * 3, "promises 5 points and holds 3"),
        ("c.ply", "ply\nformat binary_little_endian 1.0\n" + HEAD.format(count=5) + "x" * 40, "holds 3"),
        ("d.ply", "ply\nformat ascii 1.0\n" + HEAD.format(count=-1), "promises -1 points"),
        ("e.ply", "ply\nformat zip 1.0\n" + HEAD.format(count=1), "expected a header"),
        ("f.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n", "no lists"),
        ("g.ply", "ply\nformat ascii 1.0\n" + HEAD.format(count=1).replace(" y", " x") + "1 2 3\n", "x, y and z"),
        ("h.ply", "ply\n" * 10_000, "its header has no end"),
        ("i.ply", "", "its header has no end"),
        ("a.npy", "\x93NUMPY\1\0\x28\x23" + "(" * 9000, "cannot be read"),
        (
            "b.npy",
            npy("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000, 3)}"),
            "holds 0",
        ),
        (
            "c.npy",
            npy("{'descr': '|O', 'fortran_order': False, 'shape': (1, 3)}"),
            "array of object",
        ),
        ("d.npy", "", "cannot be read"),
        ("a.xyz", "", "expected (N, 3)"),
        ("b.xyz", "1 2\n", "cannot be read"),
        ("c.xyz", "1 2 3\n1 2\n", "cannot be read"),
        ("d.xyz", "one two three\n", "cannot be read"),
        ("e.xyz", "\0" * 1000, "cannot be read"),
    ],
)
def test_files_that_do_not_hold_what_they_promise_are_refused(
    tmp_path: Path, name: str, content: str, said: str
) -> None:
    (tmp_path / name).write_bytes(content.encode("latin-1"))
    with pytest.raises(DatasetError) as caught:
        read_points(tmp_path / name)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
