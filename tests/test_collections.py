"""Every command that reads a dataset reads several, and some of their samples, as one."""

import pytest
import torch

from scenegen.model.checkpoint import save_network
from scenegen.model.config import NetworkConfig
from scenegen.model.network import Network
from tests.command_line import code_of, done
from tests.conftest import contents, dataset_in
from tests.refusals import refuses_command
from tests.scenegen import each_case

COUNTS = {"train": 4, "val": 2, "test": 4}


@pytest.fixture
def here(once, tmp_path, monkeypatch):
    """The working folder, with a collection of two datasets, the first samples of each of their
    flights, and a network."""

    def make(folder):
        for seed, name in enumerate("ab"):
            made = dataset_in(folder / "both" / name, seed=seed, counts=COUNTS)
        torch.manual_seed(0)
        network = Network(NetworkConfig(width=2, height=made.grid.shape[2]))
        save_network(folder / "n.safetensors", network, made.grid, {})
        chosen = "--where", "viewpoint=0", "-o", folder / "few.json"
        assert code_of("take", folder / "both", *chosen, "--quiet") == 0

    for path in once("collections", make).iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    torch.set_num_threads(1)
    return tmp_path


@pytest.mark.parametrize("data", ["both", "few.json"])
@each_case("../collections", "words")
def test_every_command_takes_it(here, capsys, words, data):
    done(capsys, words.replace("DATA", data))


def test_measures_are_kept_beside_one_dataset(here, capsys):
    before = contents(here / "both")
    refuses_command(capsys, "inspect few.json --keep --json")
    assert contents(here / "both") == before
