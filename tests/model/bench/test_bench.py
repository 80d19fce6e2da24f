"""The bench from end to end on a small dataset: its rows, its report, its predictions files, and
how it refuses."""

import json
from dataclasses import replace
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_equal

from lidarsim.grid import iou
from scenegen.__main__ import app
from scenegen.base.workers import Local
from scenegen.draw.sample import rng_of
from scenegen.model.bench.methods import METHODS, Completed, Predicted, Truth, find_method
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS
from scenegen.model.bench.report import build_report, to_markdown
from scenegen.model.bench.run import bench, plan_all
from scenegen.model.completion.protocol import Prediction, ReturnsCompleter
from scenegen.model.config import BenchConfig, PlanConfig, Thresholds
from tests.model.bench.planning.test_measure import EAST, FAR, FREE, GRID, LATTICE
from tests.refusals import refuses

CONFIG = BenchConfig(trials=20, plan=PlanConfig(step_voxels=2))


class Nothing:
    """Predicts that nothing is there."""

    name = "nothing"

    def complete(self, observed, free, *, grid):
        far = np.full(observed.shape, 2.0, np.float32)
        return Prediction(np.zeros(observed.shape, np.float32), far)


class Plain(Nothing):
    def complete(self, observed, free, *, grid):
        return observed.astype(np.float32)


class Wild(Nothing):
    def complete(self, observed, free, *, grid):
        return Prediction(np.full(observed.shape, 1.5, np.float32))


class Copied(Truth):
    """The truth, of which it is not sure, with distances that are a share of the true ones."""

    name = "copied"

    def __init__(self, nearer=1.0):
        self.nearer = np.float32(nearer)

    def completion(self, sample, split):
        probability = np.where(sample.occupancy, np.float32(0.6), np.float32(0.3))
        return Prediction(probability, self.nearer * sample.tudf)


def test_names_of_rows_print_no_lines():
    completer = Nothing()
    completer.name = "a\nwritten: \x1b[2J"
    assert Completed(completer).name == "a written: \\x1b[2J"


def write_predictions(path, dataset, *, drop=0):
    """The truth of the test split as a predictions file."""
    samples = list(dataset.split("test"))[drop:]
    with h5py.File(path, "w") as file:
        file.attrs.update({"dataset": dataset.manifest.digest, "split": "test"})
        for name in ("world", "viewpoint", "tudf"):
            file[name] = np.array([getattr(sample, name) for sample in samples])
        occupied = np.array([sample.occupancy for sample in samples], np.float32)
        file["occupancy_probability"] = occupied
    return path


def report_of(dataset, out, *words, names=()):
    """What the command makes of one dataset: JSON without NaN and Infinity, which are none."""
    rows = [word for name in names for word in ("--method", name)]
    given = ("bench", dataset.folder, "-o", out, "--quick", "--quiet", "--workers", 1, *words)
    app.main([*map(str, given), *rows], standalone_mode=False)
    return json.loads((out / "report.json").read_text(), parse_constant=pytest.fail)


def table_of(dataset, *rows, config=CONFIG):
    """The report of one dataset."""
    return build_report([bench(dataset, rows, config)], seed=0, about={})


def test_perfect_predictions_score_and_plan_as_the_truth(dataset, tmp_path):
    predicted = Predicted(write_predictions(tmp_path / "p.h5", dataset))
    predicted.check(dataset, "test")
    result = bench(dataset, [Truth(), predicted, Copied()], CONFIG)
    truth, from_file, copied = result.methods.values()
    # six metrics of distance, four of occupancy, and chamfer
    for perfect in (truth, from_file):
        assert np.unique(perfect.reconstruction[:, 0], axis=0).tolist() == [[0] * 6 + [1] * 4 + [0]]
    assert truth.trials == from_file.trials
    reseeded = bench(dataset, [Truth()], replace(CONFIG, seed=1)).methods["truth"]
    assert reseeded.trials != truth.trials
    # free voxels have just that, and are not above it; 0.6 is below the paper's threshold
    assert copied.thresholds.probability == pytest.approx(0.3)
    assert copied.values("iou").max() == 0
    assert_array_equal(copied.values("iou", region=-1), 1)


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
    split, config = dataset.split("test"), replace(CONFIG, draws=3)
    rows = [Completed(Drawn()), Completed(ReturnsCompleter())]
    first, again = (bench(dataset, rows, config, execute=Local("", n)) for n in (1, 2))
    drawn, plain = first.methods.values()
    assert_array_equal(drawn.reconstruction, again.methods["drawn"].reconstruction)

    def iou_of(n, draw):
        rng, sample = rng_of(0, n, draw), split[n]
        return iou(sample.observed | (rng.random(sample.observed.shape) < 0.1), sample.occupancy)

    ious = [[iou_of(n, draw) for draw in range(3)] for n in range(len(split))]
    best = dict(zip(METRICS, drawn.best.T, strict=True))
    assert_allclose(drawn.values("iou"), np.mean(ious, axis=1))
    assert_allclose(best["iou"], np.max(ious, axis=1))
    assert (best["rmse"] < drawn.values("rmse")).all()
    assert plain.best is None
    alone = bench(dataset, rows[1:], CONFIG).methods["returns"]
    assert_array_equal(plain.reconstruction, alone.reconstruction)
    assert plain.trials == alone.trials
    assert to_markdown(build_report([first], seed=0, about={})).count("best of 3 draws") == 1


