"""Times of points: their field and unit, whatever a driver calls them."""

from dataclasses import replace

import numpy as np
import pytest

from scenegen.logs import Fusing
from scenegen.logs.fuse import ingest
from scenegen.logs.log import RawTimes, find_clock
from scenegen.logs.read import read_log
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.conftest import names
from tests.scenegen.logs.bags import BEGIN_S, PERIOD_S, SPEED_MPS, drive, moving, sweeps

NEAR = Fusing(every=1, reach_m=15, rise_m=12, deskew=True)


def driven(folder, times_of):
    """The log of a drive, and its truth."""
    bag, truth = drive(times_of)
    return read_log(moving(bag).write(folder / "bag")), truth


def check_deskewed(log, out, truth, within_m=0.006):
    """The way of 1 m is cut in slices of 1 cm."""
    ingest(log, out, NEAR)
    for n, points in enumerate(truth):
        seen = np.load(out / "observations" / f"{n:06d}.npz")["points"]
        assert abs(seen - points).max() < within_m, n


@each_case("logs/times", "name kind per_s since unit")
def test_points_are_deskewed_by_any_field(tmp_path, name, kind, per_s, since, unit):
    def encode(u, stamp):
        after = u if since == "stamp" else stamp - float(since) + u
        return {name: (after * float(per_s)).astype(kind)}

    log, truth = driven(tmp_path, encode)
    assert log.about["times"] == f"times from field {name} in {unit}"
    check_deskewed(log, tmp_path / "out", truth)


@each_case("logs/stamped", "times expected")
def test_times_of_points_are_seconds_after_the_stamp(times, expected):
    """Of three points, of which the second did not return."""
    times, expected = (np.array(text.split(), float) for text in (times, expected))
    raw = RawTimes({"time": times}, np.array([True, False, True]), 2001.0)
    assert find_clock([raw], 0.1).seconds(raw) == pytest.approx(expected, abs=1e-6)


REFUSED = {
    "no field of times": lambda u, stamp: {"range": u.astype("f4")},
    "zeros": lambda u, stamp: {"t": 0 * u.astype("u4")},
    "too long": lambda u, stamp: {"time": 20 * u},
    "too short": lambda u, stamp: {"time": 1e-3 * u},
    "too early": lambda u, stamp: {"stamp": stamp + u - 0.5},
    "two fields": lambda u, stamp: {"time": (stamp + u).astype("f4"), "t": 0 * u},
}


@pytest.mark.parametrize("case", REFUSED)
def test_deskewing_without_times_that_can_be_true_is_refused(tmp_path, case):
    log, _ = driven(tmp_path, REFUSED[case])
    refuses(case, ingest, log, tmp_path / "out", NEAR)
    assert names(tmp_path) == {"bag.mcap"}
    ingest(log, tmp_path / "out", replace(NEAR, deskew=False))
    assert [scan.more for scan in log.scans()] == [{}] * 6


def raw_of(**fields):
    """The fields of 50 points that all returned."""
    return RawTimes(fields, np.ones(50, bool), 5.0)


def test_a_usable_field_is_taken_beside_one_of_zeros():
    clock = find_clock([raw_of(t=np.zeros(50), stamps=np.linspace(0, 1e5, 50))], 0.1)
    assert (clock.field, clock.unit, clock.origin) == ("stamps", "µs", "the stamp")


def test_from_0_to_1_within_two_seconds_cannot_be_told():
    raw = raw_of(t=np.linspace(0, 1, 50))
    refuses("2 s", find_clock, [raw], 2.0)
    assert [find_clock([raw], each).unit for each in (0.1, 1.0)] == ["shares of a scan", "s"]


def test_one_scan_of_impossible_times_stops_the_run(tmp_path):
    log, _ = driven(tmp_path, lambda u, stamp: {"t": u * (30 if 0.25 < stamp % 1 < 0.35 else 1)})
    refuses("scan 3", ingest, log, tmp_path / "out", NEAR)


def test_messages_that_come_twice_or_late_are_deskewed(tmp_path):
    bag, truth = drive(lambda u, stamp: {"t": u})
    order, clouds = [0, 1, 1, 3, 2, 4, 5, 5], bag.messages
    # the bag's own times, not those in the messages
    bag.messages = [(clouds[n][0], BEGIN_S + 9 + at, *clouds[n][2:]) for at, n in enumerate(order)]
    log = read_log(moving(bag).write(tmp_path / "bag"))
    # to scan 3 it is 2 m, in slices of 2 cm
    check_deskewed(log, tmp_path / "out", [truth[n] for n in order], within_m=0.011)


def test_clouds_of_a_folder_are_deskewed_by_their_fields(tmp_path):
    clouds, poses, truth = tmp_path / "clouds", np.zeros((6, 8)), []
    clouds.mkdir()
    for n, (stamp, after, seen, from_start) in enumerate(sweeps()):
        np.save(clouds / f"{n}.npy", np.rec.fromarrays([*seen.T, 1e6 * after], names="x,y,z,time"))
        poses[n, [0, 1, 7]] = stamp, n * PERIOD_S * SPEED_MPS, 1
        truth.append(from_start)
    np.savetxt(tmp_path / "poses.tum", poses, "%.12g")
    log = read_log(clouds, poses=tmp_path / "poses.tum")
    assert log.about["times"] == "times from field time in µs"
    check_deskewed(log, tmp_path / "out", truth)
    # matrices without times: nothing says how far apart scans are, and so in which unit times are
    np.savetxt(tmp_path / "poses.txt", [np.eye(3, 4).reshape(-1)] * 6)
    assert read_log(clouds, poses=tmp_path / "poses.txt").about["times"] == "no times of points"
