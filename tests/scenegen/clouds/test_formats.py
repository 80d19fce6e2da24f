"""Named fields: files as drivers and other programs write them, and LAS files not in metres."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenegen.worlds.clouds import read_cloud
from tests.command_line import rows
from tests.scenegen import cases, refuses

POINTS = np.random.default_rng(0).uniform(-9, 9, (6, 3)).astype("<f4")
TEXT = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in POINTS.tolist())
HEAD = (
    "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 2\nPOINTS 6\n"
)
HEADS = """
TYPE F F F                    → TYPE f f f
POINTS 6\\n                   →
COUNT 1 1 1\\n                →
SIZE 4 4 4\\nTYPE F F F\\n    →
FIELDS                        → COLUMNS
FIELDS x y z                  → FIELDS X Y Z
FIELDS                        → fields
VERSION .7                    → # .PCD v.7 - Point Cloud Data file format\\nVERSION 0.7
\\n                           → \\r\\n
WIDTH 3\\nHEIGHT 2\\n         →
HEIGHT 2\\nPOINTS 6           → WIDTH 6
VERSION .7                    → # the word\\n#DATA binary
"""


@pytest.mark.parametrize("coding", ["ascii", "binary", "BINARY"])
@pytest.mark.parametrize(("old", "new"), rows(HEADS.replace("\\\\", "\\")))
def test_pcd_is_read_as_drivers_write_it(tmp_path, coding, old, new):
    old, new = (text.replace("\\n", "\n").replace("\\r", "\r") for text in (old, new))
    head = f"{HEAD}DATA {coding}\n".replace(old, new)
    body = TEXT.encode() if coding == "ascii" else POINTS.tobytes()
    (tmp_path / "scan.pcd").write_bytes(head.encode() + body)
    assert_array_equal(read_cloud(tmp_path / "scan.pcd").points, POINTS)


@pytest.mark.parametrize(("old", "new", "said"), cases("clouds/formats"))
def test_faults_of_a_pcd_s_header_are_named(tmp_path, old, new, said):
    head = f"{HEAD}DATA ascii\n".replace(old.replace("\\n", "\n"), new)
    (tmp_path / "scan.pcd").write_text(head + TEXT)
    refuses(said, read_cloud, tmp_path / "scan.pcd")


@pytest.mark.parametrize("comment", ["end_header", "before end_header it ends", "a\nobj_info x"])
def test_comments_of_a_ply_may_hold_any_word(tmp_path, comment):
    fields = "".join(f"property float {name}\n" for name in "XYZ")
    head = f"ply\nformat ascii 1.0\ncomment {comment}\nelement vertex 6\n{fields}end_header\n"
    (tmp_path / "scan.ply").write_text(head + TEXT)
    assert_array_equal(read_cloud(tmp_path / "scan.ply").points, POINTS)


def las(path, points, scales, form=6):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=form, version="1.4")
    header.scales, header.offsets = scales, np.floor(points[0])
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    data.write(path)
    return path


METRES = np.random.default_rng(1).uniform(0, 60, (200, 3))
DEGREES = METRES / np.array([80_000, 110_000, 1]) + np.array([11.5, 48.1, 500.0])
UTM = np.array([652e3, 5.4e6, 0.0])


def test_las_in_degrees_is_refused(tmp_path):
    for scales in ([1e-7, 1e-7, 1e-3], [1e-7, 1e-7, 1e-6], [1e-6, 1e-6, 1e-2]):
        path = las(tmp_path / "a.las", DEGREES, scales)
        refuses("geographic coordinates, degrees; expected metres", read_cloud, path)


def test_las_in_metres_is_read(tmp_path):
    pole = METRES * [0.01, 0.01, 1]
    for points, scale in ((METRES, 1e-3), (METRES, 1e-7), (pole, 1e-3), (METRES + UTM, 1e-3)):
        cloud = read_cloud(las(tmp_path / "a.las", points, [scale] * 3))
        assert_allclose(cloud.points, points, atol=1e-2)
        assert cloud.layout == "x y z (LAS, point format 6)"


def test_las_fields_of_times_are_columns_of_numbers(tmp_path):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [1e-3] * 3
    header.add_extra_dims([laspy.ExtraBytesParams("time_3", "3f8")])
    data = laspy.LasData(header)
    data.x, data.y, data.z = METRES.T
    data.gps_time = np.arange(200.0)
    data.write(tmp_path / "a.las")
    cloud = read_cloud(tmp_path / "a.las")
    assert_allclose(cloud.points, METRES, atol=1e-2)
    assert_array_equal(cloud.times["gps_time"], np.arange(200.0))
    assert list(cloud.times) == ["gps_time"]


def test_laz_is_read_after_others_read_some_here(tmp_path):
    laspy = pytest.importorskip("laspy")
    path = las(tmp_path / "a.laz", METRES.repeat(500, axis=0), [1e-3] * 3)
    # lazrs keeps threads from here on, which no fork of this process has
    laspy.read(path, laz_backend=laspy.LazBackend.LazrsParallel)
    assert len(read_cloud(path).points) == 100_000
