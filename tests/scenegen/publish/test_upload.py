"""Sending, against a stand-in for the Hub's HTTP API: all arrives, interruptions are made good, the
tag is last."""

import re
from dataclasses import replace

import pytest

from scenegen import load
from scenegen.publish.upload import publish, read_sums
from tests.conftest import contents, dataset_in, small_recipe
from tests.refusals import refuses
from tests.scenegen.conftest import Check
from tests.scenegen.hub import TOKEN, Repository

pytestmark = pytest.mark.usefixtures("verified")


def arrived(hub, asked, revision="main"):
    """Whether what lies in the repository is what was staged."""
    there = dict(hub.repositories[asked.repository].files(revision))
    there.pop(".gitattributes")
    return there == contents(asked.out)


def test_what_arrives_is_the_folder_the_tag_comes_last_and_nothing_goes_twice(asked, hub):
    staged, commit = publish(asked)
    assert arrived(hub, asked, staged.tag)
    assert hub.tags == {staged.tag: commit}
    *_, last = (line for line in hub.log if line.startswith(("POST", "PUT")))
    assert "/tag/" in last
    assert hub.tokens == {TOKEN}
    hub.log.clear()
    assert publish(asked)[1] == commit
    assert not [line for line in hub.log if re.search("PUT|/commit/|/tag/", line)]


def test_an_interrupted_upload_of_folders_goes_on_where_it_was(asked, hub, monkeypatch):
    """Here, ten shards take the place of a thousand."""
    monkeypatch.setattr("scenegen.dataset.schema.INDEX_DIGITS", 1)
    monkeypatch.setattr("scenegen.publish.upload.IN_COMMIT", 9)
    monkeypatch.setattr("scenegen.dataset.locate.MANY", 9)
    deep = asked.out.with_name("deep")
    counts = {"train": 12, "val": 0, "test": 1}
    dataset_in(deep, small_recipe(flight={"viewpoints": 1}), counts=counts, shard_samples=1)
    asked = replace(asked, dataset=deep)
    hub.refuse_after = 15
    refuses("interrupted", publish, asked)
    assert hub.tags == {}
    hub.refuse_after = None
    staged, commit = publish(asked)
    assert len(hub.puts) == len(set(hub.puts))  # nothing went twice
    assert hub.tags == {staged.tag: commit}
    assert arrived(hub, asked)
    assert load(f"hf://{asked.repository}")[10].world == 10
    assert sum("/commit/" in line for line in hub.log) == 4


def test_no_tag_where_a_file_is_lost_or_others_publish_meanwhile(asked, hub, monkeypatch):
    def read(folder):
        hub.repositories[asked.repository].commit({"train-00099.h5": b"theirs"})
        return read_sums(folder)

    hub.lose = "train-00001.h5"
    refuses("lost", publish, asked)
    monkeypatch.setattr("scenegen.publish.upload.read_sums", read)
    refuses("meanwhile", publish, asked)
    assert hub.tags == {}


def test_a_tag_of_other_content_is_let_be(asked, hub):
    publish(replace(asked, tag="v1"))
    tags = dict(hub.tags)
    refuses("v1", publish, replace(asked, tag="v1", licence="CC0-1.0"))
    assert hub.tags == tags


def test_shards_of_a_former_dataset_go_and_other_peoples_files_stay(asked, hub):
    hub.repositories[asked.repository] = former = Repository()
    mine = {"notes.md", "pictures/mine.png"}
    old = {"train-00099.h5", "rays.npy", "figures-0123456789abcdef.npy"}
    former.commit(dict.fromkeys(mine | old, b"mine"))
    publish(asked)
    files_now = former.files("main").items()
    assert {name for name, content in files_now if content == b"mine"} == mine


def test_private_stays_private(asked, hub):
    publish(asked, private=True)
    assert hub.repositories[asked.repository].private
    hub.repositories[asked.repository].private = False
    refuses("public", publish, asked, private=True)


def test_a_refused_token_is_one_line_that_does_not_show_it(asked, hub, monkeypatch, caplog):
    monkeypatch.setenv("HF_TOKEN", "hf_wrongButStillASecret")
    assert "hf_wrong" not in refuses("wrong", publish, asked) + caplog.text


def test_a_dataset_that_fails_its_check_goes_nowhere(asked, hub, verified):
    verified.append(Check("truth", False, "sample 3 of train differs"))
    refuses("truth", publish, asked)
    assert hub.log == []
    assert not asked.out.exists()
