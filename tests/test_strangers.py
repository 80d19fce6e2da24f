"""Nothing that is not ours is replaced or removed, by any command, whatever its name is."""

import os

import numpy as np
import pytest
import torch

from scenegen.__main__ import PLACES
from tests.command_line import ROOT, SMALL, done, refused, rows
from tests.refusals import check_wording, refuses_command
from tests.scenegen.base import everywhere

FILES = f"""
world d 0 -o w.xml                      → w.xml
render d --quiet                        → sample.png
scan {ROOT}/scenes/forest.xml --flight --quiet                    → scan.ply
sensors raster -o s.png                 → s.png
recipe pillar -o new/r.toml             → new/r.toml
view d --html v.html --n 1              → v.html
export n.safetensors                    → n.onnx
calibrate n.safetensors d -o c.safetensors                    → c.safetensors
complete scan.npy --weights n.safetensors --device cpu        → scan.completed.h5
map scan.npy --assume-free              → map.npz
take d --n 1 -o t.json                  → t.json
fly world pillar --robot reactive --flights 1 -o f.json       → f.json
"""
"""Commands and a file that each writes."""
GENERATE = "generate --recipe small.toml --n 3 --val 0 --test 0 --quiet --out out"
FOLDERS = f"""
bench d --quick --method returns -o out → report.json
train d --out out --epochs 1 --device cpu → card.md
train d --out out --epochs 1 --device cpu → best.safetensors
{GENERATE} → train-00000.h5
{GENERATE} → rays.npy
{GENERATE} → dataset.json
{GENERATE} → notes.txt
generate --like d --noise range:0.02 --quiet --out out        → rays.npy
generate --kind mixed --n 24 --quiet --out out                → collection.json
convert d --to npz -o out               → convert.json
convert d --to npz -o out               → train/000000.npz
complete d --weights n.safetensors -o out                     → test-00000.h5
complete d --weights n.safetensors -o out                     → predictions.json
ingest log -o out                       → map.npz
publish d --repo ada/d --dry-run -o out → README.md
publish d --repo ada/d --dry-run -o out → SHA256SUMS
"""
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
    named = {words.split()[0] for words, _ in rows(FILES) + rows(FOLDERS)}
    assert named | set(SILENT) == set(PLACES), "a new command? say here what it writes"


@pytest.mark.parametrize(("words", "name"), rows(FILES) + rows(FOLDERS))
def test_a_strangers_file_is_not_replaced(words, name, here, capsys):
    folder = "out" * ((words, name) in rows(FOLDERS))
    path = here / folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    content = b"{}" if path.suffix == ".json" else b"mine"
    path.write_bytes(content)
    before = set(here.rglob("*"))
    line = refused(capsys, words)
    assert (folder or name) in line
    check_wording(f"{words} {name}", line.rstrip("\n"))
    assert path.read_bytes() == content
    assert set(here.rglob("*")) == before


@pytest.mark.parametrize(("words", "name"), [rows(FILES)[n] for n in (0, 4, 5)])
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
