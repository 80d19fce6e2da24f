"""Laws of datasets at stores: the same bytes as in a folder, whoever else writes and wherever it
ends."""

import asyncio
import dataclasses
import errno
import json
import os
import pickle
import shutil
from http.server import BaseHTTPRequestHandler
from itertools import repeat
from pathlib import Path

import numpy as np
import pytest

from benchmarks.served import Served, tag_of
from lidarsim import BeamTable
from scenegen import load
from scenegen.base import stores
from scenegen.base.errors import StoreError
from scenegen.base.stores import ConflictError, Store, location_of
from scenegen.dataset.build import build
from scenegen.dataset.locate import locate
from scenegen.dataset.placed import SUFFIX
from scenegen.verification import verify
from tests.command_line import done
from tests.conftest import COUNTS, DRAWN, contents, plan_of, small_recipe
from tests.refusals import refuses, refuses_command
from tests.scenegen import cases, each_case
from tests.scenegen.conftest import names
from tests.scenegen.stores.conftest import forget

NAME, HOME = "s3://lab/pillar", "lab/pillar"
pytestmark = pytest.mark.usefixtures("drawn_once")


def plan(folder, seed=3, **counts):
    return plan_of(folder, seed=seed, counts=COUNTS | counts, shard_samples=3)


def write(**options):
    return build(plan(Store(NAME)), **options)


def objects(store):
    """What the bucket holds of the dataset, less what is there for resuming alone."""
    home = store / HOME
    return {
        path.name: path.read_bytes() for path in home.glob("*") if not path.name.endswith(SUFFIX)
    }


def asked(server):
    """What was asked of the server, and nothing from now on."""
    log = [line for line, _ in server.log]
    server.log.clear()
    return log


IMPOSSIBLE = "s3:///x s3://b//x s3://b/../x s3://B/x s3:/bucket/x s3://AKIA:secret@bucket/x"


@pytest.mark.parametrize("name", [*IMPOSSIBLE.split(), "s3://b/x\n", "s3://" + "b" * 2000])
def test_a_name_that_cannot_be_is_refused(name):
    assert "secret" not in refuses(name[:40], location_of, name)


def test_a_store_travels_by_its_name():
    assert str(pickle.loads(pickle.dumps(Store("s3://lab/a/b/")))) == "s3://lab/a/b"
    assert location_of("a/b") == Path("a/b")


def test_what_others_put_is_never_replaced_unread(store):
    mine, theirs = Store(NAME), Store(NAME)
    mine.replace("x", b"1")
    mine.replace("x", b"2")
    theirs.put("x", b"theirs")
    for put in (mine.replace, mine.create):
        refuses(put.__name__, put, "x", b"3")
    mine.create("x", b"theirs")  # the same bytes are no conflict
    assert mine.read("x", 6) == b"theirs"
    mine.replace("x", b"4")
    assert theirs.read("x", 1) == b"4"


def test_versions_without_quotation_marks_are_known(store, monkeypatch):
    """Ceph of 2021 compares them so."""
    monkeypatch.setattr("benchmarks.served.tag_of", lambda content: tag_of(content).strip('"'))
    mine = Store(NAME)
    mine.put("x", b"1")
    mine._versions["x"] = tag_of(b"1")
    mine.replace("x", b"2")
    mine._versions["x"] = tag_of(b"other")
    with pytest.raises(ConflictError):
        mine.replace("x", b"3")


def test_what_others_replace_meanwhile_is_read_again(store, monkeypatch):
    mine = Store(NAME)
    mine.put("a", b"1")
    ask, conflicts = Store._ask, iter([True, True, False])

    def raced(self, *args):
        if next(conflicts):
            raise ConflictError("replaced")
        return ask(self, *args)

    monkeypatch.setattr(Store, "_ask", raced)
    assert mine.read("a", 9) == b"1"


def test_a_folder_is_no_object_of_itself(store, monkeypatch):
    """So s3fs lists one that another run begins to fill meanwhile."""
    folder = {NAME: {"type": "directory", "size": 0}, f"{NAME}/a": {"type": "file", "size": 1}}

    class Filling:
        def find(self, path, detail):
            return folder

    monkeypatch.setattr(Store, "_ask", lambda self, name, act: act(Filling(), NAME))
    assert Store(NAME).list() == {"a": 1}


