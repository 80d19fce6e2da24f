"""Where datasets are: paths stay paths, the Hub is asked by name alone, and what it sends is
checked."""

import socket
from pathlib import Path

import pytest

from scenegen import load
from scenegen.dataset.locate import locate
from scenegen.model.completion.completer import locate as locate_network
from tests.command_line import python
from tests.conftest import contents
from tests.refusals import refuses
from tests.scenegen.hub import TOKEN, Repository

NAME = "hf://ada/small-pillars"


@pytest.mark.parametrize(
    "path", ["ada/pillar", "hf:/ada/pillar", "", "HF://a/b", "./s3://b", "s3:"]
)
def test_a_path_stays_a_path(path, monkeypatch):
    monkeypatch.setattr(socket.socket, "connect", pytest.fail)
    assert locate(path) == locate(Path(path)) == Path(path)
    assert locate(Path("s3://b/x")) == Path("s3:/b/x")


@pytest.mark.parametrize("name", ["", "ada", "a/b/c", "a/b@", "../b", "a/b@../c"])
def test_a_name_that_cannot_be_is_refused(name):
    refuses(name, locate, f"hf://{name}")


@pytest.fixture
def published(hub, made):
    """A repository of the dataset, as it was tagged; emptied since."""
    hub.repositories["ada/small-pillars"] = repository = Repository()
    repository.tags["v1"] = repository.commit(contents(made))
    repository.commit({"README.md": b"emptied since"})
    return repository


def test_what_was_published_is_read_back_by_revision(published, made, capfd):
    split = load(f"{NAME}@v1", split="test")
    assert capfd.readouterr() == ("", "")  # a library does not print
    assert contents(split.dataset.folder) == contents(made)
    for name in (NAME, f"{NAME}@v9"):
        refuses(name, locate, name)


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
    good, names = files["dataset.json"], ("../../../up.h5", "*", "train-00000.h5\\n")
    named = {name: good.replace(b"train-00000.h5", name.encode()) for name in names}
    cases = {
        case: {"dataset.json": it} for case, it in {"[]": b"[]", "no JSON": b"x", **named}.items()
    }
    for case, changes in (cases | {"other": {"train-00001.h5": b"other"}}).items():
        hub.repositories["eve/x"] = repository = Repository()
        repository.commit(files | changes)
        refuses(case, locate, "hf://eve/x")
    assert not (tmp_path / "up.h5").exists()
    refuses("nobody", locate, "hf://nobody/none")


def test_a_manifest_of_gigabytes_is_not_even_downloaded(published, hub, monkeypatch):
    monkeypatch.setattr("scenegen.dataset.locate.MAX_MANIFEST_BYTES", 100)
    refuses("100 bytes", locate, f"{NAME}@v1")
    assert not [line for line in hub.log if "/resolve/" in line]


@pytest.mark.parametrize("token", [TOKEN, "hf_jwt_eyJhbGciOi.eyJzdWIi.c2ln", "an-older-form"])
def test_no_token_is_ever_told(token, hub, monkeypatch):
    """Not even where a server repeats it; nor does what it says reach a terminal raw."""

    def refuse(*args, **options):
        raise RuntimeError(f"Bearer {token}\rgot\x1b[2J {token}x")

    monkeypatch.setenv("HF_TOKEN", token)
    for name in ("snapshot_download", "hf_hub_download", "HfApi.dataset_info"):
        monkeypatch.setattr(f"huggingface_hub.{name}", refuse)
    for look in (locate, locate_network):
        assert token not in refuses(look.__module__, look, NAME)


def test_the_hubs_client_tells_nobody_that_it_runs():
    constants = "huggingface_hub.constants"
    python(
        "-c", f"import scenegen.dataset.locate, {constants} as c; c.HF_HUB_DISABLE_TELEMETRY or 1/0"
    )
