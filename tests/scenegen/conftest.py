"""A small dataset of a few shards, a check that passes it, and a stand-in for the Hub."""

import shutil
import sys
import time
import types
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

from scenegen.dataset.build import build
from scenegen.dataset.read import Dataset
from scenegen.draw.draw import draw_unit
from scenegen.draw.sample import FIELDS
from scenegen.draw.source import DrawnWorlds
from scenegen.publish.stage import Request
from scenegen.view.look import looks
from tests.scenegen.hub import TOKEN, Hub


def drawn_unit(recipe, unit=0, *, seed=0, split="train"):
    """A unit of the worlds that a recipe draws."""
    return draw_unit(DrawnWorlds(recipe), recipe, seed=seed, split=split, unit=unit)


def same(first, second):
    """Whether two samples have the same fields, of whatever group, bit for bit and of the same
    type."""
    pairs = ((np.asarray(getattr(sample, name)) for sample in (first, second)) for name in FIELDS)
    return all((a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()) for a, b in pairs)


def built(plan, **options):
    """The dataset of a plan, made."""
    build(plan, **options)
    return Dataset(plan.folder)


def names(folder):
    """What lies in it."""
    return {path.name for path in folder.iterdir()}


def wait_for(condition, seconds=60):
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "has waited too long"
        time.sleep(0.05)


Check = namedtuple("Check", "name ok detail skipped", defaults=[False])


@pytest.fixture
def dataset(made, tmp_path):
    """A copy of it, to change."""
    return Path(shutil.copytree(made, tmp_path / "data" / "pillar"))


@pytest.fixture
def look(made):
    """What is shown of one of its samples."""
    (shown,), _ = looks(Dataset(made), "train", [1])
    return shown


@pytest.fixture
def asked(undrawn, dataset, tmp_path):
    """To publish it."""
    return Request(
        dataset=dataset, repository="ada/small-pillars", out=tmp_path / "publish" / "small-pillars"
    )


@pytest.fixture
def verified(monkeypatch):
    """A check in place of the thorough one: what it finds can be changed."""
    checks = [Check("files", True, "14 files hold")]

    def verify(folder, **options):
        return types.SimpleNamespace(ok=all(check.ok for check in checks), checks=checks)

    monkeypatch.setattr("scenegen.verification.verify", verify)
    return checks


@pytest.fixture
def undrawn(monkeypatch):
    """No picture is drawn for a published folder: that of test_stage.py has them."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("scenegen.publish.stage.SHOWN", 1)
    monkeypatch.setattr("scenegen.view.stills.draw", lambda looks: None)
    monkeypatch.setattr("scenegen.view.stills.to_bytes", lambda figure, ending: b"\x89PNG")


@pytest.fixture
def hub(undrawn, tmp_path, monkeypatch):
    """The stand-in, with the client's addresses, cache and token turned to it."""
    from huggingface_hub import constants

    server = Hub()
    address = server.url + "/{repo_id}/resolve/{revision}/{filename}"
    for name, value in {
        "ENDPOINT": server.url,
        "HF_HUB_DISABLE_XET": True,
        "HUGGINGFACE_CO_URL_TEMPLATE": address,
        "HF_HUB_CACHE": str(tmp_path / "cache"),
        "HF_TOKEN_PATH": str(tmp_path / "no-token"),
    }.items():
        monkeypatch.setattr(constants, name, value)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    yield server
    server.close()


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder to stand in, in which nothing is left."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    yield
    assert list((tmp_path / "elsewhere").iterdir()) == []


@pytest.fixture
def trap(standing, monkeypatch):
    """The folder to stand in holds a module `trap`, which nobody imports."""
    (standing / "trap.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(standing))
    yield standing
    assert "trap" not in sys.modules
