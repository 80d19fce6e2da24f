"""Laws of datasets at stores: the same bytes as in a folder, whoever else writes and wherever it
ends."""

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
from scenegen.base.errors import DatasetError, StoreError
from scenegen.base.stores import ConflictError, Store, place_of
from scenegen.dataset.build import build
from scenegen.dataset.locate import locate
from scenegen.dataset.placed import SUFFIX
from scenegen.verification import verify
from tests.command_line import done, run
from tests.conftest import COUNTS, DRAWN, contents, plan_of, small_recipe
from tests.scenegen import cases, refuses
from tests.scenegen.conftest import names
from tests.scenegen.stores.conftest import forget

NAME, HOME = "s3://lab/pillar", "lab/pillar"
pytestmark = pytest.mark.usefixtures("drawn_once")


def plan(folder, seed=3, **counts):
    return plan_of(folder, seed=seed, counts=COUNTS | counts, shard_samples=3)


@pytest.fixture
def there(store, made):
    """The dataset's folder in the store."""
    shutil.copytree(made, store / HOME)
    return store / HOME


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
    told = "(?i:s3://bucket/folder)|expected two slashes, s3://bucket/x|holds no credentials"
    with pytest.raises(DatasetError, match=told) as refused:
        place_of(name)
    assert "secret" not in str(refused.value)


def test_a_store_travels_by_its_name():
    assert str(pickle.loads(pickle.dumps(Store("s3://lab/a/b/")))) == "s3://lab/a/b"
    assert place_of("a/b") == Path("a/b")


def test_what_others_put_is_never_replaced_unread(store):
    mine, theirs = Store(NAME), Store(NAME)
    mine.replace("x", b"1")
    mine.replace("x", b"2")
    theirs.put("x", b"theirs")
    for put in (mine.replace, mine.create):
        refuses(f"{NAME}/x: somebody else has put other bytes", put, "x", b"3")
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


def test_a_bucket_holds_the_bytes_of_a_folder(store, made):
    DRAWN.clear()  # which workers would inherit
    write(workers=2)
    assert objects(store) == contents(made)


def test_a_store_that_is_full_after_any_put_loses_nothing(server, store, made):
    """Whichever put is the last one, the next call goes on from there, and draws no shard again
    that was put."""
    drawn, ended, whole = [], 0, False
    while not whole:
        server.room = 2
        before = {name for name in objects(store) if name.endswith(".h5")}
        fresh = []

        def noted(report, new, fresh=fresh):
            fresh += [report.entry.file] * new

        try:
            whole = write(on_shard=noted).complete
        except StoreError:
            ended += 1
        assert not before & set(fresh)
        drawn += fresh
    assert ended > 7
    assert len(drawn) < 7
    assert objects(store) == contents(made)


def test_a_resumed_run_reads_no_samples(server, store, made):
    write()
    asked(server)
    write()
    log = asked(server)
    assert [log.count(line) for line in ("LIST", "GET dataset.json")] == [1, 1]
    assert len([line for line in log if line.startswith("GET")]) == 1 + 7  # a report of each shard
    (store / HOME / "train-00001.h5").unlink()
    assert write().samples_written == 3
    read = [line for line in asked(server) if "GET" in line and not line.endswith(".json")]
    # they are there, and are held against what would be put
    assert set(read) == {"GET train-00001.worlds.zip"}
    (store / HOME / f"train-00002{SUFFIX}").unlink()
    assert write().samples_written == 0
    assert [line for line in asked(server) if line.endswith(".h5")] == ["GET train-00002.h5"]
    assert objects(store) == contents(made)


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

    if gone:
        monkeypatch.setattr(
            Store, "fetch", lambda self, name, path: fetch(self, name, path.parent / "gone" / name)
        )
    else:
        monkeypatch.setattr(system, "get_file", full)
    refuses(r"train-00002.h5: cannot be copied to this machine", write)
    assert objects(store) == contents(made)


def test_two_drivers_at_once_end_with_equal_bits(store, made):
    other = []

    def begin_another(report, fresh):
        if not other:
            other.append(build(plan(Store(NAME)), workers=1))

    first = build(plan(Store(NAME)), on_shard=begin_another)
    assert first.digest == other[0].digest
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
    refuses(
        "holds another dataset: seed is 3 there, 4 asked for",
        lambda: build(plan(Store(NAME), seed=4)),
    )
    shutil.rmtree(there)
    begin = Store.replace
    theirs = (made / "dataset.json").read_bytes().replace(b'"seed": 3', b'"seed": 4')

    def another_was_faster(self, name, content):
        if not objects(store):
            Store(NAME).put(name, theirs)
        begin(self, name, content)

    monkeypatch.setattr(Store, "replace", another_was_faster)
    refuses("another run has begun another dataset there", write)
    assert objects(store) == {"dataset.json": theirs}


def test_it_grows_and_is_made_in_parts(store, made):
    """A smaller dataset goes on, and jobs with a part of the shards complete it, whichever comes
    last."""
    build(plan(Store(NAME), train=5))
    for part in ((2, 5), (5, 7), (0, 2)):
        write(shard_range=part)
    assert objects(store) == contents(made)


