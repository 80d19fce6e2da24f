"""Occupancy at later times: metrics by hand, rows by simple rules, and a network that predicts
it."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import scenegen
from lidarsim import GridSpec
from scenegen import Completer, Prediction
from scenegen.model.bench.methods import find_method
from scenegen.model.bench.metrics import ScoredMap, metrics_of
from scenegen.model.config import Thresholds
from scenegen.model.targets import targets_of
from scenegen.worlds.traffic import Traffic
from tests.conftest import dataset_in, small_recipe
from tests.model.bench.test_bench import report_of
from tests.model.test_targets import config_of
from tests.model.training.runs import train
from tests.refusals import refuses, refuses_command

COUNTS = {"train": 5, "val": 2, "test": 6}
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


def case_of(now, later):
    """A map with a voxel that stands; the second voxel is below the ground. What is predicted of
    now, and of then, unless that is left out."""
    sample = SimpleNamespace(
        grid=GRID,
        observed=row("##.#.#.."),
        static_occupancy=row("##......"),
        motion=SimpleNamespace(passed=lambda after_s: row(".##.##..")),
    )
    others = {"occupancy+1": 0.96 * row(later)} if later else {}
    return ScoredMap(
        prediction=Prediction(row(now).astype(np.float32), others=others),
        truth={"occupancy": row("##...#.."), "occupancy+1": row("##..#...")},
        grid=GRID,
        thresholds=Thresholds(),
        scored=~row(".#......"),
        sample=sample,
    )


@pytest.mark.parametrize(
    ("now", "later", "expected"),
    [
        ("#..#.#..", "", [1 / 4, 0, 1]),
        ("#....#..", "#...##.#", [1 / 2, 1 / 2, 0]),
        ("#....#..", "#...###.", [1 / 2, 1 / 3, 0]),
    ],
)
def test_later_metrics_by_hand(now, later, expected):
    """Of the voxels that count, then 0 and 4 are occupied. Movers pass 2, 4 and 5, near 3 and 6;
    3 holds a return, and nothing now."""
    metrics = metrics_of(targets_of(["occupancy+1"]))
    names = "occupancy+1_iou", "occupancy+1_moving_iou", "ghosts"
    assert [metrics[name].of(case_of(now, later)) for name in names] == expected


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
    names = ("truth", "moved", "flow")
    rows = report_of(moving, tmp_path, names=names)["reconstruction"]["pillar"]
    figures = sorted(name for name in rows["truth"] if "+" in name)
    ends = "0.5_iou", "0.5_moving_iou", "1_iou", "1_moving_iou"
    assert figures == [f"occupancy+{end}" for end in ends]
    for name in figures:
        assert rows["truth"][name]["mean"] < rows["moved"][name]["mean"] == 1
    assert "IoU after 0.5 s" in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize(
    ("folder", "words"),
    [
        ("dataset", "--metric occupancy+1"),
        ("dataset", "--method flow"),
        ("moving", "--metric occupancy+2"),  # beyond the courses
    ],
)
def test_datasets_without_such_movers_are_refused(request, tmp_path, capsys, folder, words):
    folder = request.getfixturevalue(folder).folder
    refuses_command(capsys, f"bench {folder} --quick --workers 1 -o {tmp_path} {words}")


def test_a_network_predicts_later_occupancy(moving, folders, tmp_path):
    config = config_of(targets=("occupancy+0.5",), epochs=1)
    (figures,) = train([moving.folder], config, tmp_path / "run")
    assert 0 <= figures["val_occupancy+0.5_iou"] <= 1
    later = Completer.from_pretrained(tmp_path / "run")(moving.split("test")[0]).others
    assert 0 <= later["occupancy+0.5"].min() <= later["occupancy+0.5"].max() <= 1
    refuses("no movers", train, [folders[0]], config, tmp_path / "other")
