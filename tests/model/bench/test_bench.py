"""The bench from end to end on a small dataset: its rows, its report, its predictions files, and
how it refuses."""

import dataclasses
import json

import h5py
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim.grid import iou
from scenegen.__main__ import app
from scenegen.base.errors import DatasetError, ScenegenError
from scenegen.base.workers import Local
from scenegen.draw.sample import rng_of
from scenegen.model.bench.methods import METHODS, Completed, Predicted, Truth, find_method
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS
from scenegen.model.bench.planner import plan_path, refine
from scenegen.model.bench.report import build_report, to_markdown
from scenegen.model.bench.run import bench, trials_of
from scenegen.model.bench.visibility import Case
from scenegen.model.completion.protocol import Prediction, Returns
from scenegen.model.config import BenchConfig, PlanConfig, Thresholds
from tests.conftest import dataset_in, small_recipe
from tests.refusals import refuses

CONFIG = BenchConfig(trials=20, plan=PlanConfig(step_voxels=2))
ROWS = ["empty", "returns", "conservative", "extrude", "truth"]


class Nothing:
    """Predicts that nothing is there."""

    name = "nothing"

    def complete(self, observed, free, *, grid):
        return Prediction(
            occupancy_probability=np.zeros(observed.shape, np.float32),
            tudf=np.full(observed.shape, 2.0, np.float32),
        )


def test_a_rows_name_prints_no_line_of_its_own():
    completer = Nothing()
    completer.name = "a\nwritten: \x1b[2J"
    assert Completed(completer).name == "a written: \\x1b[2J"


class Copied:
    """The truth, through what a completer may say: found by the observed voxels, which no two
    samples share."""

    name = "copied"

    def __init__(self, dataset, nearer=1.0):
        self.nearer = np.float32(nearer)
        self.answers = {
            s.observed.tobytes(): s for name in ("val", "test") for s in dataset.split(name)
        }

    def complete(self, observed, free, *, grid):
        sample = self.answers[observed.tobytes()]
        return Prediction(
            occupancy_probability=np.where(sample.occupancy, np.float32(0.6), np.float32(0.3)),
            tudf=torch.from_numpy(self.nearer * sample.tudf),
        )


def write_predictions(path, dataset, *, drop=0):
    """The truth of the test split as a predictions file."""
    samples = list(dataset.split("test"))[drop:]
    with h5py.File(path, "w") as file:
        file.attrs.update({"dataset": dataset.manifest.digest, "split": "test"})
        for name in ("world", "viewpoint", "tudf"):
            file[name] = np.array([getattr(sample, name) for sample in samples])
        occupied = [sample.occupancy for sample in samples]
        file["occupancy_probability"] = np.array(occupied, np.float32)
    return path


def test_a_perfect_prediction_scores_perfectly_and_plans_like_the_truth(dataset, tmp_path):
    predicted = Predicted(write_predictions(tmp_path / "p.h5", dataset))
    predicted.check(dataset, "test")
    found = bench(dataset, [Truth(), predicted, Completed(Copied(dataset))], CONFIG)
    truth, from_file, copied = found.methods.values()
    for perfect in (truth, from_file):  # six metrics of distance, and then those of occupancy
        assert_array_equal(perfect.reconstruction[:, 0, :6], 0)
        assert_array_equal(perfect.reconstruction[:, 0, 6:10], 1)
        assert_array_equal(perfect.values("chamfer"), 0)
    assert truth.trials == from_file.trials
    # free voxels have just that, and are not above it; 0.6 is below the paper's threshold
    assert copied.thresholds.probability == pytest.approx(0.3)
    assert copied.reconstruction[:, 0, list(METRICS).index("iou")].max() == 0
    assert_array_equal(copied.values("iou", region=-1), 1)


def test_workers_and_other_rows_change_no_figure(dataset):
    alone = bench(dataset, [Completed(Returns())], CONFIG)
    beside = bench(dataset, [Truth(), Completed(Returns())], CONFIG, execute=Local("", 2))
    ours, theirs = alone.methods["returns"], beside.methods["returns"]
    assert_array_equal(ours.reconstruction, theirs.reconstruction)
    assert ours.trials == theirs.trials
    other = bench(dataset, [Truth()], dataclasses.replace(CONFIG, seed=1))
    assert other.methods["truth"].trials != beside.methods["truth"].trials


class Drawn:
    """Occupied at random, as `rng` says; it writes to its arguments, and remembers one map."""

    name = "drawn"
    maps = 0

    def reset(self):
        self.maps = 0

    def complete(self, observed, free, *, grid, seen, rng):
        assert not hasattr(seen, "occupancy")
        self.maps += 1
        assert self.maps == 1
        observed |= rng.random(grid.shape) < 0.1
        return Prediction(occupancy_probability=observed.astype(np.float32))


