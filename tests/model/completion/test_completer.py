"""One object from weights to predictions: shapes, units, and errors that say what to do."""

import copy
import re
import socket
from functools import partial

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lidarsim import GridSpec, Lidar
from lidarsim.sensors.catalogue import OS1_64
from scenegen.dataset.parameters import sensor_entry
from scenegen.model.checkpoint import CheckpointError, load_network, save_network
from scenegen.model.completion.completer import Completer, opened_once, unlike
from scenegen.model.completion.protocol import PredictionError
from scenegen.model.config import BUNDLED, bundled
from scenegen.model.training.card import card
from scenegen.worlds.mapping import Mapper
from tests.model.conftest import completer_of, saved_network
from tests.model.training.runs import elsewhere

GRID = GridSpec(shape=(16, 24, 8))


save = partial(saved_network, grid=GRID)


@pytest.fixture
def observed():
    return np.random.default_rng(0).random((5, *GRID.shape)) < 0.05


@pytest.mark.parametrize("variant", ["proposed", "occ", "tudf"])
def test_a_batch_is_completed_as_the_network_says(tmp_path, observed, variant):
    network = save(tmp_path / "net.safetensors", variant=variant)
    with torch.no_grad():
        output = network({"observed": torch.from_numpy(observed)})
    found = Completer.from_pretrained(tmp_path / "net.safetensors", batch=2)(observed)
    expected = (
        None if variant == "tudf" else output.logits.sigmoid(),
        None if variant == "occ" else output.tudf.clamp(max=2.0),
    )
    for one, other in zip((found.occupancy_probability, found.tudf), expected, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            assert one.dtype == np.float32
            assert_allclose(one, other, atol=1e-5)


def test_what_goes_in_decides_what_comes_out(tmp_path, observed):
    completer = completer_of(tmp_path / "net.safetensors", GRID)
    batch = completer(observed)
    for given in (np.flip(np.flip(observed[2])), observed[2].astype(np.float64)):
        single = completer(given)
        assert single.tudf.shape == GRID.shape
        assert isinstance(single.tudf, np.ndarray)
        assert_allclose(single.tudf, batch.tudf[2], atol=1e-5)
    torch.set_num_threads(2)
    assert_allclose(copy.deepcopy(completer)(observed).tudf, batch.tudf, atol=1e-5)
    assert torch.get_num_threads() == 2
    fork = elsewhere(opened_once, "anywhere", "cpu", 1)  # which has none of these threads
    fork.join(30)
    fork.kill()
    assert fork.exitcode == 0
    torch.set_num_threads(1)
    tensor = completer(torch.from_numpy(observed))
    assert isinstance(tensor.occupancy_probability, torch.Tensor)
    assert not tensor.occupancy_probability.requires_grad
    assert_allclose(tensor.occupancy_probability, batch.occupancy_probability, atol=1e-6)


def test_distances_end_at_the_truncation_and_completions_that_are_no_numbers_are_refused(tmp_path):
    network = save(tmp_path / "net.safetensors")

    def complete():
        save_network(tmp_path / "wild.safetensors", network, GRID, {})
        return Completer.from_pretrained(tmp_path / "wild.safetensors")(np.zeros(GRID.shape, bool))

    with torch.no_grad():
        network.head["tudf"].split.bias.fill_(50.0)
        assert (complete().tudf == np.float32(2.0)).all()
        for parameter in network.head.parameters():
            parameter.copy_(3e38 * torch.randn_like(parameter).sign())
    with pytest.raises(PredictionError, match="wild: occupancy_probability holds NaN or infinity"):
        complete()


def test_other_maps_are_refused(tmp_path):
    completer = completer_of(tmp_path / "net.safetensors", GRID)
    for wrong, named in (
        (np.zeros((24, 16, 8), bool), r"expected \(16, 24, 8\)"),
        (np.full(GRID.shape, 0.5), "other than 0 and 1"),
        (np.zeros((0, *GRID.shape), bool), "no map"),
        (None, "observed is of type NoneType; expected a sample"),
    ):
        with pytest.raises(ValueError, match=named):
            completer(wrong)
    with pytest.raises(ValueError, match="completes maps on"):
        completer.complete(np.zeros(GRID.shape, bool), np.zeros(GRID.shape, bool), grid=GridSpec())


def test_networks_are_found_by_folder_and_nothing_else_is_fetched(tmp_path, monkeypatch):
    save(tmp_path / "run" / "best.safetensors")
    assert Completer.from_pretrained(tmp_path / "run").name == "run"

    def refuse(*given):
        raise AssertionError("reached for the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    for name, said in (
        ("nobody/nothing", "a repository on the Hub is hf://nobody/nothing"),
        ("proposd", "no such network"),
        (str(tmp_path), "a folder without best.safetensors"),
    ):
        with pytest.raises(CheckpointError, match=said):
            Completer.from_pretrained(name)


def test_a_repository_is_fetched_when_asked_for(tmp_path, monkeypatch, capfd):
    import huggingface_hub

    save(tmp_path / "model.safetensors")
    asked = []

    def fetch(*given, **named):
        asked.append((given, named))
        return str(tmp_path / "model.safetensors")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", fetch)
    Completer.from_pretrained("hf://user/net@v2")
    assert asked == [(("user/net", "model.safetensors"), {"revision": "v2"})]

    def fail(*given, **named):
        huggingface_hub.utils.logging.get_logger("huggingface_hub").warning("retrying in 1s")
        raise OSError("401 Client Error\nmore")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", fail)
    with pytest.raises(CheckpointError, match="hf://user/net: cannot be fetched: 401 Client Error"):
        Completer.from_pretrained("hf://user/net")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["occ", "proposed", "tudf"])
