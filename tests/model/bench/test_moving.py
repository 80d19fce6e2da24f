"""Occupancy at later times: metrics by hand, rows by simple rules, and a network that predicts
it."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import scenegen
from lidarsim import GridSpec, Lidar, Pose, Scan
from scenegen.model.bench.methods import Predicted, find_method
from scenegen.model.bench.metrics import ScoredMap, metrics_of
from scenegen.model.bench.moving import tracks
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.predictions import predict_split
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.targets import targets_of
from scenegen.worlds.traffic import Traffic
from tests.conftest import dataset_in, small_recipe
from tests.model.bench.test_bench import report_of
from tests.model.test_targets import config_of
from tests.model.training.runs import train
from tests.refusals import refuses, refuses_command

COUNTS = {"train": 8, "val": 4, "test": 6}
GRID = GridSpec(shape=(8, 1, 1), voxel_m=0.5)
pytestmark = pytest.mark.usefixtures("undrawn")


def moving_in(folder):
    traffic = Traffic(people=(8, 10), drones=(4, 6), after_s=1.5)
    recipe = small_recipe(mapping={"scans": 2})
    dataset_in(folder / "d", dataclasses.replace(recipe, parts={"movers": traffic}), counts=COUNTS)


@pytest.fixture
def moving(once):
    return scenegen.load(once("moving", moving_in) / "d", "test").dataset


def row(text):
    """Voxels along x; # is occupied."""
    return np.array([sign == "#" for sign in text]).reshape(GRID.shape)


def case_of(now, later, **others):
    """A map with a voxel that stands; the second voxel is below the ground."""
    sample = SimpleNamespace(
        grid=GRID,
        observed=row("##.#.#.."),
        static_occupancy=row("##......"),
        motion=SimpleNamespace(passed=lambda after_s: row(".##.##..")),
    )
    return ScoredMap(
        prediction=Prediction(now.astype(np.float32), others=others),
        truth={"occupancy": row("##...#.."), "occupancy+1": later},
        grid=GRID,
        thresholds=Thresholds(),
        scored=~row(".#......"),
        sample=sample,
    )


def test_later_metrics_by_hand():
    metrics = metrics_of(targets_of(["occupancy+1"]))
    later = row("##..#...")
    # of the voxels that count: now 0, 3 and 5 are said, and then 0 and 4 are occupied
    judged = case_of(row("#..#.#.."), later)
    assert metrics["occupancy+1_iou"].of(judged) == 1 / 4
    # movers pass 2, 4 and 5, near 3 and 6: 3 and 5 are said, 4 is occupied
    assert metrics["occupancy+1_moving_iou"].of(judged) == 0
    # 3 holds a return, and nothing now
    assert metrics["ghosts"].of(judged) == 1
    told = case_of(row("#....#.."), later, **{"occupancy+1": 0.96 * row("#...##.#")})
    assert metrics["occupancy+1_iou"].of(told) == 2 / 4
    assert metrics["occupancy+1_moving_iou"].of(told) == 1 / 2
    near = case_of(row("#....#.."), later, **{"occupancy+1": row("#...###.")})
    assert metrics["occupancy+1_moving_iou"].of(near) == 1 / 3
    assert metrics["ghosts"].of(told) == 0


LIDAR = Lidar(rows=13, columns=72, max_range_m=12.0)


def scan_of(first, range_m):
    """Walls 9 m away, and a thing before them that is three rays wide and high."""
    ranges = np.full(LIDAR.shape, 9.0, np.float32)
    ranges[5:8, first : first + 3] = range_m
    return Scan(ranges, Pose(np.zeros(3), np.array([1.0, 0, 0, 0])), LIDAR)


def thing(scan):
    return scan.points()[scan.ranges.reshape(-1) < 8]


def test_two_scans_give_a_movers_velocity():
    now, before = scan_of(30, 4.0), scan_of(38, 4.4)
    sample = SimpleNamespace(scans=lambda: [now, before], scan_times=np.array([3.0, 2.5]))
    ((came, velocity, left),) = tracks(sample)
    assert_array_equal(came, thing(now))
    assert_array_equal(left, thing(before))
    assert_allclose(velocity, 2 * (thing(now).mean(axis=0) - thing(before).mean(axis=0)))


