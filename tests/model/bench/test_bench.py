"""The bench from end to end on a small dataset: its rows, its report, its predictions files, and how it refuses."""

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, ScenegenError
from scenegen.model.bench.command import choose_methods, run_bench
from scenegen.model.bench.methods import Completed, Truth
from scenegen.model.bench.predicted import Predicted
from scenegen.model.bench.reconstruction import METRICS
from scenegen.model.bench.run import BenchConfig, bench
from scenegen.model.bench.tuning import tune
from scenegen.model.complete import Prediction, Returns, Thresholds
from scenegen.model.planning.config import PlanConfig
from scenegen.source import DrawnWorlds
from tests.conftest import small_recipe

CONFIG = BenchConfig(trials=20, plan=PlanConfig(step_voxels=2))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Nine test maps of three worlds."""
    folder = tmp_path_factory.mktemp("data")
    recipe = small_recipe(world={"density": (0.05, 0.1)})
    build(plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=0, counts={"train": 3, "val": 4, "test": 9}))
    return Dataset(folder)


class Nothing:
    """Predicts that nothing is there."""

    name = "nothing"

    def complete(self, observed: np.ndarray, free: np.ndarray, *, grid: object) -> Prediction:
        return Prediction(
            occupancy_probability=np.zeros(observed.shape, np.float32), tudf=np.full(observed.shape, 2.0, np.float32)
        )


def test_a_rows_name_prints_no_line_of_its_own() -> None:
    completer = Nothing()
    completer.name = "a\nwritten: \x1b[2J"
    assert Completed(completer).name == "a written: \\x1b[2J"


class Copied:
    """The truth, through what a completer may say: found by the observed voxels, which no two samples share."""

    name = "copied"

    def __init__(self, dataset: Dataset):
        self.answers = {s.observed.tobytes(): s for name in ("val", "test") for s in dataset.split(name)}

    def complete(self, observed: np.ndarray, free: np.ndarray, *, grid: object) -> Prediction:
        sample = self.answers[observed.tobytes()]
        return Prediction(
            occupancy_probability=np.where(sample.occupancy, np.float32(0.6), np.float32(0.3)), tudf=sample.tudf
        )


def write_predictions(path: Path, dataset: Dataset, *, drop: int = 0, digest: str | None = None) -> Path:
    """The truth of the test split as a predictions file."""
    samples = list(dataset.split("test"))[drop:]
    with h5py.File(path, "w") as file:
        file.attrs["dataset"] = digest or dataset.manifest.digest
        file.attrs["split"] = "test"
        file["world"] = np.array([sample.world for sample in samples], dtype=np.int64)
        file["viewpoint"] = np.array([sample.viewpoint for sample in samples], dtype=np.int64)
        file["tudf"] = np.array([sample.tudf for sample in samples])
        file["occupancy_probability"] = np.array([sample.occupancy for sample in samples], dtype=np.float32)
    return path


def test_a_perfect_prediction_scores_perfectly_and_plans_like_the_truth(dataset: Dataset, tmp_path: Path) -> None:
    predicted = Predicted(write_predictions(tmp_path / "p.h5", dataset))
    predicted.check(dataset, "test")
    found = bench(dataset, [Truth(), predicted, Completed(Copied(dataset))], CONFIG)
    truth, from_file, copied = found.methods.values()
    for perfect in (truth, from_file):
        np.testing.assert_array_equal(perfect.reconstruction[:, 0, :6], 0)
        np.testing.assert_array_equal(perfect.reconstruction[:, 0, 6:], 1)
    assert truth.trials == from_file.trials
    assert copied.thresholds.probability == pytest.approx(0.35)
    assert copied.reconstruction[:, 0, METRICS.index("iou")].max() == 0, "0.6 is below the paper's threshold"
    np.testing.assert_array_equal(copied.tuned[:, METRICS.index("iou")], 1)


def test_an_empty_prediction_flies_straight_and_collides_more_often(dataset: Dataset) -> None:
    found = bench(dataset, [Truth(), Completed(Nothing())], CONFIG)
    truth, nothing = found.methods["truth"].trials, found.methods["nothing"].trials
    assert len(truth) == len(nothing) == 20
    assert sum(trial.success for trial in nothing) < sum(trial.success for trial in truth)
    assert {trial.cause for trial in nothing} <= {None, "initial_collides"}
    assert np.mean([trial.length_m for trial in nothing]) < np.mean([trial.length_m for trial in truth])
    assert found.methods["nothing"].reconstruction[:, 0, METRICS.index("recall")].max() == 0


def test_workers_and_other_rows_change_no_figure(dataset: Dataset) -> None:
    alone = bench(dataset, [Completed(Returns())], CONFIG)
    beside = bench(dataset, [Truth(), Completed(Returns())], CONFIG, workers=2)
    ours, theirs = alone.methods["returns"], beside.methods["returns"]
    np.testing.assert_array_equal(ours.reconstruction, theirs.reconstruction)
    assert ours.trials == theirs.trials
    assert bench(dataset, [Truth()], BenchConfig(trials=20, seed=1, plan=CONFIG.plan)).methods["truth"].trials != (
        beside.methods["truth"].trials
    )


def test_a_method_that_says_the_same_at_any_threshold_keeps_the_papers(dataset: Dataset) -> None:
    assert tune(Completed(Returns()), dataset, most=4, thresholds=Thresholds()) == Thresholds()


class Silent:
    """A progress bar that shows nothing."""

    def __enter__(self) -> "Silent":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def start(self, total: int) -> None:
        pass

    def count(self, samples: int) -> None:
        pass


def report_of(dataset: Dataset, out: Path, **options: object) -> dict:
    """What the command makes of one dataset."""
    given = {"names": (), "predictions": None, "split": "test", "quick": True, "seed": 0, "workers": 1, **options}
    return run_bench([dataset.folder], out=out, command="test", progress=lambda label: Silent(), **given)


def test_the_report_holds_every_figure_in_its_place(dataset: Dataset, tmp_path: Path) -> None:
    report = report_of(dataset, tmp_path / "bench")
    assert report == json.loads((tmp_path / "bench" / "report.json").read_text())
    for table, names in (("reconstruction", METRICS), ("planning", ("success", "length", "min_clearance"))):
        assert list(report[table]["pillar"]) == ["returns", "conservative", "extrude", "truth"]
        for row in report[table]["pillar"].values():
            for name in names:
                assert set(row[name]) == {"mean", "std", "low", "high", "n"}
    returns = report["reconstruction"]["pillar"]["returns"]
    assert returns["unobserved"]["iou"]["mean"] == 0, "returns say nothing about unknown voxels"
    assert {"tuned", "unobserved", "by_class"} < set(returns)
    assert {"successes", "failures"} < set(report["planning"]["pillar"]["returns"])
    assert returns["precision"]["mean"] == 1.0
    assert returns["iou"]["low"] <= returns["iou"]["mean"] <= returns["iou"]["high"]
    assert report["datasets"]["pillar"]["digest"] == dataset.manifest.digest
    text = (tmp_path / "bench" / "report.md").read_text()
    assert "*Proposed*" in text
    assert "0.559 ± 0.058" in text


def test_predictions_that_do_not_fit_are_refused_by_name(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "p.h5"

    def refused(message: str) -> None:
        with pytest.raises(DatasetError, match=message):
            report_of(dataset, tmp_path / "bench", predictions=path)

    path.write_bytes(b"no HDF5")
    refused("cannot be read as HDF5")
    write_predictions(path, dataset, digest="0" * 64)
    refused("predicts dataset 000000000000")
    write_predictions(path, dataset, drop=2)
    refused("2 of 9 samples are missing, the first is world 0, viewpoint 0")
    write_predictions(path, dataset)
    with h5py.File(path, "a") as file:
        file["tudf"][3, 0, 0, 0] = np.nan
    refused("holds NaN")
    with h5py.File(path, "a") as file:
        del file["tudf"]
        file["tudf"] = np.zeros((9, 2, 2, 2), np.float32)
    refused("holds maps of")
    with h5py.File(path, "a") as file:
        del file["tudf"], file["occupancy_probability"]
    refused("at least one of")
    assert not (tmp_path / "bench").exists()


def set_voxel(name: str, value: float) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[name][3, 1, 2, 3] = value

    return change


def put(name: str, value: Any, **options: Any) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, data=value, **options)

    return change


def promise_a_terabyte(file: h5py.File) -> None:
    """Chunks that were never written: a file of a few kilobytes."""
    del file["tudf"]
    file.create_dataset("tudf", (9, 24, 24, 16), np.float32, chunks=(9, 24, 24, 16), maxshape=(None, None, None, None))
    del file["occupancy_probability"], file["world"]
    file.create_dataset("world", (10**12,), np.int64, chunks=(10**6,))


def repeat_a_row(file: h5py.File) -> None:
    file["world"][1], file["viewpoint"][1] = file["world"][0], file["viewpoint"][0]


def leave_unwritten(file: h5py.File) -> None:
    """What a program leaves that ended too early."""
    del file["tudf"]
    file.create_dataset("tudf", (9, 24, 24, 16), np.float32, chunks=(1, 24, 24, 16))[:5] = 1.0


def link_outside(file: h5py.File) -> None:
    del file["tudf"]
    file["tudf"] = h5py.ExternalLink("/etc/passwd", "tudf")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_voxel("occupancy_probability", 7.0), "row 3: occupancy_probability holds 7, expected a probability"),
        (set_voxel("occupancy_probability", -3.0), "occupancy_probability holds -3"),
        (set_voxel("tudf", -0.5), "row 3: tudf holds -0.5, expected a distance of at least 0"),
        (set_voxel("tudf", np.inf), "tudf holds NaN or infinity"),
        (leave_unwritten, "tudf is not written to its end"),
        (repeat_a_row, "1 of 9 samples are missing"),
        (put("tudf", np.zeros((8, 24, 24, 16), np.float32)), "tudf has 8 rows, expected 9"),
        (put("tudf", np.zeros((9, 24, 24, 16), "S3")), "tudf is no array of float32"),
        (put("tudf", np.zeros((9, 24, 24, 16), np.complex64)), "tudf is no array of float32"),
        (put("tudf", 1.0), "tudf holds maps of"),
        (put("world", np.zeros(9)), "world is no array of whole numbers"),
        (put("world", np.zeros((9, 2), int)), "world holds maps of"),
        (lambda file: file.move("world", "elsewhere"), "expected world, viewpoint"),
        (lambda file: (file.pop("world"), file.create_group("world")), "world is no array"),
        (link_outside, "none of them a link"),
        (lambda file: file.attrs.update({"split": np.arange(3)}), "predicts split"),
        (lambda file: file.attrs.update({"dataset": b"\x1b[31m\n"}), "predicts dataset"),
        (promise_a_terabyte, "viewpoint has 9 rows, expected 1000000000000"),
    ],
)
def test_predictions_that_cannot_be_are_refused_in_one_line(
    dataset: Dataset, tmp_path: Path, change: Callable[[h5py.File], None], said: str
) -> None:
    path = write_predictions(tmp_path / "p.h5", dataset)
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(DatasetError) as caught:
        Predicted(path).check(dataset, "test")
    assert said in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_cut_or_scrambled_predictions_file_is_refused_in_one_line(dataset: Dataset, tmp_path: Path) -> None:
    whole = write_predictions(tmp_path / "p.h5", dataset).read_bytes()
    rng = np.random.default_rng(0)
    for n in range(12):
        content = bytearray(whole)
        if n % 2:
            del content[int(rng.integers(len(whole))) :]
        else:
            start = int(rng.integers(4000))
            content[start : start + 64] = rng.bytes(64)
        (tmp_path / "p.h5").write_bytes(content)
        with contextlib.suppress(DatasetError):
            Predicted(tmp_path / "p.h5").check(dataset, "test")
    with pytest.raises(DatasetError, match="no such file"):
        Predicted(tmp_path / "absent.h5").check(dataset, "test")


def test_predictions_of_one_split_say_nothing_of_another(dataset: Dataset, tmp_path: Path) -> None:
    """Worlds are numbered from 0 in every split, so a row must go by its split, too."""
    predicted = Predicted(write_predictions(tmp_path / "p.h5", dataset))
    with pytest.raises(KeyError):
        predicted.completion(dataset.split("val")[0], split="val", grid=dataset.grid)
    assert tune(predicted, dataset, most=4, thresholds=Thresholds()) == Thresholds()


class Nameless:
    complete = Nothing.complete


class Aimless:
    name = "aimless"


class Plain(Nothing):
    def complete(self, observed: np.ndarray, free: np.ndarray, *, grid: object) -> Any:
        return observed.astype(np.float32)


class Flat(Nothing):
    def complete(self, observed: np.ndarray, free: np.ndarray, *, grid: object) -> Prediction:
        return Prediction(occupancy_probability=np.zeros(7, np.float32))


class Listed(Nothing):
    def complete(self, observed: np.ndarray, free: np.ndarray, *, grid: object) -> Prediction:
        return Prediction(tudf=[[[0.0]]])


class Wild(Nothing):
    def complete(self, observed: np.ndarray, free: np.ndarray, *, grid: object) -> Prediction:
        return Prediction(occupancy_probability=np.full(observed.shape, 1.5, np.float32))


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("Nameless", "Nameless: lacks `name`"),
        ("Aimless", "Aimless: lacks `complete`"),
        ("Plain", "nothing: gives ndarray, expected a scenegen.model.complete.Prediction"),
        (
            "Flat",
            r"occupancy_probability is an array of shape \(7,\), expected an array of shape \(24, 24, 16\)",
        ),
        ("Listed", "nothing: tudf is list"),
        ("Wild", "nothing: occupancy_probability holds 1.5"),
    ],
)
def test_methods_that_are_none_are_refused_in_one_line(
    dataset: Dataset, tmp_path: Path, method: str, said: str
) -> None:
    with pytest.raises(ScenegenError, match=said) as caught:
        report_of(dataset, tmp_path / "bench", names=(f"{__name__}:{method}",))
    assert "\n" not in str(caught.value)


def test_one_world_gives_no_interval(tmp_path: Path) -> None:
    recipe = small_recipe()
    counts = {"train": 3, "val": 0, "test": 3}
    build(plan_dataset(tmp_path / "d", recipe, DrawnWorlds(recipe), seed=0, counts=counts))
    report = report_of(Dataset(tmp_path / "d"), tmp_path / "bench", names=("returns", "truth"))
    figure = report["reconstruction"]["pillar"]["returns"]["iou"]
    assert (figure["low"], figure["high"], figure["n"]) == (None, None, 3)
    assert all(test["low"] is None for test in report["tests"]["pillar"])
    text = (tmp_path / "bench" / "report.md").read_text()
    assert "[–]" in text
    assert "which one world does not give" in text
    assert "nan" not in text


def test_unknown_methods_and_empty_splits_are_refused(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(ScenegenError, match="known are returns"):
        choose_methods(["retruns"])
    assert choose_methods(["tests.model.bench.test_bench:Nothing"])[0].name == "nothing"
    recipe = small_recipe()
    build(plan_dataset(tmp_path / "d", recipe, DrawnWorlds(recipe), seed=0, counts={"train": 3, "val": 0, "test": 0}))
    with pytest.raises(DatasetError, match=r"test split is empty; generate with --test .* or give another --split"):
        bench(Dataset(tmp_path / "d"), [Truth()], CONFIG)
