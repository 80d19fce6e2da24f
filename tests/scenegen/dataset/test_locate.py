"""Where datasets are: paths stay paths, the Hub is asked by name alone, and what it sends is
checked."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from scenegen import load
from scenegen.dataset.locate import locate
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, ScenegenError
from scenegen.model.completion.completer import locate as locate_network
from scenegen.share.upload import publish
from tests.scenegen.hub import TOKEN, Repository

NAME = "hf://ada/small-pillars"


@pytest.mark.parametrize(
    "path", ["ada/pillar", "data/pillar", "hf/ada", "hf:/ada/pillar", "./hf:", "", "HF://a/b"]
)
def test_a_path_stays_a_path(path, monkeypatch):
    def connect(*args):
        raise AssertionError("a connection")

    monkeypatch.setattr(socket.socket, "connect", connect)
    assert locate(path) == Path(path)
    assert locate(Path(path)) == Path(path)


@pytest.mark.parametrize(
    "name",
    ["hf://", "hf://ada", "hf://a/b/c", "hf://a/b@", "hf://../b", "hf://a/b@../c", "hf://a/ b"],
)
def test_a_name_that_cannot_be_is_refused(name):
    with pytest.raises(DatasetError, match="expected hf://user/name"):
        locate(name)


def test_what_was_published_is_read_back_by_revision(
    asked,
    hub,
    verified,
    made,
    capfd,
):
    tag = publish(asked)[0].tag
    repository = hub.repositories[asked.repository]
    repository.commit({"README.md": b"emptied since"})
    split = load(f"{NAME}@{tag}", split="test")
    assert capfd.readouterr() == ("", "")  # a library does not print
    assert split.names == Dataset(made).split("test").names
    assert split[0].sha256() == Dataset(made).split("test")[0].sha256()
    folder = split.dataset.folder
    assert {path.name for path in folder.iterdir()} == {
        "dataset.json",
        *(name for shard in split.dataset.manifest.shards for name in (shard.file, shard.worlds)),
    }
    with pytest.raises(
        DatasetError, match=r"small-pillars: not a scenegen dataset, it has no dataset.json"
    ):
        locate(NAME)
    with pytest.raises(DatasetError, match="v9"):
        locate(f"{NAME}@v9")


def test_without_network_the_copy_serves(
    asked,
    hub,
    verified,
    monkeypatch,
):
    from huggingface_hub import constants

    tag = publish(asked)[0].tag
    first = locate(f"{NAME}@{tag}")
    hub.log.clear()
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert locate(f"{NAME}@{tag}") == first
    assert hub.log == []
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert locate(f"{NAME}@{tag}") == first


def test_damage_and_strangers_files_are_refused(
    asked,
    hub,
    verified,
    tmp_path,
):
    publish(asked)
    files = dict(hub.repositories[asked.repository].files("main") or {})
    found = json.loads(files["dataset.json"])

    def offered(**changed):
        hub.repositories["eve/x"] = repository = Repository()
        repository.commit(
            files | {name.replace("__", "."): content for name, content in changed.items()}
        )
        return "hf://eve/x"

    with pytest.raises(
        DatasetError, match=r"train-00001.h5 is not the file that dataset.json lists"
    ):
        locate(offered(**{"train-00001.h5": b"something else"}))
    for name in ("../../../up.h5", "/etc/passwd", "*", "train-00000.h5\n"):
        shards = [{**found["shards"][0], "file": name}]
        with pytest.raises(DatasetError, match=r"dataset.json is damaged: shards.0.file"):
            locate(offered(dataset__json=json.dumps({**found, "shards": shards}).encode()))
    for content in (
        b"[]",
        b"{}",
        b"not json",
        b'{"format": "scenegen-dataset", "version": 1, "shards": 3}',
    ):
        with pytest.raises(DatasetError, match=r"dataset.json"):
            locate(offered(dataset__json=content))
    assert not (tmp_path / "up.h5").exists()
    with pytest.raises(DatasetError, match="nobody/none"):
        locate("hf://nobody/none")


def test_a_manifest_of_gigabytes_is_not_even_downloaded(
    asked,
    hub,
    verified,
    monkeypatch,
):
    publish(asked)
    hub.log.clear()
    monkeypatch.setattr("scenegen.dataset.locate.MOST_MANIFEST_BYTES", 100)
    with pytest.raises(DatasetError, match="that is no manifest of ours"):
        locate(NAME)
    assert not [line for line in hub.log if "/resolve/" in line]


@pytest.mark.parametrize(
    "token", [TOKEN, "hf_" + "Ab1" * 11, "hf_jwt_eyJhbGciOi.eyJzdWIi.c2ln", "an-older-form"]
)
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
