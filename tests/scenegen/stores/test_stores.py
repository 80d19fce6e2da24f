"""Laws of datasets at stores: the same bytes as in a folder, whoever else writes and wherever it
ends."""

import dataclasses
import errno
import io
import json
import os
import shutil
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from lidarsim import BeamTable
from scenegen import load, stores
from scenegen.dataset import manifest
from scenegen.dataset.build import build
from scenegen.dataset.locate import locate
from scenegen.dataset.placed import SUFFIX
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, StoreError
from scenegen.stores import ConflictError, StorePath, folder_of, is_remote
from scenegen.verification import verify
from tests.command_line import run
from tests.conftest import COUNTS, plan_of, small_recipe
from tests.scenegen.stores.conftest import forget
from tests.scenegen.stores.kept import ROOM, Kept

NAME = "s3://lab/pillar"


def plan(folder, seed=3, **counts):
    recipe = small_recipe()
    return plan_of(folder, recipe, seed=seed, counts=COUNTS | counts, shard_samples=3)


def write(**options):
    forget()
    return build(plan(folder_of(NAME)), **options)


def objects(store):
    """What the bucket holds of the dataset, less what is there for resuming alone."""
    home = store / "lab" / "pillar"
    return {
        path.name: path.read_bytes() for path in home.glob("*") if not path.name.endswith(SUFFIX)
    }


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def asked():
    """What this process asked of the dataset's store."""
    return stores.store_of(NAME).log  # type: ignore[attr-defined]


@pytest.mark.parametrize("path", ["./s3:/b", "./s3://b", "S3://b/x", "data", "", "a b://c", "s3:"])
def test_a_path_stays_a_path(path):
    assert not is_remote(path)
    assert not is_remote(Path("s3://bucket/x"))
    assert folder_of(path) == Path(path)


@pytest.mark.parametrize(
    "name", ["s3:///x", "s3://b//x", "s3://b/../x", "s3://b/x\n", "s3://B/x", "s3://" + "b" * 2000]
)
def test_a_name_that_cannot_be_is_refused(name):
    with pytest.raises(DatasetError, match=r"expected .*(?i:s3://bucket/folder)"):
        folder_of(name)


def test_one_slash_is_no_folder():
    with pytest.raises(DatasetError, match="s3:/bucket/x: expected two slashes, s3://bucket/x"):
        folder_of("s3:/bucket/x")


def test_credentials_in_a_name_are_refused_and_not_repeated():
    with pytest.raises(DatasetError, match="holds no credentials") as refused:
        folder_of("s3://AKIA:secret@bucket/x")
    assert "secret" not in str(refused.value)


def test_a_place_is_named_as_it_was_given_and_names_what_lies_in_it():
    folder = StorePath("s3://lab/a/b")
    assert (str(folder), str(folder / "x.h5"), (folder / "x.h5").name) == (
        "s3://lab/a/b",
        "s3://lab/a/b/x.h5",
        "x.h5",
    )
    assert type((folder / "x.h5").with_suffix(".report.json").parent) is StorePath
    with pytest.raises(AttributeError):
        folder.open()  # nothing of Path's reaches for a file of that name


def test_a_place_without_a_manifest_is_told_in_one_line(store):
    with pytest.raises(DatasetError, match="not a dataset"):
        manifest.read(folder_of(NAME))


def test_what_others_put_is_never_replaced_unread(store):
    path = folder_of(NAME) / "x"
    path.put(b"1")
    path.put(b"2")
    path.parent.store.put("x", b"theirs")  # type: ignore[attr-defined]
    with pytest.raises(ConflictError, match=f"{NAME}/x: somebody else has put other bytes there"):
        path.put(b"3")
    path.parent.store.put("x", b"3")  # type: ignore[attr-defined]
    path.put(b"3")  # the same bytes are no conflict
    path.put(b"4")
    assert path.read_bytes() == b"4"


@pytest.mark.parametrize("workers", [1, 2])
def test_a_bucket_holds_the_bytes_of_a_folder(workers, store, made):
    assert write(workers=workers).digest == Dataset(made).manifest.digest
    assert objects(store) == files(made)