@pytest.mark.parametrize(
    ("first", "range_m", "times_s"),
    [(30, 4.0, (3.0, 2.5)), (38, 4.4, (2.5, 2.5)), (66, 4.4, (3.0, 2.5))],
    ids=["still", "no time", "too fast"],
)
def test_nothing_is_tracked(first, range_m, times_s):
    scans = [scan_of(30, 4.0), scan_of(first, range_m)]
    assert tracks(SimpleNamespace(scans=lambda: scans, scan_times=np.array(times_s))) == []


def test_flow_carries_voxels_along():
    sample = SimpleNamespace(
        grid=GRID,
        origin=np.zeros(3),
        voxel_mover=row(".#......") - 1,
        static_occupancy=row("#......."),
        motion=SimpleNamespace(flow=lambda: np.full((*GRID.shape, 3), (2.0, 0, 0), np.float32)),
    )
    said = find_method("flow").completion(sample, None)
    expected = ("##......", "#..#....", "#....#..", "#.......")
    arrays = (said.occupancy_probability, *said.others.values())
    for values, text in zip(arrays, expected, strict=True):
        assert_array_equal(values, row(text))


def test_a_report_has_horizons_that_are_stored(moving, tmp_path):
    names = ("truth", "moved", "flow", "tracked")
    rows = report_of(moving, tmp_path, names=names)["reconstruction"]["pillar"]
    figures = {name: rows["truth"][name] for name in rows["truth"] if "+" in name}
    assert set(figures) == {
        f"occupancy+{after}_{name}" for after in ("0.5", "1") for name in ("iou", "moving_iou")
    }
    for name in figures:
        assert rows["truth"][name]["mean"] < rows["moved"][name]["mean"] == 1
    later = [
        (sample.motion.passed(1.0), sample.occupancy, sample.motion.occupancy(1.0))
        for sample in moving.split("test")
    ]
    ious = [(now & then)[at].sum() / (now | then)[at].sum() for at, now, then in later if at.any()]
    assert figures["occupancy+1_moving_iou"]["mean"] == pytest.approx(np.mean(ious), abs=0.05)
    assert "IoU after 0.5 s" in (tmp_path / "report.md").read_text()


def test_worlds_that_stand_have_no_horizons(dataset, tmp_path):
    columns = report_of(dataset, tmp_path, names=("truth",))["reconstruction"]["pillar"]["truth"]
    assert not [name for name in columns if "+" in name or name == "ghosts"]


@pytest.mark.parametrize("words", ["--metric occupancy+1", "--method tracked", "--method flow"])
def test_datasets_without_movers_are_refused(dataset, tmp_path, capsys, words):
    refuses_command(capsys, f"bench {dataset.folder} --quick --workers 1 -o {tmp_path} {words}")


def test_horizons_beyond_the_courses_are_refused(moving, tmp_path, capsys):
    words = f"bench {moving.folder} --quick --workers 1 -o {tmp_path} --metric occupancy+2"
    refuses_command(capsys, words)


def test_a_network_predicts_later_occupancy(moving, folders, tmp_path):
    config = config_of(targets=("occupancy+0.5",), epochs=1)
    (figures,) = train([moving.folder], config, tmp_path / "run")
    assert 0 <= figures["val_occupancy+0.5_iou"] <= 1
    completer = Completer.from_pretrained(tmp_path / "run")
    predict_split(completer, moving, "test", tmp_path / "p")
    read, split = Predicted(tmp_path / "p"), moving.split("test")
    read.check(moving, "test")
    for sample in split:
        expected = completer(sample).others["occupancy+0.5"]
        assert_array_equal(read.completion(sample, split).others["occupancy+0.5"], expected)
        assert 0 <= expected.min() <= expected.max() <= 1
    refuses("no movers", partial(train, [folders[0]], config, tmp_path / "other"))