def test_draws_are_averaged_and_the_best_of_each_map_stands_beside(dataset):
    """Draw by draw, as the random numbers of each map have it, by any number of workers."""
    split, config = dataset.split("test"), dataclasses.replace(CONFIG, draws=3)
    rows = [Completed(Drawn()), Completed(Returns())]
    first, again = (bench(dataset, rows, config, execute=Local("", n)) for n in (1, 2))
    drawn, plain = first.methods.values()
    assert_array_equal(drawn.reconstruction, again.methods["drawn"].reconstruction)
    ious = []
    for n, sample in enumerate(split):
        for draw in range(3):
            said = sample.observed | (rng_of(0, n, draw).random(split.dataset.grid.shape) < 0.1)
            ious.append(iou(said, sample.occupancy))
    ious = np.reshape(ious, (-1, 3))
    assert_allclose(drawn.values("iou"), ious.mean(axis=1))
    column = [*METRICS].index("iou")
    assert_allclose(drawn.best[:, column], ious.max(axis=1))
    assert (drawn.best[:, [*METRICS].index("rmse")] < drawn.values("rmse")).all()
    assert plain.best is None
    assert_array_equal(
        plain.reconstruction,
        bench(dataset, rows[1:], CONFIG).methods["returns"].reconstruction,
    )
    report = build_report([first], seed=0, about={})
    assert report["reconstruction"]["pillar"]["drawn"]["best_of_draws"]["iou"]["n"] == 9
    assert to_markdown(report).count("best of 3 draws by the truth") == 1


def report_of(dataset, out, *words, names=()):
    """What the command makes of one dataset."""
    given = ("bench", dataset.folder, "-o", out, "--quick", "--quiet", "--workers", 1, *words)
    rows = [word for name in names for word in ("--method", name)]
    app.main([*map(str, given), *rows], standalone_mode=False)
    return strictly(out / "report.json")


def strictly(path):
    """JSON without the words NaN and Infinity, which are none."""
    return json.loads(path.read_text(), parse_constant=pytest.fail)


def test_the_report_holds_every_figure_in_its_place(dataset, tmp_path, capsys):
    report = report_of(dataset, tmp_path / "bench", "--json")
    assert json.loads(capsys.readouterr().out) == report
    for table, names in (("reconstruction", METRICS), ("planning", PLAN_METRICS)):
        assert list(report[table]["pillar"]) == ROWS
        for row in report[table]["pillar"].values():
            assert all(set(row[name]) == {"mean", "std", "low", "high", "n"} for name in names)
    returns = report["reconstruction"]["pillar"]["returns"]
    assert returns["unobserved"]["iou"]["mean"] == 0  # returns say nothing about unknown voxels
    assert returns["precision"]["mean"] == 1.0
    assert returns["iou"]["low"] <= returns["iou"]["mean"] <= returns["iou"]["high"]
    assert report["datasets"]["pillar"]["digest"] == dataset.manifest.digest
    assert "0.559 ± 0.058" in (tmp_path / "bench" / "report.md").read_text()  # the paper's


def test_reliability_stands_beside_tables_that_it_does_not_change(dataset, tmp_path, undrawn):
    rows = ("truth", "seen", "returns")
    plain = report_of(dataset, tmp_path / "plain", names=rows)
    report = report_of(dataset, tmp_path / "more", "--reliability", names=rows)
    assert {name: value for name, value in report.items() if name != "reliability"} == plain
    assert "reliability" not in plain
    by_method = report["reliability"]["pillar"]
    assert list(by_method) == list(rows)
    assert by_method["truth"]["map"]["said"]["ece"] == 0.0
    assert by_method["returns"]["map"]["said"]["ece"] > 0.0


def test_paths_can_be_refined_on_the_transform_of_what_is_predicted(dataset):
    plan = dataclasses.replace(CONFIG.plan, field="transform", edge_check=True)
    config = dataclasses.replace(CONFIG, plan=plan, thresholds=Thresholds(probability=0.5))
    found = bench(dataset, [Completed(Copied(dataset, 0.5)), Truth()], config).methods
    assert found["copied"].trials == found["truth"].trials
    config = dataclasses.replace(config, plan=dataclasses.replace(plan, field="predicted"))
    own = bench(dataset, [Completed(Copied(dataset, 0.5))], config).methods["copied"]
    assert own.trials != found["truth"].trials


