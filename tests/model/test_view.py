"""A page with predictions shows what they say, what they miss and what they invent."""

import h5py
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from scenegen.dataset.read import Dataset
from scenegen.model.bench.methods import Completed, Truth
from scenegen.model.bench.report import CAUSES
from scenegen.model.bench.run import bench
from scenegen.model.bench.shown import guesses
from scenegen.model.completion.protocol import Extrude
from scenegen.model.config import BenchConfig
from scenegen.truth import distance_field
from tests.command_line import refused, run
from tests.model.bench.test_bench import write_predictions
from tests.scenegen.view.test_page import Seen, unpacked


def test_a_page_holds_what_is_predicted(made, tmp_path, capsys, rng):
    dataset = Dataset(made)
    samples = dataset.split("test")
    guesses = rng.random((len(samples), *dataset.grid.shape)).astype(np.float32)
    with h5py.File(write_predictions(tmp_path / "p.h5", dataset), "a") as file:
        file["occupancy_probability"][:] = guesses
        file["tudf"][:] = [distance_field(guess > 0.85, dataset.grid) for guess in guesses]
    words = f"view {made} --predictions {tmp_path}/p.h5 -o {tmp_path}/page.html --quiet"
    assert run(capsys, f"{words} --split test") == (0, "", "")
    shown = Seen((tmp_path / "page.html").read_text(encoding="utf-8")).data()["samples"]
    assert len(shown) == len(samples)
    for packed, sample, guess in zip(shown, samples, guesses > 0.85, strict=True):
        (said,) = packed["guesses"]
        bits = np.unpackbits(np.frombuffer(unpacked(said["mask"]), np.uint8))[: guess.size]
        assert_array_equal(bits.reshape(guess.shape), guess)
        far = packed["truncation"]
        tudf = np.frombuffer(unpacked(said["tudf"]), np.uint8).reshape(guess.shape) / 255 * far
        assert_allclose(tudf, distance_field(guess, dataset.grid), atol=far / 500)
        missed, invented = (sample.occupancy & ~guess).sum(), (guess & ~sample.occupancy).sum()
        assert f"{missed} missed, {invented} invented" in packed["figures"]["p"]
    assert "p.h5" in refused(capsys, f"{words} --split train")  # which it does not predict


def test_the_paths_that_are_shown_are_those_that_the_bench_measures(made):
    dataset, methods = Dataset(made), [Truth(), Completed(Extrude())]
    split, config = dataset.split("test"), BenchConfig(trials=8)
    measured = bench(dataset, methods, config)
    shown = [
        guesses(methods, config, trial, split, n) for trial in (0, 1) for n in range(len(split))
    ]
    assert len(shown) == len(measured.trial_worlds) == 8
    for n, said in enumerate(shown):  # the bench, too, has the first trial of every sample first
        for guess, method in zip(said, methods, strict=True):
            trial, route = measured.methods[method.name].trials[n], guess.route
            assert (route.told in CAUSES.values()) == (not trial.success)
            assert (route.points is None) == np.isnan(trial.length_m)
            if route.points is not None:
                legs = np.linalg.norm(np.diff(route.points, axis=0), axis=1)
                assert_allclose(legs.sum(), trial.length_m)
                assert_allclose([route.points[0], route.points[-1]], [route.start, route.goal])
    far = guesses(methods, config, 10_000, split, 0)
    assert all(guess.route is None for guess in far)