def test_a_bucket_holds_the_bytes_of_a_folder(store, made):
    """Also in place of another dataset."""
    build(plan(Store(NAME), seed=4, train=20))
    DRAWN.clear()  # which workers would inherit
    write(workers=2, force=True)
    assert objects(store) == contents(made)


def test_a_store_that_is_full_after_any_put_loses_nothing(server, store, made):
    """Whichever put is the last one, the next call goes on from there, and draws no shard again
    that was put."""
    drawn, ends = [], 0

    def note(report, is_new):
        assert not (is_new and report.entry.file in before)
        drawn.extend([report.entry.file] * is_new)

    while ends < 99:
        server.room, before = 2, objects(store)
        try:
            write(on_shard=note)
            break
        except StoreError:
            ends += 1
    assert ends > 7
    assert len(drawn) < 7
    assert objects(store) == contents(made)


def test_a_resumed_run_reads_no_samples(server, store, made):
    write()
    asked(server)
    write()
    log = asked(server)
    assert [log.count(line) for line in ("LIST", "GET dataset.json")] == [1, 1]
    assert sum(line.startswith("GET") for line in log) == 1 + 7  # a report of each shard
    (store / HOME / "train-00001.h5").unlink()
    assert write().samples_written == 3
    read = {line for line in asked(server) if "GET" in line and not line.endswith(".json")}
    # they are there, and are held against what would be put
    assert read == {"GET train-00001.worlds.zip"}
    (store / HOME / f"train-00002{SUFFIX}").unlink()
    assert write().samples_written == 0
    assert [line for line in asked(server) if line.endswith(".h5")] == ["GET train-00002.h5"]


def test_what_is_damaged_or_lost_is_made_again(store, made):
    write()
    home = store / HOME
    for name in ("train-00001.h5", "test-00000.worlds.zip", f"train-00000{SUFFIX}"):
        os.truncate(home / name, (home / name).stat().st_size - 1)
    for name in ("val-00000.h5", "test-00001.worlds.zip", "dataset.json"):
        (home / name).unlink()
    (home / f"train-00002{SUFFIX}").write_text("[" * 10**5)
    write()
    assert objects(store) == contents(made)


@pytest.mark.parametrize("gone", [False, True])
def test_a_disk_that_cannot_hold_a_copy_is_no_damage(gone, store, made, monkeypatch):
    """Nothing is removed because this machine could not look at it."""
    write()
    (store / HOME / f"train-00002{SUFFIX}").unlink()
    system, fetch = stores._connect(NAME, os.getpid())[0], Store.fetch

    def full(path, copy):
        raise OSError(errno.ENOSPC, "No space left on device")

    def into_a_folder_that_is_gone(self, name, path):
        fetch(self, name, path.parent / "gone" / name)

    if gone:
        monkeypatch.setattr(Store, "fetch", into_a_folder_that_is_gone)
    else:
        monkeypatch.setattr(system, "get_file", full)
    refuses(f"gone {gone}", write)
    assert objects(store) == contents(made)


def test_a_late_rank_does_not_replace_a_finished_manifest(store, made):
    late = plan(Store(NAME))

    def finish(report, fresh):
        write()

    assert build(late, shard_range=(0, 1), on_shard=finish).samples_written == 3
    assert objects(store) == contents(made)


def test_two_drivers_of_different_datasets_never_mix(there, store, made, monkeypatch):
    """The later one is refused where the first has begun; where both find nothing, one wins the
    manifest."""
    refuses("later", lambda: build(plan(Store(NAME), seed=4)))
    shutil.rmtree(there)
    begin = Store.replace
    theirs = (made / "dataset.json").read_bytes().replace(b'"seed": 3', b'"seed": 4')

    def another_was_faster(self, name, content):
        if not objects(store):
            Store(NAME).put(name, theirs)
        begin(self, name, content)

    monkeypatch.setattr(Store, "replace", another_was_faster)
    refuses("at once", write)
    assert objects(store) == {"dataset.json": theirs}


