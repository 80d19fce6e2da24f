"""Every command that reads a dataset reads several, and some of their samples, as one."""

import pytest
import torch

from scenegen.model.checkpoint import save_network
from scenegen.model.config import NetworkConfig
from scenegen.model.network import Network
from tests.command_line import code_of, done, rows
from tests.conftest import contents, dataset_in
from tests.refusals import refuses_command

COUNTS = {"train": 4, "val": 2, "test": 4}
COMMANDS = """
inspect DATA
verify DATA --quick --workers 1
view DATA --html v.html --n 4 --weights n.safetensors
render DATA --split test -o r.png
world DATA 0 -o w.xml
take DATA --split test --n 3 -o t.json
convert DATA --to npz -o out
complete DATA --weights n.safetensors -o out --device cpu
bench DATA --quick --method returns --workers 1
train DATA --epochs 1 --width 1 --out run --device cpu
"""


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
@pytest.mark.parametrize("words", [words for (words,) in rows(COMMANDS)])
def test_every_command_takes_it(here, capsys, words, data):
    done(capsys, words.replace("DATA", data))


def test_measures_are_kept_beside_one_dataset(here, capsys):
    before = contents(here / "both")
    refuses_command(capsys, "inspect few.json --keep --json")
    assert contents(here / "both") == before
