"""Nothing that is not ours is replaced or removed, by any command, whatever its name is."""

import os

import numpy as np
import pytest
import torch

from scenegen.__main__ import PLACES
from tests.command_line import ROOT, SMALL, done
from tests.refusals import refuses_command
from tests.scenegen import cases
from tests.scenegen.base import everywhere

FILES = [(words.replace("ROOT", str(ROOT)), name) for words, name in cases("../files")]
"""Commands and a file that each writes."""
FOLDERS = cases("../folders")
"""Commands and a name that each uses in the folder `out`."""
SILENT = ("completion", "doctor", "inspect", "verify")
"""Commands that write no file."""


@pytest.fixture
def here(once, tmp_path, monkeypatch):
    """The working folder, with what the commands read: a dataset, a network and a scan."""

    def make(folder):
        everywhere.make(folder)
        np.save(folder / "scan.npy", np.random.default_rng(0).normal(size=(50, 3)))
        (folder / "small.toml").write_text(SMALL)

    for path in once("strangers", make).iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    torch.set_num_threads(1)
    return tmp_path


def test_every_command_is_here():
    named = {words.split()[0] for words, _ in FILES + FOLDERS}
    assert named | set(SILENT) == set(PLACES), "a new command? say here what it writes"


@pytest.mark.parametrize(("words", "name"), FILES + FOLDERS)
def test_a_strangers_file_is_not_replaced(words, name, here, capsys):
    folder = "out" * ((words, name) in FOLDERS)
    path = here / folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    content = b"{}" if path.suffix == ".json" else b"mine"
    path.write_bytes(content)
    before = set(here.rglob("*"))
    assert (folder or name) in refuses_command(capsys, words, f"{words} {name}")
    assert path.read_bytes() == content
    assert set(here.rglob("*")) == before


@pytest.mark.parametrize(("words", "name"), [FILES[n] for n in (0, 4, 5)])
def test_its_own_is_replaced_until_somebody_changes_it(words, name, here, capsys):
    try:
        os.setxattr(here, "user.test", b"")
    except (AttributeError, OSError):
        pytest.skip("this file system keeps no attributes")
    for _ in range(2):
        done(capsys, words)
    content = (here / name).read_bytes() + b"and mine"
    (here / name).write_bytes(content)
    refuses_command(capsys, words)
    assert (here / name).read_bytes() == content