def test_a_table_of_rays_lies_there_too(store, tmp_path):
    raster = small_recipe()
    recipe = dataclasses.replace(raster, lidar=BeamTable.of(raster.lidar))
    for folder in (tmp_path / "d", Store(NAME)):
        for _ in range(2):
            build(plan_of(folder, recipe, seed=3, counts=COUNTS, shard_samples=6))
    assert "rays.npy" in objects(store)
    assert objects(store) == contents(tmp_path / "d")
    assert np.array_equal(load(NAME).dataset.lidar.rays, recipe.lidar.rays)


def test_force_replaces_another_dataset(store, made):
    build(plan(Store(NAME), seed=4, train=20))
    write(force=True)
    assert objects(store) == contents(made)


def test_commands_take_a_place_and_refuse_it_where_they_cannot(
    there, store, made, standing, capsys
):
    said = json.loads(done(capsys, f"inspect {NAME} --json"))
    assert said["bytes"] == sum(path.stat().st_size for path in made.iterdir())
    done(capsys, f"generate --like {NAME} --noise range:0.02 -o s3://lab/again --quiet")
    assert verify(locate("s3://lab/again", whole=True), quick=True).ok
    for words, told in cases("stores/stores_not_taken"):
        code, _, wrong = run(capsys, words)
        assert code in (1, 2)
        assert told in wrong
    assert objects(store) == contents(made)
    assert names(standing) <= {"store", "copies"}


def test_other_places_are_read_by_fsspec(made, tmp_path, monkeypatch):
    fsspec = pytest.importorskip("fsspec")
    monkeypatch.setenv("SCENEGEN_CACHE", str(tmp_path))
    fsspec.filesystem("memory").put(f"{made}/*", "/pillar/")
    there, here = (load(place, split="test")[2] for place in ("memory://pillar", made))
    assert there.sha256() == here.sha256()
    refuses("is for reading alone", lambda: build(plan(Store("memory://new"))))
    refuses(r"fsspec has nothing here that reads it \(ValueError\)", locate, "nothing://there")


def test_without_s3fs_one_line_says_what_to_install(monkeypatch):
    core = pytest.importorskip("fsspec.core")

    def absent(*given, **options):
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(core, "url_to_fs", absent)
    forget()
    refuses(r"s3fs.*\[s3\]", locate, NAME)


PAGE = b"<html>log in</html>"
REST = 206, b"more", {"ETag": "e", "Content-Length": "4"}
ODD = {
    "cut": (200, b"half", {"ETag": "e", "Content-Length": "8"}),
    "page": (200, PAGE, {"Content-Length": str(len(PAGE)), "Content-Type": "text/html"}),
    "circle": (307, b"", {"Content-Length": "0"}),
    "AKIATOLD secret": (500, b"AKIATOLD secret", {"Content-Length": "15"}),
}
"""What a server answers to every request: a status, content, and headers."""


class Odd(BaseHTTPRequestHandler):
    answers = repeat(ODD["cut"])

    def _give(self):
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        status, content, headers = next(self.answers)
        self.send_response(status)
        for name, value in {"Location": self.path, **headers}.items():
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
    with Served(tmp_path) as server:
        server.RequestHandlerClass = Odd
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        forget()
        yield Store("s3://lab/x")


@pytest.mark.parametrize(
    ("answer", "verbs"),
    [
        ("cut", "read fetch"),
        ("page", "put"),
        ("circle", "read fetch list put"),
        ("AKIATOLD secret", "read fetch list put"),
    ],
)
def test_an_odd_servers_answer_ends_in_one_line(answer, verbs, bucket, monkeypatch, tmp_path):
    monkeypatch.setattr(Odd, "answers", repeat(ODD[answer]))
    ask = {
        "read": lambda: bucket.read("y", 100),
        "fetch": lambda: bucket.fetch("y", tmp_path / "y"),
        "list": bucket.list,
        "put": lambda: bucket.put("y", b""),
    }
    for verb in verbs.split():
        with pytest.raises(StoreError, match=r"s3://lab/x.*: the store does not answer") as told:
            ask[verb]()
        line = str(told.value)
        assert line.isprintable()
        assert not {"AKIATOLD", "secret"} & set(line.split())


@pytest.mark.parametrize(("status", "code", "told"), cases("stores/stores"))
def test_a_refusal_is_told_in_one_line_without_what_the_server_repeats(
    status, code, told, bucket, monkeypatch
):
    page = (
        f"<Error><Code>{code}</Code><Message>you sent\nAKIATOLD secret</Message></Error>".encode()
    )
    answer = int(status), page, {"Content-Length": str(len(page))}
    monkeypatch.setattr(Odd, "answers", repeat(answer))
    with pytest.raises(StoreError) as refused:
        bucket.put("train-00000.h5", b"")
    line = str(refused.value)
    assert line.startswith(f"s3://lab/x/train-00000.h5: {told}")
    assert line.isprintable()
    assert not {"AKIATOLD", "secret"} & set(line.split())


def test_an_answer_that_is_cut_off_is_asked_for_again(bucket, monkeypatch, tmp_path):
    monkeypatch.setattr(Odd, "answers", iter([ODD["cut"], REST]))
    bucket.fetch("y", tmp_path / "y")
    assert (tmp_path / "y").read_bytes() == b"halfmore"