def test_every_figure_has_its_place(dataset, tmp_path, capsys):
    report = report_of(dataset, tmp_path, "--json")
    assert json.loads(capsys.readouterr().out) == report
    maps, paths = (report[table]["pillar"] for table in ("reconstruction", "planning"))
    assert list(maps) == list(paths) == ["empty", "returns", "conservative", "extrude", "truth"]
    figures = [row[name] for row in maps.values() for name in METRICS]
    figures += [row[name] for row in paths.values() for name in PLAN_METRICS]
    assert {tuple(figure) for figure in figures} == {("mean", "std", "low", "high", "n")}
    returns = maps["returns"]
    assert returns["unobserved"]["iou"]["mean"] == 0  # returns say nothing about unknown voxels
    assert returns["precision"]["mean"] == 1.0
    about = report["datasets"]["pillar"]
    assert about["digest"] == dataset.manifest.digest
    assert paths["truth"]["success_blocked"]["n"] == about["blocked_lines"]
    assert "unmarked" not in paths["truth"]
    tested = [test["metric"] for test in report["tests"]["pillar"]]
    assert tested[-2:] == ["success_blocked", "success"]
    assert not [name for name in returns if "+" in name or name == "ghosts"]  # nothing moves


def test_paths_can_be_refined_on_transforms(dataset):
    """Of what is predicted; or on the predicted distances, which are half of the true ones."""
    trials = {}
    for field in ("transform", "predicted"):
        plan = replace(CONFIG.plan, field=field, edge_check=True)
        config = replace(CONFIG, plan=plan, thresholds=Thresholds(probability=0.5))
        methods = bench(dataset, [Copied(0.5), Truth()], config).methods
        trials[field] = [method.trials for method in methods.values()]
    assert trials["transform"][0] == trials["transform"][1]
    assert trials["predicted"][0] != trials["predicted"][1]


def test_only_learned_rows_choose_common_successes(dataset):
    """A row that only stands beside them takes none away; where there are only such rows, all
    count."""

    def lengths(*rows):
        first, *_ = table_of(dataset, *rows)["planning"]["pillar"].values()
        return [first[chosen]["length"]["n"] for chosen in ("successes", "all_succeed")]

    learned, beside = Completed(Nothing()), find_method("conservative")
    for rows in ((learned, beside), (Truth(),)):
        successes, common = lengths(*rows)
        assert common == successes > 0
    assert not any(find_method(name).learned for name in METHODS.builtin)


@pytest.mark.parametrize("crossed", [True, False])
def test_blocked_lines_and_crossed_hits_are_told(crossed):
    """A wall across the straight line to the first goal, of whose voxels rays crossed all, or
    none."""
    occupied = FREE.copy()
    occupied[30] = True
    maps = {"observed": ~FREE, "free": FREE | crossed, "occupancy": occupied, "known": None}
    case = SimpleNamespace(sample=SimpleNamespace(**maps), grid=GRID, truth=(occupied, FAR))
    goals = [EAST, LATTICE.centres([0, 6, 3])]
    trials = plan_all(Prediction(FREE.astype(np.float32)), case, goals, BenchConfig())
    names = ("success", "success_blocked", "hits", "crossed_hits")
    figures = [[PLAN_METRICS[name].of(trial) for name in names] for trial in trials]
    assert_equal(figures, [[False, False, True, crossed], [True, np.nan, False, False]])


@pytest.mark.parametrize("method", ["Plain", "Wild"])
def test_methods_that_are_none_are_refused(dataset, tmp_path, method):
    name = f"{__name__}:{method}"
    refuses(method, report_of, dataset, tmp_path / "b", names=[name])
