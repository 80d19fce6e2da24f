"""A page with predictions shows what they say, what they miss and what they invent."""

import itertools

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenegen import Dataset
from scenegen.model.bench.methods import Completed, Truth
from scenegen.model.bench.report import CAUSES
from scenegen.model.bench.run import bench
from scenegen.model.bench.shown import guesses
from scenegen.model.completion.protocol import Extrude
from scenegen.model.config import BenchConfig
from scenegen.truth import distance_field
from tests.command_line import done
from tests.model.bench.test_bench import write_predictions
from tests.refusals import refuses_command
from tests.scenegen.view.test_page import Seen, unpacked


def test_pages_hold_what_is_predicted(made, tmp_path, capsys, rng):
    dataset = Dataset(made)
    samples = dataset.split("test")
    guesses = rng.random((len(samples), *dataset.grid.shape)).astype(np.float32)
    fields = [distance_field(guess > 0.85, dataset.grid) for guess in guesses]
    with h5py.File(write_predictions(tmp_path / "p.h5", dataset), "a") as file:
        file["occupancy_probability"][:], file["tudf"][:] = guesses, fields
    words = f"view {made} --predictions {tmp_path}/p.h5 -o {tmp_path}/page.html --quiet"
    done(capsys, f"{words} --split test")
    packed = Seen((tmp_path / "page.html").read_text(encoding="utf-8")).data()["samples"]
    far = dataset.grid.truncation_m
    for entry, sample, occupied, field in zip(packed, samples, guesses > 0.85, fields, strict=True):
        (guess,) = entry["guesses"]
        mask, tudf = (np.frombuffer(unpacked(guess[name]), np.uint8) for name in ("mask", "tudf"))
        assert_array_equal(np.unpackbits(mask)[: occupied.size], occupied.ravel())
        assert_allclose(tudf.reshape(field.shape) / 255 * far, field, atol=far / 500)
        missed, invented = (
            (sample.occupancy & ~occupied).sum(),
            (occupied & ~sample.occupancy).sum(),
        )
        assert f"{missed} missed, {invented} invented" in entry["figures"]["p"]
    refuses_command(capsys, f"{words} --split train")  # which it does not predict


def test_shown_paths_are_those_measured(made):
    dataset, methods = Dataset(made), [Truth(), Completed(Extrude())]
    split, config = dataset.split("test"), BenchConfig(trials=8)
    measured = bench(dataset, methods, config).methods
    # the bench, too, has the first trial of every sample first
    places = itertools.product((0, 1), range(len(split)))
    for number, (turn, sample) in enumerate(places):
        for guess, method in zip(
            guesses(methods, config, turn, split, sample), methods, strict=True
        ):
            trial, route = measured[method.name].trials[number], guess.route
            assert (route.told in CAUSES.values()) == (not trial.success)
            assert (route.points is None) == np.isnan(trial.length_m)
            if route.points is not None:
                length = np.linalg.norm(np.diff(route.points, axis=0), axis=1).sum()
                assert length == pytest.approx(trial.length_m)
                assert_allclose(route.points[[0, -1]], [route.start, route.goal])
    assert number == 7
    assert {guess.route for guess in guesses(methods, config, 10_000, split, 0)} == {None}
