"""Named fields: files as drivers and other programs write them, and LAS files not in metres."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenegen.worlds.clouds import read_cloud
from tests.refusals import refuses
from tests.scenegen import each_case

POINTS = np.random.default_rng(0).uniform(-9, 9, (6, 3)).astype("<f4")
TEXT = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in POINTS.tolist())
HEAD = (
    "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 2\nPOINTS 6\n"
)


@pytest.mark.parametrize("coding", ["ascii", "binary", "BINARY"])
@each_case("clouds/heads", "old new")
def test_pcd_is_read_as_drivers_write_it(tmp_path, coding, old, new):
    old, new = (text.replace("\\n", "\n").replace("\\r", "\r") for text in (old, new))
    head = f"{HEAD}DATA {coding}\n".replace(old, new)
    body = TEXT.encode() if coding == "ascii" else POINTS.tobytes()
    (tmp_path / "scan.pcd").write_bytes(head.encode() + body)
    assert_array_equal(read_cloud(tmp_path / "scan.pcd").points, POINTS)


@each_case("clouds/formats", "old new")
def test_faults_of_a_pcds_header_are_named(tmp_path, old, new):
    head = f"{HEAD}DATA ascii\n".replace(old.replace("\\n", "\n"), new)
    (tmp_path / "scan.pcd").write_text(head + TEXT)
    refuses(f"{old} {new}", read_cloud, tmp_path / "scan.pcd")


@pytest.mark.parametrize("comment", ["end_header", "before end_header it ends", "a\nobj_info x"])
def test_comments_of_a_ply_may_hold_any_word(tmp_path, comment):
    fields = "".join(f"property float {name}\n" for name in "XYZ")
    head = f"ply\nformat ascii 1.0\ncomment {comment}\nelement vertex 6\n{fields}end_header\n"
    (tmp_path / "scan.ply").write_text(head + TEXT)
    assert_array_equal(read_cloud(tmp_path / "scan.ply").points, POINTS)


def las(path, points, scales=(1e-3, 1e-3, 1e-3), **columns):
    """A LAS file of points, and further columns (n,) or (n, 3)."""
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = scales, np.floor(points[0])
    for name, column in columns.items():
        if name != "gps_time":
            header.add_extra_dim(laspy.ExtraBytesParams(name, f"{column[0].size}f8"))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    for name, column in columns.items():
        data[name] = column
    data.write(path)
    return path


METRES = np.random.default_rng(1).uniform(0, 60, (200, 3))
DEGREES = METRES / np.array([80_000, 110_000, 1]) + np.array([11.5, 48.1, 500.0])
UTM = np.array([652e3, 5.4e6, 0.0])


@pytest.mark.parametrize("scales", [[1e-7, 1e-7, 1e-3], [1e-7, 1e-7, 1e-6], [1e-6, 1e-6, 1e-2]])
def test_las_in_degrees_is_refused(tmp_path, scales):
    refuses("degrees", read_cloud, las(tmp_path / "a.las", DEGREES, scales))


def test_las_in_metres_is_read(tmp_path):
    pole = METRES * [0.01, 0.01, 1]
    for points, scale in ((METRES, 1e-3), (METRES, 1e-7), (pole, 1e-3), (METRES + UTM, 1e-3)):
        cloud = read_cloud(las(tmp_path / "a.las", points, [scale] * 3))
        assert_allclose(cloud.points, points, atol=1e-2)
        assert cloud.layout == "x y z (LAS, point format 6)"


def test_las_times_are_columns_of_numbers(tmp_path):
    times = np.arange(200.0)
    columns = {"gps_time": times, "time_3": np.zeros((200, 3))}
    cloud = read_cloud(las(tmp_path / "a.las", METRES, **columns))
    assert_array_equal(cloud.times.pop("gps_time"), times)
    assert not cloud.times


def test_laz_is_read_after_others_read_some_here(tmp_path):
    path = las(tmp_path / "a.laz", METRES.repeat(500, axis=0))
    laspy = pytest.importorskip("laspy")
    # lazrs keeps threads from here on, which no fork of this process has
    laspy.read(path, laz_backend=laspy.LazBackend.LazrsParallel)
    assert len(read_cloud(path).points) == 100_000