def test_a_table_of_rays_lies_there_too(store, tmp_path):
    raster = small_recipe()
    recipe = dataclasses.replace(raster, lidar=BeamTable.of(raster.lidar))
    for folder in (tmp_path / "d", Store(NAME)):
        for _ in range(2):
            build(plan_of(folder, recipe, seed=3, counts=COUNTS, shard_samples=6))
    assert "rays.npy" in objects(store)
    assert objects(store) == contents(tmp_path / "d")
    assert np.array_equal(load(NAME).dataset.lidar.rays, recipe.lidar.rays)


def test_commands_take_a_place_and_refuse_it_where_they_cannot(
    there, store, made, standing, capsys
):
    facts = json.loads(done(capsys, f"inspect {NAME} --json"))
    assert facts["bytes"] == sum(map(len, contents(made).values()))
    done(capsys, f"generate --like {NAME} --noise range:0.02 --workers 1 -o s3://lab/again --quiet")
    assert verify("s3://lab/again", quick=True).ok
    for (words,) in cases("stores/stores_not_taken"):
        refuses_command(capsys, words)
    assert objects(store) == contents(made)
    assert names(standing) <= {"store", "copies"}


def test_other_places_are_read_by_fsspec(made, tmp_path, monkeypatch):
    fsspec = pytest.importorskip("fsspec")
    monkeypatch.setenv("SCENEGEN_CACHE", str(tmp_path))
    fsspec.filesystem("memory").put(f"{made}/*", "/pillar/")
    remote, local = (load(place, split="test")[2] for place in ("memory://pillar", made))
    assert remote.sha256() == local.sha256()
    refuses("to write", lambda: build(plan(Store("memory://new"))))
    refuses("unknown", locate, "nothing://remote")


def test_without_s3fs_one_line_says_what_to_install(monkeypatch):
    core = pytest.importorskip("fsspec.core")

    def absent(*given, **options):
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(core, "url_to_fs", absent)
    forget()
    refuses("absent", locate, NAME)


SECRETS = ("AKIATOLD", "secret")
ODD = {
    "cut": (200, b"half", {"ETag": "e", "Content-Length": "8"}),
    "rest": (206, b"more", {"ETag": "e"}),
    "page": (200, b"<html>log in</html>", {"Content-Type": "text/html"}),
    "circle": (307, b"", {}),
    "secret": (500, " ".join(SECRETS).encode(), {}),
}
"""What a server answers to every request: a status, content, and headers."""


class Odd(BaseHTTPRequestHandler):
    answers = repeat(ODD["cut"])

    def _give(self):
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        status, content, headers = next(self.answers)
        self.send_response(status)
        usual = {"Location": self.path, "Content-Length": str(len(content))}
        for name, value in (usual | headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(b"" if self.command == "HEAD" else content)

    do_GET = do_PUT = do_HEAD = _give  # noqa: N815

    def log_message(self, *said):
        """Nothing."""


@pytest.fixture
def bucket(tmp_path, monkeypatch):
    """One of a server at `AWS_ENDPOINT_URL`, which answers oddly, and is not waited for."""
    pytest.importorskip("s3fs")
    monkeypatch.setattr(stores, "ATTEMPTS", 1)
    sleep = asyncio.sleep
    monkeypatch.setattr(asyncio, "sleep", lambda seconds: sleep(0))  # before another attempt
    with Served(tmp_path) as server:
        server.RequestHandlerClass = Odd
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        forget()
        yield Store("s3://lab/x")


@each_case("stores/odd", "answer verb")
def test_an_odd_servers_answer_ends_in_one_line(answer, verb, bucket, monkeypatch, tmp_path):
    """It has nothing of what the server repeats."""
    status, _, code = answer.partition(" ")
    page = f"<Error><Code>{code}</Code><Message>you\n{SECRETS}</Message></Error>".encode()
    monkeypatch.setattr(Odd, "answers", repeat(ODD.get(answer) or (int(status), page, {})))
    words = {"read": ["y", 100], "fetch": ["y", tmp_path / "y"], "list": [], "put": ["y", b""]}
    line = refuses(f"{answer} {verb}", getattr(bucket, verb), *words[verb])
    assert not [word for word in SECRETS if word in line]


def test_an_answer_that_is_cut_off_is_asked_for_again(bucket, monkeypatch, tmp_path):
    monkeypatch.setattr(Odd, "answers", iter([ODD["cut"], ODD["rest"]]))
    bucket.fetch("y", tmp_path / "y")
    assert (tmp_path / "y").read_bytes() == b"halfmore"
