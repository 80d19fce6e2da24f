"""Laws of mirrors: a file is fetched once, by whichever process opens it first, and only as the
manifest lists it; no more is kept than there is room for."""

import hashlib
import multiprocessing
import os
import pickle
import shutil
from pathlib import Path

import pytest

from scenegen import load
from scenegen.base.mirrors import ROOM, fetch, fetch_all, make_mirror, mirror_of, note_files
from scenegen.base.stores import Store
from scenegen.dataset.locate import locate
from scenegen.verification import verify
from tests.conftest import contents
from tests.refusals import refuses
from tests.scenegen.conftest import names
from tests.scenegen.stores.conftest import forget

NAME = "s3://lab/pillar"
SIZE = 300_001


@pytest.fixture
def mirrored(server):
    """A mirror of objects a.h5, b.h5, c.h5, d.h5, none of them fetched yet, and their content."""
    content = {f"{name}.h5": name.encode() * SIZE for name in "abcd"}
    for name, written in content.items():
        Store(NAME).put(name, written)
    folder = make_mirror(Store(NAME), "dataset.json", b"{}")
    sums = {name: hashlib.sha256(content[name]).hexdigest() for name in content}
    note_files(folder, Store(NAME), sums)
    server.log.clear()
    return folder, content


def test_a_shard_is_fetched_when_it_is_first_opened(server, there, made):
    split, local = load(NAME, split="train"), load(made, split="train")
    folder = split.dataset.folder
    assert names(folder) == {"dataset.json"}
    assert split[4].sha256() == local[4].sha256()
    assert names(folder) == {"dataset.json", "train-00001.h5"}
    assert split.dataset.world("train", 1) == local.dataset.world("train", 1)
    assert locate(NAME) == folder
    assert [line for line, _ in server.log].count("GET train-00001.h5") == 1
    shutil.rmtree(there)
    again = load(str(folder), split="train")[3]
    assert again.sha256() == local[3].sha256()  # nothing is asked for twice
    refuses("gone", split.__getitem__, 0)


def test_everything_is_fetched_at_once_where_all_is_needed(there, made):
    assert contents(locate(NAME, whole=True)) == contents(made)
    assert verify(NAME, quick=True).ok
    split = pickle.loads(pickle.dumps(load(NAME, split="val")))
    assert split[0].sha256() == load(made, split="val")[0].sha256()


def read_all(path):
    fetch(path)
    return path.read_bytes()


def test_processes_at_once_fetch_a_file_once_though_the_server_fails(server, mirrored):
    folder, content = mirrored
    server.fail_every = 3
    with multiprocessing.get_context("fork").Pool(3) as pool:
        found = pool.map(read_all, 3 * [folder / "a.h5"], chunksize=1)
        pool.close()
        pool.join()
    assert set(found) == {content["a.h5"]}
    whole = [size for line, size in server.log if line.startswith("GET") and size == SIZE]
    assert len(whole) <= 2  # an answer that was cut off counts, too
    assert names(folder) == {"dataset.json", "a.h5"}


def test_what_was_used_longest_ago_makes_room(mirrored, monkeypatch):
    folder, content = mirrored
    monkeypatch.setenv(ROOM, str(2.5 * SIZE / 1e9))
    for turn, name in enumerate(["a.h5", "b.h5", "a.h5", "c.h5", "d.h5", "a.h5"]):
        fetch(folder / name)
        assert (folder / name).read_bytes() == content[name]
        os.utime(folder / name, ns=(turn, turn))
    assert names(folder) == {"dataset.json", "d.h5", "a.h5"}
    refuses("all", fetch_all, folder, content)
    monkeypatch.setenv(ROOM, "much")
    (folder / "b.h5").unlink(missing_ok=True)
    refuses("much", fetch, folder / "b.h5")


def test_other_bytes_than_the_manifests_are_refused_and_not_kept(there):
    path = there / "test-00000.h5"
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    split = load(NAME, split="test")
    refuses("a sample", split.__getitem__, 0)
    assert names(split.dataset.folder) == {"dataset.json"}
    refuses("all", locate, NAME, whole=True)


def test_a_file_that_is_missing_at_the_store_is_named(mirrored):
    folder, _ = mirrored
    Store(NAME).remove("a.h5")
    refuses("a.h5", fetch, folder / "a.h5")
    assert names(folder) == {"dataset.json"}


def test_a_strangers_folder_has_no_say_in_what_is_asked_of_a_store(server, there, tmp_path):
    folder = locate(NAME)
    shutil.copytree(folder, tmp_path / "theirs")
    shutil.copy(f"{folder}.place", tmp_path / "theirs.place")
    count = len(server.log)
    refuses("theirs", load(tmp_path / "theirs").__getitem__, 0)
    fetch(folder / "not-listed.h5")
    assert mirror_of(tmp_path / "theirs") is None
    assert len(server.log) == count


def test_a_damaged_note_is_written_again(there):
    folder = locate(NAME)
    Path(f"{folder}.place").write_bytes(b"{")
    forget()
    assert mirror_of(folder) is None
    assert load(NAME)[0].world == 0


@pytest.mark.parametrize("level", ["", "scenegen", "scenegen/places/{store}", "of another user"])
def test_copies_are_neither_taken_from_nor_put_where_others_may_write(
    level, there, tmp_path, monkeypatch
):
    folder, wrong = locate(NAME), tmp_path / "copies"
    if level == "of another user":
        monkeypatch.setattr("lidarsim.jit.os.geteuid", lambda: 54321)
        monkeypatch.setattr("lidarsim.jit.ROOT", 54322)
    else:
        wrong /= level.format(store=folder.parent.name)
        wrong.chmod(0o777)
    forget()
    # by the store's name, and in another process
    for ask in (lambda: locate(NAME), lambda: load(folder)[0]):
        assert str(wrong) in refuses(level, ask)
    assert names(folder) == {"dataset.json"}
