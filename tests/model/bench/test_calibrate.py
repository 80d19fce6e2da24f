"""One command's work, on a small network and dataset: its file carries the calibration, and
everything reads it."""

import h5py
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from scenegen import Completer
from scenegen.model.bench import calibrate as module
from scenegen.model.bench.calibrate import calibrate, count_logits, fit_temperature
from scenegen.model.bench.methods import Predicted
from scenegen.model.calibration import KEY, Calibration
from scenegen.model.checkpoint import load_network
from scenegen.model.completion.predictions import predict_split
from tests.model.bench.test_bench import report_of
from tests.model.conftest import saved_network
from tests.refusals import refuses, refuses_command
from tests.scenegen.base.backwards import Backwards

TRAINED = {"settings": {"loss": {"occupied_weight": 5.0}}, "seed": 0}


@pytest.fixture
def weights(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MIN_WORLDS", 1)
    saved_network(tmp_path / "net.safetensors", dataset.grid, TRAINED)
    return tmp_path / "net.safetensors"


def test_a_file_carries_its_calibration(dataset, weights, tmp_path):
    before = load_network(weights)[0].state_dict()
    out, samples = tmp_path / "sure.safetensors", dataset.split("test")
    calibration = calibrate(weights, [dataset], out, split="test")
    network, _, about = load_network(out)
    assert Calibration.of(about) == calibration
    del about[KEY]
    assert about == TRAINED
    torch.testing.assert_close(network.state_dict(), before, rtol=0, atol=0)
    assert calibration.worlds == 3
    assert calibration.class_weight == 5.0
    assert calibration.datasets == (str(dataset.manifest.digest),)
    # it depends neither on what was there nor on where it is done
    backwards = Backwards("", 1)
    again = calibrate(out, [dataset], weights, split="test", execute=backwards)
    assert again == calibration

    completer = Completer.from_pretrained(out)
    away, _ = predict_split(completer, dataset, "test", tmp_path / "p")
    assert away == [completer(sample.observed).away for sample in samples]
    assert max(away) < 1  # it was calibrated on these
    with h5py.File(tmp_path / "p/test-00000.h5") as file:
        expected = completer(samples[0].observed).probability
        assert_allclose(file["probability"][0], expected, atol=1e-5)


def test_stored_probabilities_are_judged(dataset, weights, tmp_path, undrawn):
    completer = Completer.from_pretrained(weights)
    predict_split(completer, dataset, "test", tmp_path / "p")
    with h5py.File(tmp_path / "p/test-00000.h5", "a") as file:
        del file.attrs["digest"]  # which says that nothing was added
        file["probability"] = np.array([one.occupancy for one in dataset.split("test")], np.float32)
    Predicted(tmp_path / "p").check(dataset, "test")
    words = ("--predictions", tmp_path / "p", "--reliability")
    report = report_of(dataset, tmp_path / "b", *words, names=["truth", "returns", "seen"])
    rows = report["reliability"]["pillar"]
    assert list(rows) == ["truth", "returns", "seen", "p"]
    truth, returns = (rows[name]["map"]["said"]["ece"] for name in ("truth", "returns"))
    assert truth == 0.0 < returns
    assert rows["p"]["map"]["calibrated"]["ece"] == 0.0


@pytest.mark.parametrize("weight", [None, 0])
def test_untold_class_weights_are_refused(dataset, weights, tmp_path, weight):
    odd = tmp_path / "odd.safetensors"
    saved_network(odd, dataset.grid, {"settings": {"loss": {"occupied_weight": weight}}})
    refuses(weight, calibrate, odd, [dataset], weights)


def test_what_cannot_be_calibrated_is_refused(dataset, weights, tmp_path, monkeypatch):
    odd, out = tmp_path / "odd.safetensors", tmp_path / "none.safetensors"
    saved_network(odd, dataset.grid, TRAINED, variant="tudf")
    refuses("tudf", calibrate, odd, [dataset], out)
    saved_network(odd, dataset.grid, TRAINED | {KEY: {"worlds": -1, "temperature": 1.0}})
    refuses("damaged", Completer.from_pretrained, odd)
    refuses("twice", calibrate, weights, [dataset] * 2, out, split="test")
    monkeypatch.setattr(module, "MIN_WORLDS", 20)
    refuses("few", calibrate, weights, [dataset], out, split="test")
    assert not out.exists()


@pytest.mark.parametrize("name", ["net.onnx", "proposed"])
def test_bad_use_leaves_nothing(dataset, tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.onnx").write_bytes(b"")
    (tmp_path / "d").symlink_to(dataset.folder)
    refuses_command(capsys, f"calibrate {name} d --workers 1 --quiet")
    assert {path.name for path in tmp_path.iterdir()} == {"net.onnx", "d"}


@pytest.mark.parametrize("temperature", [0.5, 2.5])
def test_known_temperatures_are_fitted(temperature, rng):
    """Of one that is as sure again, or less, by a weight of 5; and of maps that have its root. Only
    unknown voxels count."""
    logit = rng.normal(-1, 2, 200_000)
    occupied = rng.random(len(logit)) < 1 / (1 + np.exp(-logit))
    weighted = (1 / (1 + np.exp(-(temperature * logit + np.log(5))))).astype(np.float32)
    unknown = np.arange(len(logit)) % 3 > 0
    counts = count_logits(weighted, occupied ^ ~unknown, unknown, 5.0)
    assert counts.sum() == unknown.sum()
    for power in (1, 0.5):
        fitted = fit_temperature(counts[None], np.array([power])) ** power
        assert fitted == pytest.approx(temperature, rel=0.03)
