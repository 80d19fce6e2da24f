"""Where datasets are: paths stay paths, the Hub is asked by name alone, and what it sends is
checked."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from scenegen import load
from scenegen.base.errors import ScenegenError
from scenegen.dataset.locate import locate
from scenegen.dataset.read import Dataset
from scenegen.model.completion.completer import locate as locate_network
from tests.conftest import contents
from tests.scenegen import refuses
from tests.scenegen.conftest import names
from tests.scenegen.hub import TOKEN, Repository

NAME = "hf://ada/small-pillars"


@pytest.mark.parametrize(
    "path", ["ada/pillar", "hf:/ada/pillar", "./hf:", "", "HF://a/b", "./s3://b", "S3://b/x", "s3:"]
)
def test_a_path_stays_a_path(path, monkeypatch):
    monkeypatch.setattr(socket.socket, "connect", pytest.fail)
    assert locate(path) == Path(path)
    assert locate(Path(path)) == Path(path)
    assert locate(Path("s3://b/x")) == Path("s3:/b/x")


@pytest.mark.parametrize(
    "name",
    ["hf://", "hf://ada", "hf://a/b/c", "hf://a/b@", "hf://../b", "hf://a/b@../c"],
)
def test_a_name_that_cannot_be_is_refused(name):
    refuses("expected hf://user/name", locate, name)


@pytest.fixture
def published(hub, made):
    """A repository of the dataset, as it was tagged; emptied since."""
    hub.repositories["ada/small-pillars"] = found = Repository()
    found.tags["v1"] = found.commit(contents(made))
    found.commit({"README.md": b"emptied since"})
    return found


def test_what_was_published_is_read_back_by_revision(published, made, capfd):
    split = load(f"{NAME}@v1", split="test")
    assert capfd.readouterr() == ("", "")  # a library does not print
    assert split.names == Dataset(made).split("test").names
    assert split[0].sha256() == Dataset(made).split("test")[0].sha256()
    there = names(split.dataset.folder)
    assert there == names(made)
    for name, told in (
        (NAME, "not a scenegen dataset, it has no dataset.json"),
        (f"{NAME}@v9", "v9"),
    ):
        refuses(told, locate, name)


def test_without_network_the_copy_serves(published, hub, monkeypatch):
    from huggingface_hub import constants

    first = locate(f"{NAME}@v1")
    hub.log.clear()
    for name, value in (("HF_HUB_OFFLINE", True), ("ENDPOINT", "http://127.0.0.1:9")):
        with monkeypatch.context() as patch:
            patch.setattr(constants, name, value)
            assert locate(f"{NAME}@v1") == first
            assert hub.log == []


def test_damage_and_strangers_files_are_refused(published, hub, tmp_path):
    files = published.files("v1")
    found = json.loads(files["dataset.json"])

    def refused(name, content, told):
        hub.repositories["eve/x"] = repository = Repository()
        repository.commit(files | {name: content})
        refuses(told, locate, "hf://eve/x")

    refused("train-00001.h5", b"other", r"train-00001.h5 is not .* delete \S+/datasets--eve--x to")
    for name in ("../../../up.h5", "*", "train-00000.h5\n"):
        shards = json.dumps({**found, "shards": [{**found["shards"][0], "file": name}]})
        refused("dataset.json", shards.encode(), r"dataset.json is damaged: shards")
    for content in (b"[]", b"not json"):
        refused("dataset.json", content, r"^hf://eve/x: dataset.json ")
    assert not (tmp_path / "up.h5").exists()
    refuses("nobody/none", locate, "hf://nobody/none")


def test_a_manifest_of_gigabytes_is_not_even_downloaded(published, hub, monkeypatch):
    monkeypatch.setattr("scenegen.dataset.locate.MAX_MANIFEST_BYTES", 100)
    refuses("that is no manifest of ours", locate, f"{NAME}@v1")
    assert not [line for line in hub.log if "/resolve/" in line]


@pytest.mark.parametrize("token", [TOKEN, "hf_jwt_eyJhbGciOi.eyJzdWIi.c2ln", "an-older-form"])
def test_no_token_is_ever_told(token, hub, monkeypatch):
    """Not even where a server repeats it; nor does what it says reach a terminal raw."""
    import huggingface_hub

    def refuse(*args, **options):
        raise RuntimeError(f"Bearer {token}\rgot\x1b[2J {token}x")

    monkeypatch.setenv("HF_TOKEN", token)
    for name in ("snapshot_download", "hf_hub_download"):
        monkeypatch.setattr(huggingface_hub, name, refuse)
    monkeypatch.setattr(huggingface_hub.HfApi, "dataset_info", refuse)
    for look in (locate, locate_network):
        with pytest.raises(ScenegenError, match="Bearer …") as refused:
            look(NAME)
        assert token not in str(refused.value)
        assert str(refused.value).isprintable()


def test_the_hubs_client_tells_nobody_that_it_runs():
    code = (
        "import scenegen.dataset.locate, huggingface_hub.constants as c; "
        "assert c.HF_HUB_DISABLE_TELEMETRY"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
