"""A dataset at a store, worked on by other machines: each opens the store for itself."""

import json
import shutil

import pytest

from scenegen.base.errors import StoreError
from scenegen.base.executors import EXECUTORS
from scenegen.base.stores import Store
from scenegen.dataset.locate import locate
from tests.refusals import refuses, refuses_command
from tests.scenegen.base import everywhere
from tests.scenegen.base.backwards import Bare

NAME = "s3://lab/d"


@pytest.fixture
def here(once, request, tmp_path, monkeypatch):
    """A folder to stand in, with a dataset there and in the store, and a network; they are made
    before the cache is another one."""
    everything = once("everywhere", everywhere.make)
    store = request.getfixturevalue("store")
    for name in ("d", "n.safetensors"):
        (tmp_path / name).symlink_to(everything / name)
    shutil.copytree(everything / "d", store / "lab" / "d")
    everywhere.stand(tmp_path, monkeypatch)
    monkeypatch.setitem(EXECUTORS.builtin, "bare", "tests.scenegen.base.backwards:Bare")
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [("verify", "d", "--json", "--quick"), *everywhere.COMMANDS[1:5]],
    ids=lambda words: words[0],
)
def test_a_command_gives_the_same_where_nothing_is_copied_yet(here, capsys, words):
    local = everywhere.outcome(capsys, here, words, "out", "--workers", 1)
    remote = [NAME if word == "d" else word for word in words]
    assert everywhere.outcome(capsys, here, remote, "out", "--on", "bare") == local


def test_a_store_that_does_not_answer_a_machine_is_no_fault_of_the_dataset(
    here, capsys, monkeypatch
):
    fetch = Store.fetch

    def fail(self, name, path):
        if name == "val-00000.h5":
            raise StoreError(f"{self}/{name}: the store does not answer")
        fetch(self, name, path)

    monkeypatch.setattr(Store, "fetch", fail)
    refuses_command(capsys, f"verify {NAME} --quick --json --on bare")


def test_a_dataset_that_changes_meanwhile_is_not_mixed_with_the_first(here, store):
    folder = locate(NAME)
    manifest = store / "lab" / "d" / "dataset.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text())))  # the same, written otherwise
    refuses("changed", lambda: list(Bare("", 1)(str, [folder], lambda: None)))
