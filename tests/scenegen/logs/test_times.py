"""Times of points: their field and unit, whatever a driver calls them."""

import numpy as np
import pytest

from scenegen.logs import Fusing
from scenegen.logs.fuse import ingest
from scenegen.logs.log import RawTimes, find_clock
from scenegen.logs.read import read_log
from tests.command_line import refused, rows, run
from tests.scenegen import refuses
from tests.scenegen.logs.bags import BEGIN_S, PERIOD_S, SPEED_MPS, drive, moving, sweeps

NEAR = Fusing(every=1, reach_m=15, rise_m=12, deskew=True)

READ = """
t                 → u4 → 1e9 → stamp → ns
t                 → u4 → 1e6 → stamp → µs
time              → f4 → 1   → stamp → s
time              → f4 → 1e3 → stamp → ms
timestamp         → f8 → 1   → 0     → s
timestamp         → f8 → 1e3 → 0     → ms
timestamp         → f8 → 1e6 → 0     → µs
timestamp         → f8 → 1e9 → 0     → ns
time_stamp        → f8 → 1e6 → 1.6e9 → µs
stamps            → f4 → 10  → stamp → shares of a scan
time_offset       → i4 → 1e9 → stamp → ns
point_time_offset → u4 → 1e6 → stamp → µs
"""
"""Field, type, numbers to a second, when they begin, and the unit that is told."""


def check_deskewed(log, out, truth, within_m=0.006):
    """The way of 1 m is cut in slices of 1 cm."""
    ingest(log, out, NEAR)
    for n, points in enumerate(truth):
        seen = np.load(out / "observations" / f"{n:06d}.npz")["points"]
        assert abs(seen - points).max() < within_m, n


@pytest.mark.parametrize(("name", "kind", "per_s", "since", "unit"), rows(READ))
def test_points_are_deskewed_by_any_field(tmp_path, name, kind, per_s, since, unit):
    def encode(u, stamp):
        after = u if since == "stamp" else stamp - float(since) + u
        return {name: (after * float(per_s)).astype(kind)}

    bag, truth = drive(encode)
    log = read_log(moving(bag).write(tmp_path / "bag"))
    assert log.about["times"] == f"times from field {name} in {unit}"
    check_deskewed(log, tmp_path / "out", truth)


STAMPED = """
-0.1 7 -0.05     → -0.1 0 -0.05
0.03 0 0.1       → 0.03 0 0.1
2000.9 0 2001    → -0.1 0 0
2e15 0 2.0000001e15 → 0 0 0.1
"""
"""Of three points, of which the second did not return: before the stamp, as Velodyne's; late; by
the clock; and in nanoseconds of another clock, as Livox's."""


@pytest.mark.parametrize(("told", "expected"), rows(STAMPED))
def test_times_of_points_are_seconds_after_the_stamp(told, expected):
    told, expected = (np.array(text.split(), float) for text in (told, expected))
    raw = RawTimes({"time": told}, np.array([True, False, True]), 2001.0)
    assert find_clock([raw], 0.1).seconds(raw) == pytest.approx(expected, abs=1e-6)


REFUSED = {
    "no field of times": lambda u, stamp: {"range": u.astype("f4")},
    "field t spans 0 in a scan": lambda u, stamp: {"t": 0 * u.astype("u4")},
    "field time spans 1.99 in": lambda u, stamp: {"time": 20 * u},
    "field time spans 9.95e-05 in": lambda u, stamp: {"time": 1e-3 * u},
    "field stamp begins 0.5 s from the stamp": lambda u, stamp: {"stamp": stamp + u - 0.5},
    "fit the 0.1 s between scans: field t spans 0 in a scan; field time spans": lambda u, stamp: {
        "time": (stamp + u).astype("f4"),
        "t": 0 * u,
    },
}


@pytest.mark.parametrize("expected", REFUSED)
def test_deskewing_without_times_that_can_be_true_is_refused(tmp_path, capsys, expected):
    bag, _ = drive(REFUSED[expected])
    path = moving(bag).write(tmp_path / "bag")
    line = refused(capsys, f"ingest {path} --deskew -o {tmp_path}/out --quiet")
    assert expected in line
    assert "leave out --deskew" in line
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.part").exists()
    # which no times are needed for
    assert run(capsys, f"ingest {path} -o {tmp_path}/out --quiet --rise 12")[0] == 0
    assert all(scan.more == {} for scan in read_log(path).scans())


