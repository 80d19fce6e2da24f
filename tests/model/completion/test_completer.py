"""One object from weights to predictions: shapes, units, and errors that say what to do."""

import copy
import socket
from functools import partial

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lidarsim import GridSpec, Lidar
from lidarsim.sensors.catalogue import OS1_64
from scenegen.dataset.parameters import sensor_entry
from scenegen.model.checkpoint import load_network, save_network
from scenegen.model.completion.completer import Completer, opened_once, unlike
from scenegen.model.config import BUNDLED, bundled
from scenegen.model.training.card import card
from scenegen.worlds.mapping import Mapper
from tests.model.conftest import completer_of, saved_network
from tests.model.training.runs import elsewhere
from tests.refusals import check_wording, refuses

GRID = GridSpec(shape=(16, 24, 8))


save = partial(saved_network, grid=GRID)


@pytest.fixture
def observed():
    return np.random.default_rng(0).random((5, *GRID.shape)) < 0.05


def test_batches_are_completed_as_the_network_says(tmp_path, observed):
    network = save(tmp_path / "net.safetensors")
    with torch.no_grad():
        output = network({"observed": torch.from_numpy(observed)})
    completer = Completer.from_pretrained(tmp_path / "net.safetensors", batch=2)
    arrays = completer(observed).arrays()
    assert {values.dtype for values in arrays.values()} == {np.dtype(np.float32)}
    assert_allclose(arrays["occupancy_probability"], output.logits.sigmoid(), atol=1e-5)
    assert_allclose(arrays["tudf"], output.tudf.clamp(max=2.0), atol=1e-5)
    for single in (np.flip(np.flip(observed[2])), observed[2].astype(np.float64)):
        assert_allclose(completer(single).tudf, arrays["tudf"][2], atol=1e-5)
    tensor = completer(torch.from_numpy(observed)).occupancy_probability
    assert isinstance(tensor, torch.Tensor)
    assert not tensor.requires_grad
    assert_allclose(tensor, arrays["occupancy_probability"], atol=1e-6)


def test_copies_and_forks_complete_as_well(tmp_path, observed):
    completer = completer_of(tmp_path / "net.safetensors", GRID)
    torch.set_num_threads(2)
    assert_allclose(copy.deepcopy(completer)(observed).tudf, completer(observed).tudf, atol=1e-5)
    assert torch.get_num_threads() == 2
    fork = elsewhere(opened_once, "anywhere", "cpu", 1)  # which has none of these threads
    fork.join(30)
    fork.kill()
    assert fork.exitcode == 0


def test_wild_networks_are_bounded_or_refused(tmp_path):
    network, path = save(tmp_path / "net.safetensors"), tmp_path / "wild.safetensors"

    def complete():
        save_network(path, network, GRID, {})
        return Completer.from_pretrained(path)(np.zeros(GRID.shape, bool))

    with torch.no_grad():
        network.head["tudf"].split.bias.fill_(50.0)
        assert (complete().tudf == np.float32(2.0)).all()
        for parameter in network.head.parameters():
            parameter.copy_(3e38 * torch.randn_like(parameter).sign())
    refuses("NaN", complete)


def test_other_maps_are_refused(tmp_path):
    inputs = ("observed", "distance")
    completer = completer_of(tmp_path / "net.safetensors", GRID, inputs=inputs)
    empty, metres = np.zeros(GRID.shape, bool), np.full(GRID.shape, 0.5)
    assert completer({"observed": empty, "distance": metres}).tudf.shape == GRID.shape
    for name, *maps in (
        ("observed alone", empty),
        ("another shape", np.zeros((24, 16, 8)), metres),
        ("no mask", metres, metres),
        ("no map", empty[None][:0], metres[None][:0]),
        ("no array", None, metres),
        ("NaN", empty, np.nan * metres),
        ("another count", empty, np.stack([metres] * 2)),
    ):
        refuses(name, completer, dict(zip(inputs, maps, strict=False)))
    refuses("grid", completer.complete, empty, empty, grid=GridSpec())


def test_only_folders_are_networks_by_themselves(tmp_path, monkeypatch):
    save(tmp_path / "run" / "best.safetensors")
    assert Completer.from_pretrained(tmp_path / "run").name == "run"

    def refuse(*given):
        raise AssertionError("reached for the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    for name in ("nobody/nothing", "proposd", str(tmp_path)):
        refuses(name, Completer.from_pretrained, name)


def test_a_repository_is_fetched_when_asked_for(tmp_path, monkeypatch, capfd):
    import huggingface_hub

    save(tmp_path / "model.safetensors")

    def fetch(*given, revision):
        assert given == ("user/net", "model.safetensors")
        assert revision == "v2"
        return str(tmp_path / "model.safetensors")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", fetch)
    Completer.from_pretrained("hf://user/net@v2")

    def fail(*given, **named):
        huggingface_hub.utils.logging.get_logger("huggingface_hub").warning("retrying in 1s")
        raise OSError("401 Client Error\nmore")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", fail)
    refuses("401", Completer.from_pretrained, "hf://user/net")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", bundled())
def test_bundled_networks_have_their_cards(name):
    about = load_network(BUNDLED / f"{name}.safetensors")[2]
    assert (BUNDLED / f"{name}.md").read_text(encoding="utf-8") == card(name, about)


OWN, NOISE = Lidar(rows=8, max_range_m=30.0), "dropout:share=0.05"
NOISY_TOO = {"also": [{"lidar": sensor_entry(OWN), "noise": [NOISE]}]}
NAMED = {"noise": ["gathered:Weather"]}
"""Names of users' own stages hold words of the line."""


@pytest.mark.parametrize(
    ("header", "lidar", "mapper", "noise"),
    [  # networks of earlier commits name no sensor: theirs was the paper's
        ({}, Lidar(), Mapper(scan_spacing_m=3.0), ""),
        ({"lidar": sensor_entry(OWN)}, OWN, Mapper(), ""),
        ({}, OWN, Mapper(), ""),
        ({}, OS1_64, Mapper(), ""),
        ({}, Lidar(), Mapper(scans=5), ""),
        ({"noise": ["", NOISE]}, Lidar(), Mapper(), NOISE),
        ({}, Lidar(), Mapper(), NOISE),
        (NOISY_TOO, OWN, Mapper(), ""),
        (NAMED, Lidar(), Mapper(), "as_asked_for:There"),
    ],
)  # fmt: skip
def test_a_network_says_how_maps_differ(header, lidar, mapper, noise):
    line = unlike("net", header, lidar, mapper, noise)
    check_wording((header, lidar.shape, mapper.scans, noise), line or "nothing")
