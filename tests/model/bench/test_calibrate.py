"""One command's work, on a small network and dataset: its file carries the calibration, and
everything reads it."""

import h5py
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from scenegen.base.errors import DatasetError
from scenegen.model.bench import calibrate as module
from scenegen.model.bench.calibrate import calibrate
from scenegen.model.bench.methods import Predicted
from scenegen.model.calibration import KEY, Calibration
from scenegen.model.checkpoint import CheckpointError, load_network
from scenegen.model.completion.completer import Completer
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
    sure, done = tmp_path / "sure.safetensors", {"split": "test"}
    found = calibrate(weights, [dataset], sure, **done)
    network, _, about = load_network(sure)
    assert Calibration.of(about) == found
    assert {name: value for name, value in about.items() if name != KEY} == TRAINED
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert (found.worlds, found.class_weight) == (3, 5.0)
    assert found.datasets == (str(dataset.manifest.digest),)
    again = calibrate(sure, [dataset], weights, **done, execute=Backwards("", 1))
    assert again == found  # it depends neither on what was there nor on where it is done

    completer = Completer.from_pretrained(sure)
    samples = dataset.split("test")
    said = completer(samples[0].observed)
    away, _ = predict_split(completer, dataset, "test", tmp_path / "p")
    assert away == [completer(one.observed).away for one in samples]
    assert max(away) < 1  # it was calibrated on these
    with h5py.File(tmp_path / "p/test-00000.h5") as file:
        assert_allclose(file["probability"][0], said.probability, atol=1e-5)


def test_stored_probabilities_are_judged(dataset, weights, tmp_path):
    completer = Completer.from_pretrained(weights)
    predict_split(completer, dataset, "test", tmp_path / "p")
    with h5py.File(tmp_path / "p/test-00000.h5", "a") as file:
        del file.attrs["digest"]  # which says that nothing was added
        file["probability"] = np.array([one.occupancy for one in dataset.split("test")], np.float32)
    Predicted(tmp_path / "p").check(dataset, "test")
    words = ("--predictions", tmp_path / "p", "--reliability")
    report = report_of(dataset, tmp_path / "b", *words, names=["truth"])
    assert report["reliability"]["pillar"]["p"]["map"]["calibrated"]["ece"] == 0.0


def test_what_cannot_be_calibrated_is_said(dataset, weights, tmp_path, monkeypatch):
    odd = tmp_path / "odd.safetensors"
    for about in ({}, {"settings": {"loss": {"occupied_weight": 0}}}):
        saved_network(odd, dataset.grid, about)
        refuses(about, calibrate, odd, [dataset], weights, error=CheckpointError)
    saved_network(odd, dataset.grid, TRAINED, variant="tudf")
    refuses("tudf", calibrate, odd, [dataset], weights, error=CheckpointError)
    saved_network(odd, dataset.grid, TRAINED | {KEY: {"worlds": -1, "temperature": 1.0}})
    refuses("damaged", Completer.from_pretrained, odd, error=CheckpointError)
    more = {"split": "test", "error": DatasetError}
    refuses("twice", calibrate, weights, [dataset] * 2, tmp_path / "none.safetensors", **more)
    monkeypatch.setattr(module, "MIN_WORLDS", 20)
    refuses("few", calibrate, weights, [dataset], tmp_path / "none.safetensors", **more)
    assert not (tmp_path / "none.safetensors").exists()


@pytest.mark.parametrize("name", ["net.onnx", "proposed"])
def test_bad_use_of_the_command_leaves_nothing(dataset, tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.onnx").write_bytes(b"")
    (tmp_path / "d").symlink_to(dataset.folder)
    refuses_command(capsys, f"calibrate {name} d --workers 1 --quiet")
    assert {path.name for path in tmp_path.iterdir()} == {"net.onnx", "d"}