def test_a_usable_field_is_taken_beside_one_of_zeros():
    u = np.linspace(0, 0.1, 50)
    raw = RawTimes({"t": 0 * u, "stamps": u * 1e6}, np.ones(50, bool), 5.0)
    clock = find_clock([raw], 0.1)
    assert (clock.field, clock.unit, clock.origin) == ("stamps", "µs", "the stamp")


def test_from_0_to_1_within_two_seconds_cannot_be_told():
    raw = RawTimes({"t": np.linspace(0, 1, 50)}, np.ones(50, bool), 5.0)
    with pytest.raises(ValueError, match="field t spans 1 in a scan"):
        find_clock([raw], 2.0)
    assert find_clock([raw], 0.1).unit == "shares of a scan"
    assert find_clock([raw], 1.0).unit == "s"


def test_one_scan_of_impossible_times_stops_the_run(tmp_path):
    bag, _ = drive(lambda u, stamp: {"t": u * (30 if stamp % 1 > 0.25 and stamp % 1 < 0.35 else 1)})
    log = read_log(moving(bag).write(tmp_path / "bag"))
    refuses(r"scan 3, at .* has no times .* from scan 3 of 6", ingest, log, tmp_path / "out", NEAR)


def test_messages_that_come_twice_or_late_are_deskewed(tmp_path):
    bag, truth = drive(lambda u, stamp: {"t": u})
    order = [0, 1, 1, 3, 2, 4, 5, 5]
    for place, n in enumerate(order):  # the bag's own times, not those in the messages
        bag.messages.append(("/points", BEGIN_S + 9 + place, bag.messages[n][2]))
    del bag.messages[:6]
    log = read_log(moving(bag).write(tmp_path / "bag"))
    # to scan 3 it is 2 m, in slices of 2 cm
    check_deskewed(log, tmp_path / "out", [truth[n] for n in order], within_m=0.011)


PLY = "ply\nformat binary_little_endian 1.0\nelement vertex 200\n"
PLY += "".join(f"property float {name}\n" for name in ("x", "y", "z", "time")) + "end_header\n"


@pytest.mark.parametrize("suffix", [".ply", ".npy"])
def test_clouds_of_a_folder_are_deskewed_by_their_fields(tmp_path, suffix):
    clouds, poses, truth = tmp_path / "clouds", [], []
    clouds.mkdir()
    for n, (stamp, after, seen, from_start) in enumerate(sweeps()):
        rows = np.column_stack([seen, 1e6 * after]).astype("<f4")
        if suffix == ".npy":
            np.save(clouds / f"{n}.npy", np.rec.fromarrays(rows.T, names="x,y,z,time"))
        else:
            (clouds / f"{n}.ply").write_bytes(PLY.encode() + rows.tobytes())
        poses.append([stamp, n * PERIOD_S * SPEED_MPS, 0, 0, 0, 0, 0, 1])
        truth.append(from_start)
    np.savetxt(tmp_path / "poses.tum", poses, "%.12g")
    log = read_log(clouds, poses=tmp_path / "poses.tum")
    assert log.about["times"] == "times from field time in µs"
    check_deskewed(log, tmp_path / "out", truth)
    # matrices without times: nothing says how far apart scans are, and so in which unit times are
    np.savetxt(tmp_path / "poses.txt", [[1, 0, 0, row[1], 0, 1, 0, 0, 0, 0, 1, 0] for row in poses])
    assert read_log(clouds, poses=tmp_path / "poses.txt").about["times"] == "no times of points"


def test_clouds_without_fields_of_times_are_not_deskewed(tmp_path, capsys):
    from tests.scenegen.logs.test_logs import written

    written(tmp_path / "log")
    line = refused(capsys, f"ingest {tmp_path}/log --deskew -o {tmp_path}/out --quiet")
    assert "its points have no field of times" in line
