"""A page with predictions shows what they say, what they miss and what they invent."""

import h5py
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from scenegen.dataset.read import Dataset
from scenegen.display.exchange.files import write_points
from scenegen.model.completion.unlearned import Extrude
from scenegen.model.config import BenchConfig
from scenegen.model.evaluation.methods import Completed, Truth
from scenegen.model.evaluation.run import bench
from scenegen.model.evaluation.shown import guesses
from scenegen.truth import distance_field
from tests.command_line import refused, run
from tests.scenegen.display.test_page import Seen, unpacked


def test_a_page_holds_what_is_predicted(made, tmp_path, capsys):
    dataset = Dataset(made)
    samples = dataset.split("test")
    rng = np.random.default_rng(0)
    guesses = rng.random((len(samples), *dataset.grid.shape)).astype(np.float32)
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file.attrs.update({"dataset": dataset.manifest.digest, "split": "test"})
        file["occupancy_probability"] = guesses
        for name in ("world", "viewpoint"):
            file[name] = np.array([getattr(sample, name) for sample in samples], np.int64)
        file["tudf"] = np.stack([distance_field(guess > 0.85, dataset.grid) for guess in guesses])
    words = f"view {made} --predictions {tmp_path}/p.h5 -o {tmp_path}/page.html --quiet"
    code, _, said = run(capsys, f"{words} --split test")
    assert (code, said) == (0, "")
    shown = Seen((tmp_path / "page.html").read_text(encoding="utf-8")).data()["samples"]
    assert len(shown) == len(samples)
    for packed, sample, guess in zip(shown, samples, guesses > 0.85, strict=True):
        (said,) = packed["guesses"]
        bits = np.unpackbits(np.frombuffer(unpacked(said["mask"]), np.uint8))[: guess.size].reshape(
            guess.shape
        )
        assert_array_equal(bits.astype(bool), guess)
        tudf = (
            np.frombuffer(unpacked(said["tudf"]), np.uint8).reshape(guess.shape)
            / 255
            * packed["truncation"]
        )
        assert_allclose(tudf, distance_field(guess, dataset.grid), atol=packed["truncation"] / 500)
        missed, invented = (sample.occupancy & ~guess).sum(), (guess & ~sample.occupancy).sum()
        assert f"{missed} missed, {invented} invented" in packed["figures"]["p"]
    code, _, said = run(capsys, f"{words} --split train")  # which the file does not predict
    assert (code, said.count("\n")) == (1, 1)
    assert "p.h5" in said


def test_the_paths_that_are_shown_are_those_that_the_bench_measures(made):
    dataset, methods = Dataset(made), [Truth(), Completed(Extrude())]
    split, config = dataset.split("test"), BenchConfig(trials=8)
    measured = bench(dataset, methods, config)
    shown = [guesses(methods, config, trial, sample, split) for trial in (0, 1) for sample in split]
    assert len(shown) == len(measured.trial_worlds) == 8
    for n, said in enumerate(shown):  # the bench, too, has the first trial of every sample first
        for guess, method in zip(said, methods, strict=True):
            trial, route = measured.methods[method.name].trials[n], guess.route
            assert route.fails == (not trial.success)
            assert (route.points is None) == np.isnan(trial.length_m)
            if route.points is not None:
                legs = np.linalg.norm(np.diff(route.points, axis=0), axis=1)
                assert_allclose(legs.sum(), trial.length_m)
                assert_allclose([route.points[0], route.points[-1]], [route.start, route.goal])
    far = guesses(methods, config, 10_000, split[0], split)
    assert all(guess.route is None for guess in far)


def test_scans_completions_of_them_and_runs_are_drawn(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("scenegen.display.panels.DPI", 40)
    points = np.random.default_rng(0).uniform(-5, 5, (500, 3))
    for suffix in (".pcd", ".bin"):
        write_points(tmp_path / f"scan{suffix}", points, None, {})
    shape = (16, 16, 8)
    with h5py.File(tmp_path / "done.h5", "w") as file:
        file.attrs.update({"method": "mine", "origin": np.zeros(3), "voxel": 0.5})
        file["observed"] = np.random.default_rng(1).random(shape) > 0.9
        file["occupancy_probability"] = np.random.default_rng(2).random(shape).astype(np.float32)
    with h5py.File(tmp_path / "split.h5", "w") as file:
        file.attrs.update({"method": "mine", "split": "test"})
    (tmp_path / "run").mkdir()
    row = {"epoch": 0, "train_loss": 0.5, "val_loss": 0.6, "val_iou": 0.4, "val_near_mae": 0.2}
    (tmp_path / "run" / "metrics.csv").write_text(
        f"{','.join(row)},val_new\n{','.join(map(str, row.values()))},\n"
    )
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "metrics.csv").write_text("epoch,val_loss\n1,much\n")
    (tmp_path / "empty.npz").write_bytes(b"PK")
    for name in ("scan.pcd", "scan.bin", "done.h5", "run"):
        code, _, said = run(capsys, f"render {tmp_path}/{name} -o {tmp_path}/x.png --quiet")
        assert (code, said) == (0, ""), name
        assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
        (tmp_path / "x.png").unlink()
    for name, part in (
        ("split.h5", "--predictions"),
        ("bad", "metrics.csv"),
        ("empty.npz", ".npz"),
        ("run/x.h5", "x.h5"),
    ):
        assert part in refused(capsys, f"render {tmp_path}/{name} -o {tmp_path}/x.png")
        assert not (tmp_path / "x.png").exists()