def test_a_store_that_is_full_after_any_put_loses_nothing(store, made, tmp_path, monkeypatch):
    """Whichever put is the last one, the next call goes on from there, and draws no shard again
    that was put."""
    room = tmp_path / "room"
    monkeypatch.setenv(ROOM, str(room))
    drawn, ended, whole = [], 0, False
    while not whole:
        room.write_text("2")
        before = {name for name in objects(store) if name.endswith(".h5")}
        fresh = []
        try:
            whole = write(
                on_shard=lambda report, new, to=fresh: to.append(report.file) if new else None
            ).complete
        except StoreError:
            ended += 1
        assert not before & set(fresh)
        drawn += fresh
    assert ended > 7
    assert len(drawn) < 7
    assert objects(store) == files(made)


def test_a_resumed_run_reads_no_samples(store, made):
    write()
    write()
    assert [asked().count(what) for what in ("list", "read dataset.json")] == [1, 1]
    assert len(asked()) == 2 + 7  # and a report of each shard
    (store / "lab" / "pillar" / "train-00001.h5").unlink()
    written = write().samples_written
    assert written == 3
    read = [what for what in asked() if what.startswith("read") and not what.endswith(".json")]
    assert read == [
        "read train-00001.worlds.zip"
    ]  # which is there, and is held against what would be put
    (store / "lab" / "pillar" / f"train-00002{SUFFIX}").unlink()
    assert write().samples_written == 0
    assert [what for what in asked() if what.endswith(".h5")] == ["read train-00002.h5"]
    assert objects(store) == files(made)


@pytest.mark.parametrize("damage", [b"", b"not a shard", None])
def test_what_is_damaged_is_made_again(damage, store, made):
    write()
    home = store / "lab" / "pillar"
    for name in (
        "train-00001.h5",
        "test-00000.worlds.zip",
        "val-00000.h5",
        f"train-00000{SUFFIX}",
        "dataset.json",
    ):
        there = (home / name).read_bytes()
        if damage is None or name == "dataset.json":
            (home / name).unlink()
        else:
            (home / name).write_bytes(damage or there[:-1])
    write()
    assert objects(store) == files(made)