def test_trials_in_which_all_succeed_are_told_by_what_may_have_learned(dataset):
    """A row that only stands beside them takes none away; where there are only such rows, all
    count."""
    learned, beside = Completed(Nothing()), Truth()
    both, alone, reference = (
        build_report([bench(dataset, rows, CONFIG)], seed=0, about={})["planning"]["pillar"]
        for rows in ([learned, beside], [learned], [beside])
    )
    assert (
        both["truth"]["all_succeed"]["length"]["n"] == alone["nothing"]["successes"]["length"]["n"]
    )
    rows = [reference["truth"][chosen]["length"] for chosen in ("all_succeed", "successes")]
    assert rows[0]["n"] == rows[1]["n"] > 0
    assert not any(find_method(name).learned for name in METHODS.builtin)


def hits_of(path, occupied, grid):
    """The occupied voxels among those that hold points of a path at most 0.05 m apart, (hits,
    3)."""
    counts = np.ceil(np.linalg.norm(np.diff(path, axis=0), axis=1) / 0.05 - 1e-9).astype(int)
    legs = [np.linspace(*ends, n + 1) for *ends, n in zip(path, path[1:], counts, strict=False)]
    voxels = np.unique(np.floor(np.concatenate(legs) / grid.voxel_m).astype(int), axis=0)
    return voxels[occupied[tuple(voxels.T)]]


def test_trials_with_a_free_line_and_hits_in_crossed_voxels_are_counted_apart(dataset):
    """As computed from the sample and the path: a straight line, and the path of a planner whose
    map is empty."""
    config = dataclasses.replace(CONFIG, trials=400)
    result = bench(dataset, [find_method("empty"), Truth()], config)
    report = build_report([result], seed=0, about={})
    split, grid, plan = dataset.split("test"), dataset.grid, config.plan
    free, far = np.zeros(grid.shape, bool), np.full(grid.shape, 2.0, np.float32)
    lines, rows = [], []
    for index, turn in result.trial_places:
        sample = split[index]
        case = Case(sample, index, split)
        goal = trials_of(case, plan, turn + 1, rng_of(config.seed, index)).goals[turn]
        path = refine(plan_path(free, goal, grid, plan).waypoints, far, grid, plan)
        middle = (np.array(grid.shape) // 2 + 0.5) * grid.voxel_m
        lines.append(len(hits_of([middle, goal], sample.occupancy, grid)) > 0)
        hits = hits_of(path, sample.occupancy, grid)
        crossed = sample.free[tuple(hits.T)]
        rows.append((len(hits) == 0, len(hits) > 0, len(hits) > 0 and crossed.all()))
    success, hit, crossed_only = np.array(rows, float).T
    lines = np.array(lines)
    assert 0 < lines.sum() < len(lines)
    assert 0 < crossed_only.sum() < hit.sum()
    empty = result.methods["empty"]
    assert_array_equal(empty.values("success"), success)
    assert_array_equal(empty.values("success_blocked"), np.where(lines, success, np.nan))
    assert_array_equal(empty.values("hits"), hit)
    assert_array_equal(empty.values("crossed_hits"), crossed_only)
    assert report["datasets"]["pillar"]["blocked_lines"] == lines.sum()
    planned = report["planning"]["pillar"]
    assert planned["empty"]["success_blocked"]["mean"] == pytest.approx(success[lines].mean())
    assert planned["truth"]["success_blocked"]["n"] == lines.sum()
    assert "unmarked" not in planned["truth"]
    tested = [test["metric"] for test in report["tests"]["pillar"]]
    assert tested[-2:] == ["success_blocked", "success"]
    assert f" {400 - lines.sum()} it is free" in to_markdown(report)


class Plain(Nothing):
    def complete(self, observed, free, *, grid):
        return observed.astype(np.float32)


class Wild(Nothing):
    def complete(self, observed, free, *, grid):
        return Prediction(occupancy_probability=np.full(observed.shape, 1.5, np.float32))


@pytest.mark.parametrize("method", ["Plain", "Wild"])
def test_methods_that_are_none_are_refused(dataset, tmp_path, method):
    name = f"{__name__}:{method}"
    refuses(method, report_of, dataset, tmp_path / "b", names=[name], error=ScenegenError)


def test_one_world_gives_no_interval_and_an_empty_split_nothing(tmp_path, undrawn):
    counts = {"train": 3, "val": 0, "test": 3}
    dataset = dataset_in(tmp_path / "d", small_recipe(), counts=counts)
    report = report_of(dataset, tmp_path / "bench", names=("returns", "truth"))
    figure = report["reconstruction"]["pillar"]["returns"]["iou"]
    assert (figure["low"], figure["high"], figure["n"]) == (None, None, 3)
    assert all(test["low"] is None for test in report["tests"]["pillar"])
    assert "nan" not in (tmp_path / "bench" / "report.md").read_text()
    refuses("empty", bench, dataset, [Truth()], BenchConfig(split="val"), error=DatasetError)
