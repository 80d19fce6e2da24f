"""Two small datasets; one thread, since tests run side by side."""

import pytest
import torch

from scenegen import Completer
from scenegen.model.checkpoint import save_network
from scenegen.model.config import NetworkConfig
from scenegen.model.network import Network
from tests.conftest import dataset_in, small_recipe

COUNTS = {"train": 12, "val": 6, "test": 5}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def saved_network(path, grid, about=None, **config):
    """A small network of random weights, always the same, and saved."""
    torch.manual_seed(0)
    network = Network(NetworkConfig(**{"width": 4} | config)).eval()
    path.parent.mkdir(exist_ok=True)
    save_network(path, network, grid, about or {})
    return network


def completer_of(path, grid, about=None, **config):
    """Such a network, loaded to complete maps."""
    saved_network(path, grid, about, **config)
    return Completer.from_pretrained(path)


def make_dataset(folder, kind="pillar", *, compact=False, counts=COUNTS, **tables):
    """A dataset of a few small maps."""
    recipe = small_recipe(kind, **tables)
    dataset_in(folder, recipe, counts=counts, compact=compact, shard_samples=5)
    return folder


@pytest.fixture(scope="session")
def folders(once):
    """One dataset of each kind; the second leaves out what can be derived."""
    pillar = once("pillar", make_dataset)
    return [
        pillar,
        once("geometric", lambda folder: make_dataset(folder, "geometric", compact=True)),
    ]


@pytest.fixture
def undrawn(monkeypatch):
    """Pictures take longer than short runs."""
    monkeypatch.setattr(
        "scenegen.model.training.run_folder.RunFolder.draw_rows", lambda folder, rows: None
    )
    for name, nothing in (("draw_failures", []), ("extremes", "")):
        monkeypatch.setattr(f"scenegen.model.bench.shown.{name}", lambda *given, n=nothing: n)