def test_a_disk_without_room_for_a_copy_is_no_damage(store, made, monkeypatch):
    """Nothing is removed because this machine could not look at it."""
    write()
    (store / "lab" / "pillar" / f"train-00002{SUFFIX}").unlink()
    plain = Kept.read

    def full(self, name, file, most_bytes):
        if name.endswith(".h5"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return plain(self, name, file, most_bytes)

    monkeypatch.setattr(Kept, "read", full)
    with pytest.raises(
        StoreError, match=r"train-00002.h5: cannot be copied to .*\(No space left on device\)"
    ):
        write()
    assert objects(store) == files(made)


def test_two_drivers_at_once_end_with_equal_bits(store, made):
    other = []

    def begin_another(report, fresh):
        if not other:
            other.append(build(plan(folder_of(NAME)), workers=1))

    forget()
    first = build(plan(folder_of(NAME)), on_shard=begin_another)
    assert first.digest == other[0].digest == Dataset(made).manifest.digest
    assert objects(store) == files(made)


def test_two_drivers_of_different_datasets_never_mix(store, made):
    """The later one is refused where the first has begun; where both find nothing, one wins the
    manifest."""
    forget()
    mine = plan(folder_of(NAME))
    shutil.copytree(made, store / "lab" / "pillar")
    with pytest.raises(DatasetError, match="holds another dataset: seed is 3 there, 4 asked for"):
        build(plan(folder_of(NAME), seed=4))
    shutil.rmtree(store / "lab" / "pillar")
    forget()
    home = stores.store_of(NAME)
    begin, theirs = (
        home.put,
        (made / "dataset.json").read_bytes().replace(b'"seed": 3', b'"seed": 4'),
    )

    def another_was_faster(name, content, version):
        if name == "dataset.json" and version is None:
            begin(name, theirs)
        return begin(name, content, version)

    home.put = another_was_faster  # type: ignore[method-assign]
    with pytest.raises(StoreError, match="another run has begun another dataset there"):
        build(mine)
    assert objects(store) == {"dataset.json": theirs}


def test_it_grows_and_is_made_in_parts(store, made):
    """A smaller dataset goes on, and jobs with a part of the shards complete it, whichever comes
    last."""
    build(plan(folder_of(NAME), train=5))
    for part in ((2, 5), (5, 7), (0, 2)):
        write(shard_range=part)
    assert objects(store) == files(made)


def test_a_table_of_rays_lies_there_too(store, tmp_path):
    raster = small_recipe()
    recipe = dataclasses.replace(raster, lidar=BeamTable.of(raster.lidar))
    for folder in (tmp_path / "d", folder_of(NAME)):
        for _ in range(2):
            build(plan_of(folder, recipe, seed=3, counts=COUNTS, shard_samples=6))
    assert "rays.npy" in objects(store)
    assert objects(store) == files(tmp_path / "d")
    assert np.array_equal(load(NAME).dataset.lidar.rays, recipe.lidar.rays)


def test_force_replaces_another_dataset(store, made):
    build(plan(folder_of(NAME), seed=4, train=20))
    write(force=True)
    assert objects(store) == files(made)


def test_reading_copies_what_is_opened_once_and_verifies_it(store, made):
    shutil.copytree(made, store / "lab" / "pillar")
    forget()
    split, here = load(NAME, split="train"), load(made, split="train")
    folder = split.dataset.folder
    assert {path.name for path in folder.iterdir()} == {"dataset.json"}
    assert split[4].sha256() == here[4].sha256()
    assert {path.name for path in folder.iterdir()} == {"dataset.json", "train-00001.h5"}
    assert split.dataset.world("train", 1) == here.dataset.world("train", 1)
    assert locate(NAME) == folder
    shutil.rmtree(store)
    store.mkdir()
    assert (
        load(str(folder), split="train")[3].sha256() == here[3].sha256()
    )  # nothing is asked for twice
    with pytest.raises(DatasetError, match=r"train-00000.h5: is missing"):
        split[0]


def test_a_strangers_folder_has_no_say_in_what_is_asked_of_a_place(store, made, tmp_path):
    shutil.copytree(made, store / "lab" / "pillar")
    forget()
    folder = locate(NAME)
    shutil.copytree(folder, tmp_path / "theirs")
    shutil.copy(f"{folder}.place", tmp_path / "theirs.place")
    with pytest.raises(DatasetError, match=r"theirs/train-00000.h5: is missing"):
        load(tmp_path / "theirs")[0]


def test_other_bytes_than_the_manifests_are_refused_and_not_kept(store, made):
    shutil.copytree(made, store / "lab" / "pillar")
    path = store / "lab" / "pillar" / "test-00000.h5"
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    forget()
    split = load(NAME, split="test")
    with pytest.raises(
        StoreError, match=f"{NAME}/test-00000.h5: is not the file that the manifest lists"
    ):
        split[0]
    assert {path.name for path in split.dataset.folder.iterdir()} == {"dataset.json"}
    with pytest.raises(StoreError, match=r"test-00000.h5"):
        locate(NAME, whole=True)


@pytest.mark.parametrize("level", ["", "scenegen", "scenegen/places", "scenegen/places/{store}"])
@pytest.mark.parametrize("what", ["open to others", "another user's"])
def test_copies_are_neither_taken_from_nor_put_where_others_may_write(
    level, what, store, made, tmp_path, monkeypatch
):
    shutil.copytree(made, store / "lab" / "pillar")
    forget()
    folder = locate(NAME)
    at = tmp_path / "copies" / level.format(store=folder.parent.name)
    if what == "open to others":
        at.chmod(0o777)
    else:
        monkeypatch.setattr("lidarsim.jit.os.geteuid", lambda: 54321)
        monkeypatch.setattr("lidarsim.jit.ROOT", 54322)
    forget()
    for ask in (
        lambda: locate(NAME),
        lambda: load(folder)[0],
    ):  # by the store's name, and in another process
        with pytest.raises(
            StoreError, match=r"others may write to|belongs to another user"
        ) as refused:
            ask()
        assert str(at if what == "open to others" else tmp_path / "copies") in str(refused.value)
    assert {path.name for path in folder.iterdir()} == {"dataset.json"}


@pytest.mark.parametrize(
    "damage", [lambda there: there[:-9], lambda there: there[:-1] + b"?", lambda there: b""]
)
def test_a_copy_that_changed_is_fetched_again(damage, store, made):
    shutil.copytree(made, store / "lab" / "pillar")
    forget()
    folder, whole = locate(NAME, whole=True), files(made)
    for name, content in whole.items():
        (folder / name).write_bytes(damage(content))
    Path(f"{folder}.place").write_bytes(b"{")
    forget()
    split = load(NAME, split="train")
    assert split[4].sha256() == load(made, split="train")[4].sha256()
    fetched = {what.partition(" ")[2] for what in asked() if what.startswith("read")}
    assert fetched == {"dataset.json", "train-00001.h5"}
    locate(NAME, whole=True)
    assert files(folder) == whole
    count = len(asked())
    assert load(folder, split="test")[0].sha256() == load(made, split="test")[0].sha256()
    assert len(asked()) == count  # what is whole is not asked for


def test_forked_processes_read_for_themselves(store, made):
    import multiprocessing

    shutil.copytree(made, store / "lab" / "pillar")
    forget()
    split = load(NAME, split="train")
    split[0]
    with multiprocessing.get_context("fork").Pool(2) as pool:
        found = pool.map(_digest, [(split, n) for n in range(len(split))])
        pool.close()
        pool.join()  # leaving ends processes by force, and was seen to wait for one for ever
    assert found == [sample.sha256() for sample in load(made, split="train")]


def _digest(task):
    split, number = task
    return split[number].sha256()


def test_commands_take_a_place_and_refuse_it_where_they_cannot(
    store, made, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(made, store / "lab" / "pillar")
    forget()
    code, said, _ = run(capsys, f"inspect {NAME} --json")
    assert code == 0
    assert json.loads(said)["bytes"] == sum(path.stat().st_size for path in made.iterdir())
    for words in (
        ("rescan", NAME, "--noise", "range:0.02", "-o", "s3://lab/again"),
        ("take", NAME, "--split", "train", "-o", "s3://lab/train"),
        ("take", NAME, "--split", "test", "-o", "s3://lab/test"),
        ("merge", "s3://lab/train", "s3://lab/test", "-o", "s3://lab/both"),
    ):
        code, _, wrong = run(capsys, *words, "--quiet")
        assert (code, wrong) == (0, "")
        assert verify(locate(words[-1], whole=True), quick=True).ok
    for words in (("take", NAME, "--n", 1), ("rescan", NAME)):
        code, _, wrong = run(capsys, *words, "-o", NAME, "--force")
        assert (code, "itself" in wrong, objects(store)) == (1, True, files(made))
    for words in (
        ("convert", NAME, "--to", "webdataset", "-o", "s3://lab/x"),
        ("world", NAME, 0, "-o", "s3://lab/w.xml"),
    ):
        code, _, wrong = run(capsys, *words)
        assert code == 2
        assert "s3://… is not written to" in wrong
    code, _, wrong = run(capsys, "generate pillar --out gs://lab/x")
    assert code == 2
    assert "gs://… is not written to" in wrong
    code, _, wrong = run(capsys, "inspect", "s3://lab/none")
    assert code == 1
    assert "s3://lab/none: not a dataset, it has no dataset.json" in wrong
    assert {path.name for path in tmp_path.iterdir()} <= {"store", "copies"}


def test_other_places_are_read_by_fsspec(made, tmp_path, monkeypatch):
    fsspec = pytest.importorskip("fsspec")
    monkeypatch.setenv("SCENEGEN_CACHE", str(tmp_path))
    fsspec.filesystem("memory").put(f"{made}/*", "/pillar/")
    assert load("memory://pillar", split="test")[2].sha256() == load(made, split="test")[2].sha256()
    with pytest.raises(StoreError, match="is for reading alone"):
        build(plan(folder_of("memory://new")))
    with pytest.raises(
        DatasetError, match=r"nothing://there: fsspec has nothing here that reads it \(ValueError\)"
    ):
        locate("nothing://there")


@pytest.mark.checkout
def test_without_boto3_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "boto3", None)
    forget()
    with pytest.raises(
        DatasetError,
        match=r"s3://lab/x: needs boto3; in scenegen's checkout: pip install -e '.\[s3\]'",
    ):
        folder_of("s3://lab/x")


def test_an_answer_that_is_cut_off_is_asked_for_again(monkeypatch):
    botocore = pytest.importorskip("botocore")
    from scenegen.stores import bucket as module

    class Cut(io.BytesIO):
        left = 2

        def read(self, size=-1):
            if self.tell() and Cut.left:
                Cut.left -= 1
                raise botocore.exceptions.IncompleteReadError(actual_bytes=1, expected_bytes=2)
            return super().read(1)

    monkeypatch.setattr(module.time, "sleep", lambda seconds: None)
    bucket = module.Bucket("s3://lab/x")
    answer = {"ContentLength": 4, "ETag": "e"}
    monkeypatch.setattr(
        bucket._client, "get_object", lambda **asked: {**answer, "Body": Cut(b"abcd")}
    )
    file = io.BytesIO()
    assert bucket.read("y", file, 4) == ("y", 4, "e")
    assert file.getvalue() == b"abcd"
    Cut.left = 100
    with pytest.raises(StoreError, match="s3://lab/x/y: the store does not answer"):
        bucket.read("y", file, 4)
    with pytest.raises(DatasetError, match="4 bytes, expected 3 at most"):
        bucket.read("y", file, 3)


class Odd(BaseHTTPRequestHandler):
    """A server that gives every request the answer called `answer`."""

    answer = ""

    def _give(self):
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        port = self.server.server_address[1]  # type: ignore[attr-defined]
        here = f"http://127.0.0.1:{port}{self.path}"
        page = b"<html>log in</html>"
        status, content, headers = {
            "cut": (200, b"half", {"ETag": "e", "Content-Length": "8"}),
            "no ETag": (200, b"whole", {"Content-Length": "5"}),
            "no length": (200, b"half", {"ETag": "e"}),
            "page": (200, page, {"Content-Length": str(len(page)), "Content-Type": "text/html"}),
            "circle": (307, b"", {"Content-Length": "0", "Location": here}),
        }[self.answer]
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    do_GET = do_PUT = do_HEAD = _give  # noqa: N815

    def log_message(self, *said):
        """Nothing."""


@pytest.mark.parametrize("answer", ["cut", "no ETag", "no length", "page", "circle"])
def test_an_odd_servers_answer_ends_in_one_line(answer, monkeypatch):
    pytest.importorskip("boto3")
    from scenegen.stores import bucket as module

    monkeypatch.setattr(module.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(Odd, "answer", answer)
    with ThreadingHTTPServer(("127.0.0.1", 0), Odd) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "x")
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_address[1]}")
        bucket = module.Bucket("s3://lab/x")
        asked = {"read": lambda: bucket.read("y", io.BytesIO(), 100)}
        if answer in ("page", "circle"):
            asked |= {
                "list": lambda: list(bucket.list()),
                "put": lambda: bucket.put("y", b"", None),
            }
        for ask in asked.values():
            with pytest.raises(
                StoreError, match=r"s3://lab/x.*: the store does not answer"
            ) as refused:
                ask()
            assert str(refused.value).isprintable()
        server.shutdown()


