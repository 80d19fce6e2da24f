"""Laws of copies with holes: what is read is what the object holds, whoever else reads and whatever
fails; nothing is fetched twice, and no more is kept than there is room for."""

import hashlib
import multiprocessing
import os
import shutil
from contextlib import closing, nullcontext

import numpy as np
import pytest

from benchmarks.served import Served
from scenegen import load
from scenegen.dataset import layout
from scenegen.errors import DatasetError, StoreError
from scenegen.stores import cache, copies, folder_of
from tests.scenegen.conftest import names
from tests.scenegen.stores.conftest import forget

PLACE = "s3://lab/d"
SIZE = 300_001


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A server that fails one request in seven, and blocks of which small objects have several."""
    pytest.importorskip("boto3")
    monkeypatch.setenv("SCENEGEN_CACHE", str(tmp_path / "copies"))
    monkeypatch.setattr(copies, "BLOCK_BYTES", 1000)
    monkeypatch.setattr(copies, "_left", 0)
    monkeypatch.setattr(layout, "TAIL_BYTES_A_SAMPLE", 0)
    monkeypatch.setattr(layout, "TAIL_BYTES", 5000)
    with Served(tmp_path / "store", fail_every=7) as found:
        for name, value in found.environment.items():
            monkeypatch.setenv(name, value)
        forget()
        yield found


def objects(server, *names):
    """The folder for copies of random objects, and what each holds."""
    rng = np.random.default_rng(0)
    held = {name: rng.bytes(SIZE) for name in names}
    for name, content in held.items():
        (folder_of(PLACE) / name).put(content)
    sums = {name: hashlib.sha256(content).hexdigest() for name, content in held.items()}
    folder = cache.keep(PLACE, "dataset.json", b"{}")
    cache.note(folder, PLACE, sums)
    server.log.clear()
    return folder, held


def opened(path):
    """A copy with holes, while the block lasts."""
    return closing(cache.open_copy(path, 5000))


def fetched(server):
    return sum(size for what, size in server.log if what.startswith("GET"))


def read_parts(task):
    """Read pieces of a copy all over, as long as it has holes, and say whether they are right."""
    path, content, seed = task
    rng = np.random.default_rng(seed)
    copy = cache.open_copy(path, 5000)
    with closing(copy) if copy else nullcontext():
        for begin, size in rng.integers(0, (SIZE, 3000), (200 if copy else 0, 2)).tolist():
            assert copy.pread(size, begin) == content[begin : begin + size]
    return True


def test_processes_that_read_all_over_fetch_every_byte_once(server):
    folder, held = objects(server, "a.h5")
    tasks = [(folder / "a.h5", held["a.h5"], seed) for seed in range(3)]
    with multiprocessing.get_context("fork").Pool(3) as pool:
        assert all(pool.map(read_parts, tasks))
        pool.close()
        pool.join()
    assert fetched(server) < 1.5 * SIZE  # those that the server cut off came again
    cache.fetch(folder / "a.h5")
    assert (folder / "a.h5").read_bytes() == held["a.h5"]
    assert not list(folder.glob("*.part"))
    before = len(server.log)
    cache.fetch(folder / "a.h5")
    assert len(server.log) == before


def test_a_little_of_an_object_takes_little_and_all_of_it_few_requests(server):
    folder, held = objects(server, "a.h5")
    server.fail_every = 0
    with opened(folder / "a.h5") as copy:
        assert copy.pread(100, 150_000) == held["a.h5"][150_000:150_100]
        assert fetched(server) < 8000
        for begin in range(0, SIZE, 500):
            copy.pread(500, begin)
    assert len(server.log) < 12
    assert (folder / "a.h5").read_bytes() == held["a.h5"]


def test_what_is_damaged_on_the_disk_is_fetched_again(server):
    folder, held = objects(server, "a.h5", "b.h5")
    (folder / "b.h5.part").write_bytes(b"of a process that was killed")
    for name, content in held.items():
        with opened(folder / name) as copy:
            copy.pread(100, 150_000)
        with (folder / f"{name}.part").open("r+b") as file:
            file.seek(150_050)
            file.write(b"?????")
        with opened(folder / name) as copy:
            assert copy.pread(100, 150_000) == content[150_000:150_100]


def test_an_object_that_is_replaced_meanwhile_is_noticed(server):
    folder, _ = objects(server, "a.h5")
    told = f"{PLACE}/a.h5: is not the file that the manifest"
    with opened(folder / "a.h5") as copy:
        copy.pread(100, 0)
        (folder_of(PLACE) / "a.h5").put(b"?" * SIZE)
        with pytest.raises(StoreError, match=told):
            copy.pread(100, 200_000)
    with opened(folder / "a.h5") as copy:
        for _ in range(2):  # also whoever asks again
            with pytest.raises(StoreError, match=told):
                copy.fileno()
    with pytest.raises(StoreError, match=told):
        cache.fetch(folder / "a.h5")
    assert names(folder) == {"dataset.json"}


def test_what_was_used_longest_ago_makes_room(server, monkeypatch):
    folder, held = objects(server, *"abcd")
    monkeypatch.setenv(copies.ROOM, str(2.5 * SIZE / 1e9))
    for name in "abcad":
        cache.fetch(folder / name)
        os.utime(folder / name, ns=(len(server.log) * 10**9, SIZE))
        assert (folder / name).read_bytes() == held[name]
    assert names(folder) == {"dataset.json", "a", "d"}
    monkeypatch.setenv(copies.ROOM, "much")
    monkeypatch.setattr(copies, "_left", 0)
    with pytest.raises(StoreError, match=f"{copies.ROOM}=much: expected gigabytes, such as 50"):
        cache.fetch(folder / "b")


def test_samples_come_by_parts_and_are_held_against_their_digests(server, made):
    home = server.home / "lab" / "d"
    shutil.copytree(made, home)
    here, content = load(made), bytearray((made / "train-00000.h5").read_bytes())
    there = load(PLACE)
    assert [sample.sha256() for sample in there] == [sample.sha256() for sample in here]
    content[here._shard(0).columns["origin"].places[1, 1]] ^= 1
    (home / "train-00000.h5").write_bytes(content)
    (there.dataset.folder / "train-00000.h5.part").unlink()
    there = load(PLACE)
    assert there[0].sha256() == here[0].sha256()
    with pytest.raises(DatasetError, match="sample 1: its content does not have the digest"):
        there[1]
