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
from scenegen.model.completion.protocol import Prediction, Returns
from scenegen.model.config import BenchConfig, PlanConfig, Thresholds
from tests.conftest import dataset_in
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
        occupied = [sample.occupancy for sample in samples]
        file["occupancy_probability"] = np.array(occupied, np.float32)
    return path


def report_of(dataset, out, *words, names=()):
    """What the command makes of one dataset: JSON without NaN and Infinity, which are none."""
    rows = [word for name in names for word in ("--method", name)]
    given = ("bench", dataset.folder, "-o", out, "--quick", "--quiet", "--workers", 1, *words)
    app.main([*map(str, given), *rows], standalone_mode=False)
    return json.loads((out / "report.json").read_text(), parse_constant=pytest.fail)


def test_perfect_predictions_score_and_plan_as_the_truth(dataset, tmp_path):
    predicted = Predicted(write_predictions(tmp_path / "p.h5", dataset))
    predicted.check(dataset, "test")
    result = bench(dataset, [Truth(), predicted, Copied()], CONFIG)
    truth, from_file, copied = result.methods.values()
    for perfect in (truth, from_file):  # six metrics of distance, and then those of occupancy
        assert_array_equal(perfect.reconstruction[:, 0, :6], 0)
        assert_array_equal(perfect.reconstruction[:, 0, 6:10], 1)
        assert_array_equal(perfect.values("chamfer"), 0)
    assert truth.trials == from_file.trials
    # free voxels have just that, and are not above it; 0.6 is below the paper's threshold
    assert copied.thresholds.probability == pytest.approx(0.3)
    assert copied.values("iou").max() == 0
    assert_array_equal(copied.values("iou", region=-1), 1)


def test_workers_and_rows_change_no_figure(dataset):
    alone = bench(dataset, [Completed(Returns())], CONFIG).methods["returns"]
    beside = bench(dataset, [Truth(), Completed(Returns())], CONFIG, execute=Local("", 2)).methods
    assert_array_equal(beside["returns"].reconstruction, alone.reconstruction)
    assert beside["returns"].trials == alone.trials
    reseeded = bench(dataset, [Truth()], replace(CONFIG, seed=1)).methods
    assert reseeded["truth"].trials != beside["truth"].trials


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


def test_every_figure_has_its_place(dataset, tmp_path, capsys):
    report = report_of(dataset, tmp_path, "--json")
    assert json.loads(capsys.readouterr().out) == report
    for table, names in (("reconstruction", METRICS), ("planning", PLAN_METRICS)):
        rows = report[table]["pillar"]
        assert list(rows) == ["empty", "returns", "conservative", "extrude", "truth"]
        for figure in (row[name] for row in rows.values() for name in names):
            assert set(figure) == {"mean", "std", "low", "high", "n"}
    returns = report["reconstruction"]["pillar"]["returns"]
    assert returns["unobserved"]["iou"]["mean"] == 0  # returns say nothing about unknown voxels
    assert returns["precision"]["mean"] == 1.0
    assert returns["iou"]["low"] <= returns["iou"]["mean"] <= returns["iou"]["high"]
    about = report["datasets"]["pillar"]
    assert about["digest"] == dataset.manifest.digest
    planned = report["planning"]["pillar"]
    assert planned["truth"]["success_blocked"]["n"] == about["blocked_lines"]
    assert "unmarked" not in planned["truth"]
    tested = [test["metric"] for test in report["tests"]["pillar"]]
    assert tested[-2:] == ["success_blocked", "success"]
    assert "0.559 ± 0.058" in (tmp_path / "report.md").read_text()  # the paper's


def test_reliability_stands_beside_the_tables(dataset, tmp_path, undrawn):
    rows = ("truth", "seen", "returns")
    plain = report_of(dataset, tmp_path / "plain", names=rows)
    report = report_of(dataset, tmp_path / "more", "--reliability", names=rows)
    by_method = report.pop("reliability")["pillar"]
    assert report == plain
    assert list(by_method) == list(rows)
    assert (
        by_method["truth"]["map"]["said"]["ece"] == 0.0 < by_method["returns"]["map"]["said"]["ece"]
    )


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

    def length(method, chosen, *rows):
        report = build_report([bench(dataset, rows, CONFIG)], seed=0, about={})
        return report["planning"]["pillar"][method][chosen]["length"]["n"]

    learned, beside, truth = Completed(Nothing()), find_method("conservative"), Truth()
    expected = length("nothing", "successes", learned)
    assert length("nothing", "all_succeed", learned, beside) == expected > 0
    assert length("truth", "all_succeed", truth) == length("truth", "successes", truth) > 0
    assert not any(find_method(name).learned for name in METHODS.builtin)


def test_blocked_lines_and_crossed_hits_are_told():
    """A wall across the straight line to the first goal, of whose voxels rays crossed all, or
    none."""
    occupied, seen = FREE.copy(), FREE.copy()
    occupied[30] = True
    for crossed in (True, False):
        maps = {"observed": ~seen, "free": seen | crossed, "occupancy": occupied}
        sample = SimpleNamespace(**maps, known=None)
        case = SimpleNamespace(sample=sample, grid=GRID, truth=(occupied, FAR))
        goals = [EAST, LATTICE.centres([0, 6, 3])]
        trials = plan_all(Prediction(FREE.astype(np.float32)), case, goals, BenchConfig())
        figures = {
            name: [PLAN_METRICS[name].of(trial) for trial in trials]
            for name in ("success", "success_blocked", "hits", "crossed_hits")
        }
        assert_equal(
            figures,
            {
                "success": [False, True],
                "success_blocked": [False, np.nan],
                "hits": [True, False],
                "crossed_hits": [crossed, False],
            },
        )


@pytest.mark.parametrize("method", ["Plain", "Wild"])
def test_methods_that_are_none_are_refused(dataset, tmp_path, method):
    name = f"{__name__}:{method}"
    refuses(method, report_of, dataset, tmp_path / "b", names=[name])


def test_one_world_gives_no_interval(tmp_path, undrawn):
    """And an empty split gives nothing."""
    dataset = dataset_in(tmp_path / "d")
    config = BenchConfig(split="train", trials=5)
    report = build_report(
        [bench(dataset, [Completed(Returns()), Truth()], config)], seed=0, about={}
    )
    figure = report["reconstruction"]["pillar"]["returns"]["iou"]
    assert figure["low"] is None
    assert figure["high"] is None
    assert figure["n"] == 3
    assert all(test["low"] is None for test in report["tests"]["pillar"])
    assert "nan" not in to_markdown(report)
    refuses("empty", bench, dataset, [Truth()], BenchConfig(split="val"))