@pytest.mark.parametrize(
    ("status", "code", "told"),
    [
        (403, "QuotaExceeded", "the store is full (403 QuotaExceeded)"),
        (507, "InsufficientStorage", "the store is full"),
        (400, "ExpiredToken", "the store refuses the credentials (400 ExpiredToken)"),
        (403, "AccessDenied", "the store refuses the credentials (403 AccessDenied)"),
        (404, "NoSuchBucket", "there is no such bucket (404 NoSuchBucket)"),
        (500, "InternalError", "the store does not answer (500 InternalError)"),
        (412, "PreconditionFailed", "somebody else has put it"),
    ],
)
def test_a_refusal_is_told_in_one_line_without_what_the_server_repeats(
    status, code, told, monkeypatch
):
    pytest.importorskip("boto3")
    from botocore.stub import Stubber

    from scenegen.stores.bucket import Bucket

    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "AKIATOLD")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    bucket = Bucket("s3://lab/x")
    with Stubber(bucket._client) as stub:
        stub.add_client_error(
            "put_object", code, "you sent\nAKIATOLD secret", http_status_code=status
        )
        with pytest.raises(StoreError) as refused:
            bucket.put("train-00000.h5", b"", None)
    assert f"s3://lab/x/train-00000.h5: {told}" in str(refused.value)
    assert "AKIATOLD" not in str(refused.value)
    assert str(refused.value).isprintable()
    assert os.environ["AWS_SECRET_ACCESS_KEY"] not in str(refused.value)