def test_bundled_networks_complete_the_papers_grid(name):
    """A wall ahead: what is behind it is nearer to something than the empty side is."""
    completer = Completer.from_pretrained(name)
    observed = np.zeros(completer.grid.shape, bool)
    observed[55, 30:50, 10:30] = True
    found = completer(observed)
    if found.occupancy_probability is not None:
        assert found.occupancy_probability[55, 35:45, 15:25].mean() > 0.5
        assert found.occupancy_probability[45:50, 35:45, 15:25].mean() < 0.2
    if found.tudf is not None:
        assert found.tudf[55, 35:45, 15:25].mean() < 0.5 < found.tudf[45, 35:45, 15:25].mean()
    assert completer.about["figures"]["val_iou"] > 0.2


@pytest.mark.parametrize("name", bundled())
def test_a_bundled_network_has_the_card_of_its_own_header(name):
    found = load_network(BUNDLED / f"{name}.safetensors")[2]
    assert (BUNDLED / f"{name}.md").read_text(encoding="utf-8") == card(name, found)


OWN, NOISE = Lidar(rows=8, max_range_m=30.0), "dropout:share=0.05"
NOISY_TOO = {"also": [{"lidar": sensor_entry(OWN), "noise": [NOISE]}]}


@pytest.mark.parametrize(
    ("header", "met", "said"),
    [  # networks of earlier commits name no sensor: theirs was the paper's
        ({}, (Lidar(), Mapper(scan_spacing_m=3.0)), ""),
        ({"lidar": sensor_entry(OWN)}, (OWN,), ""),
        ({}, (OWN,), "another sensor.*rows is 16 in training, 8 here"),
        ({}, (OS1_64,), "another sensor.*16 × 120 rays in training"),
        ({}, (Lidar(), Mapper(scans=5)), "maps made otherwise.*mapping.scans is 1 in training, 5"),
        ({"noise": ["", NOISE]}, (Lidar(), Mapper(), NOISE), ""),
        ({}, (Lidar(), Mapper(), NOISE), "other noise.*noise is none in training, dropout"),
        (NOISY_TOO, (OWN,), "other noise.*noise is dropout.* in training, none here"),
        # names that hold the words of such lines
        (
            {"noise": ["gathered:Weather"]},
            (Lidar(), Mapper(), "as_asked_for:There"),
            "other noise.*noise is gathered:Weather in training, as_asked_for:There here$",
        ),
    ],
)
def test_a_network_says_where_maps_are_not_those_of_its_training(header, met, said):
    found = unlike("net", header, *met, *(Mapper(), "")[len(met) - 1 :])
    assert re.match(f"net was trained on {said}", found) if said else found == ""
