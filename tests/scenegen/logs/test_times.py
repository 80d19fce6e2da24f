"""Times of points: their field and unit, whatever a driver calls them."""

import numpy as np
import pytest

from scenegen.base.errors import DatasetError
from scenegen.logs import Fusing
from scenegen.logs.fuse import ingest
from scenegen.logs.log import RawTimes, find_clock
from scenegen.logs.read import read_log
from tests.command_line import refused, run
from tests.scenegen.logs.bags import BEGIN_S, PERIOD_S, SPEED_MPS, drive, moving

NEAR = Fusing(every=1, reach_m=15, rise_m=12, deskew=True)

READ = {
    "t, u4, ns": ("t", lambda u, stamp: (u * 1e9).astype("u4")),
    "t, u4, µs": ("t", lambda u, stamp: (u * 1e6).astype("u4")),
    "time, f4, s": ("time", lambda u, stamp: u.astype("f4")),
    "time, f4, ms": ("time", lambda u, stamp: (u * 1e3).astype("f4")),
    "timestamp, f8, s": ("timestamp", lambda u, stamp: stamp + u),
    "timestamp, f8, ms": ("timestamp", lambda u, stamp: (stamp + u) * 1e3),
    "timestamp, f8, µs": ("timestamp", lambda u, stamp: (stamp + u) * 1e6),
    "timestamp, f8, ns": ("timestamp", lambda u, stamp: (stamp + u) * 1e9),
    "time_stamp, f8, µs": ("time_stamp", lambda u, stamp: (stamp - 1.6e9 + u) * 1e6),
    "stamps, f4, shares of a scan": ("stamps", lambda u, stamp: (u / PERIOD_S).astype("f4")),
    "time_offset, i4, ns": ("time_offset", lambda u, stamp: (u * 1e9).astype("i4")),
    "point_time_offset, u4, µs": ("point_time_offset", lambda u, stamp: (u * 1e6).astype("u4")),
}
"""Field, type and unit, and the field with what makes it of seconds after the stamp."""


@pytest.mark.parametrize("case", READ)
def test_points_are_deskewed_by_any_field(tmp_path, case):
    name, encode = READ[case]
    bag, truth = drive(lambda u, stamp: {name: encode(u, stamp)})
    log = read_log(moving(bag).write(tmp_path / "bag"))
    assert log.about["times"] == f"times from field {name} in {case.split(', ')[2]}"
    ingest(log, tmp_path / "out", NEAR)
    for n, points in enumerate(truth):
        seen = np.load(tmp_path / "out" / "observations" / f"{n:06d}.npz")["points"]
        # the way of 1 m is cut in slices of 1 cm
        assert abs(seen - points).max() < 0.006, n


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
    with pytest.raises(DatasetError, match=r"scan 3, at .* has no times .* from scan 3 of 6"):
        ingest(log, tmp_path / "out", NEAR)


def test_messages_that_come_twice_or_late_are_deskewed(tmp_path):
    bag, truth = drive(lambda u, stamp: {"t": u})
    order = [0, 1, 1, 3, 2, 4, 5, 5]
    for place, n in enumerate(order):  # the bag's own times, not those in the messages
        bag.messages.append(("/points", BEGIN_S + 9 + place, bag.messages[n][2]))
    del bag.messages[:6]
    ingest(read_log(moving(bag).write(tmp_path / "bag")), tmp_path / "out", NEAR)
    for place, n in enumerate(order):
        seen = np.load(tmp_path / "out" / "observations" / f"{place:06d}.npz")["points"]
        assert abs(seen - truth[n]).max() < 0.011, n  # to scan 3 it is 2 m, in slices of 2 cm


@pytest.mark.parametrize("suffix", [".ply", ".npy"])
def test_clouds_of_a_folder_are_deskewed_by_their_fields(tmp_path, suffix):
    rng, truth = np.random.default_rng(0), []
    clouds, poses = tmp_path / "clouds", []
    clouds.mkdir()
    for n in range(6):
        after = np.append(0, np.sort(rng.uniform(0, 0.995 * PERIOD_S, 200)))
        from_start = rng.uniform(2, 8, (201, 3)) * rng.choice([-1, 1], (201, 3))
        seen = from_start - np.outer(after * SPEED_MPS, [1, 0, 0])
        rows = np.column_stack([seen, 1e6 * after]).astype("<f4")
        if suffix == ".npy":
            np.save(clouds / f"{n}.npy", np.rec.fromarrays(rows.T, names="x,y,z,time"))
        else:
            head = "ply\nformat binary_little_endian 1.0\nelement vertex 201\n"
            fields = "".join(f"property float {name}\n" for name in ("x", "y", "z", "time"))
            content = f"{head}{fields}end_header\n".encode() + rows.tobytes()
            (clouds / f"{n}.ply").write_bytes(content)
        poses.append([BEGIN_S + n * PERIOD_S, n * PERIOD_S * SPEED_MPS, 0, 0, 0, 0, 0, 1])
        truth.append(from_start)
    np.savetxt(tmp_path / "poses.tum", poses, "%.12g")
    log = read_log(clouds, poses=tmp_path / "poses.tum")
    assert log.about["times"] == "times from field time in µs"
    ingest(log, tmp_path / "out", NEAR)
    for n, points in enumerate(truth):
        observed = np.load(tmp_path / "out" / "observations" / f"{n:06d}.npz")["points"]
        assert abs(observed - points).max() < 0.006, n
    # matrices without times: nothing says how far apart scans are, and so in which unit times are
    np.savetxt(tmp_path / "poses.txt", [[1, 0, 0, row[1], 0, 1, 0, 0, 0, 0, 1, 0] for row in poses])
    assert read_log(clouds, poses=tmp_path / "poses.txt").about["times"] == "no times of points"


def test_clouds_without_fields_of_times_are_not_deskewed(tmp_path, capsys):
    from tests.scenegen.logs.test_logs import written

    written(tmp_path / "log")
    line = refused(capsys, f"ingest {tmp_path}/log --deskew -o {tmp_path}/out --quiet")
    assert "its points have no field of times" in line
