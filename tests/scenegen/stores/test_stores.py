"""Laws of datasets at stores: the same bytes as in a folder, whoever else writes and wherever it
ends."""

import dataclasses
import errno
import io
import json
import os
import shutil
from http.server import BaseHTTPRequestHandler
from itertools import repeat
from pathlib import Path

import numpy as np
import pytest

from benchmarks.served import Served
from lidarsim import BeamTable
from scenegen import load, stores
from scenegen.dataset.build import build
from scenegen.dataset.locate import locate
from scenegen.dataset.placed import SUFFIX
from scenegen.errors import DatasetError, StoreError
from scenegen.stores import ConflictError, StorePath, folder_of
from scenegen.verification import verify
from tests.command_line import done, rows, run
from tests.conftest import COUNTS, DRAWN, contents, plan_of, small_recipe
from tests.scenegen.conftest import names
from tests.scenegen.stores.conftest import forget
from tests.scenegen.stores.kept import ROOM, Kept

NAME, HOME = "s3://lab/pillar", "lab/pillar"
pytestmark = pytest.mark.usefixtures("drawn_once")


def plan(folder, seed=3, **counts):
    return plan_of(folder, seed=seed, counts=COUNTS | counts, shard_samples=3)


@pytest.fixture
def there(store, made):
    """The dataset's folder in the store."""
    shutil.copytree(made, store / HOME)
    forget()
    return store / HOME


def write(**options):
    forget()
    return build(plan(folder_of(NAME)), **options)


def objects(store):
    """What the bucket holds of the dataset, less what is there for resuming alone."""
    home = store / HOME
    return {
        path.name: path.read_bytes() for path in home.glob("*") if not path.name.endswith(SUFFIX)
    }


def asked():
    """What this process asked of the dataset's store."""
    return stores.store_of(NAME).log  # type: ignore[attr-defined]


IMPOSSIBLE = "s3:///x s3://b//x s3://b/../x s3://B/x s3:/bucket/x s3://AKIA:secret@bucket/x"


@pytest.mark.parametrize("name", [*IMPOSSIBLE.split(), "s3://b/x\n", "s3://" + "b" * 2000])
def test_a_name_that_cannot_be_is_refused(name):
    told = "(?i:s3://bucket/folder)|expected two slashes, s3://bucket/x|holds no credentials"
    with pytest.raises(DatasetError, match=told) as refused:
        folder_of(name)
    assert "secret" not in str(refused.value)


def test_a_place_is_named_as_it_was_given_and_names_what_lies_in_it():
    folder = StorePath("s3://lab/a/b")
    path = folder / "x.h5"
    assert (str(folder), str(path), path.name) == ("s3://lab/a/b", "s3://lab/a/b/x.h5", "x.h5")
    assert type(path.with_suffix(".report.json").parent) is StorePath
    with pytest.raises(AttributeError):
        folder.open()  # nothing of Path's reaches for a file of that name


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


def test_a_bucket_holds_the_bytes_of_a_folder(store, made):
    DRAWN.clear()  # which workers would inherit
    write(workers=2)
    assert objects(store) == contents(made)


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

        def noted(report, new, fresh=fresh):
            fresh += [report.file] * new

        try:
            whole = write(on_shard=noted).complete
        except StoreError:
            ended += 1
        assert not before & set(fresh)
        drawn += fresh
    assert ended > 7
    assert len(drawn) < 7
    assert objects(store) == contents(made)


def test_a_resumed_run_reads_no_samples(store, made):
    write()
    write()
    assert [asked().count(what) for what in ("list", "read dataset.json")] == [1, 1]
    assert len(asked()) == 2 + 7  # and a report of each shard
    (store / HOME / "train-00001.h5").unlink()
    assert write().samples_written == 3
    read = [what for what in asked() if what.startswith("read") and not what.endswith(".json")]
    # it is there, and is held against what would be put
    assert read == ["read train-00001.worlds.zip"]
    (store / HOME / f"train-00002{SUFFIX}").unlink()
    assert write().samples_written == 0
    assert [what for what in asked() if what.endswith(".h5")] == ["read train-00002.h5"]
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


def test_a_disk_without_room_for_a_copy_is_no_damage(store, made, monkeypatch):
    """Nothing is removed because this machine could not look at it."""
    write()
    (store / HOME / f"train-00002{SUFFIX}").unlink()
    plain = Kept.read

    def full(self, name, file, most_bytes):
        if name.endswith(".h5"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return plain(self, name, file, most_bytes)

    monkeypatch.setattr(Kept, "read", full)
    with pytest.raises(
        StoreError, match=r"train-00002.h5: cannot be .*\(No space left on device\)"
    ):
        write()
    assert objects(store) == contents(made)


def test_two_drivers_at_once_end_with_equal_bits(store, made):
    other = []

    def begin_another(report, fresh):
        if not other:
            other.append(build(plan(folder_of(NAME)), workers=1))

    forget()
    first = build(plan(folder_of(NAME)), on_shard=begin_another)
    assert first.digest == other[0].digest
    assert objects(store) == contents(made)


def test_two_drivers_of_different_datasets_never_mix(there, store, made):
    """The later one is refused where the first has begun; where both find nothing, one wins the
    manifest."""
    mine = plan(folder_of(NAME))
    with pytest.raises(DatasetError, match="holds another dataset: seed is 3 there, 4 asked for"):
        build(plan(folder_of(NAME), seed=4))
    shutil.rmtree(there)
    forget()
    home = stores.store_of(NAME)
    begin = home.put
    theirs = (made / "dataset.json").read_bytes().replace(b'"seed": 3', b'"seed": 4')

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
    assert objects(store) == contents(made)


def test_a_table_of_rays_lies_there_too(store, tmp_path):
    raster = small_recipe()
    recipe = dataclasses.replace(raster, lidar=BeamTable.of(raster.lidar))
    for folder in (tmp_path / "d", folder_of(NAME)):
        for _ in range(2):
            build(plan_of(folder, recipe, seed=3, counts=COUNTS, shard_samples=6))
    assert "rays.npy" in objects(store)
    assert objects(store) == contents(tmp_path / "d")
    assert np.array_equal(load(NAME).dataset.lidar.rays, recipe.lidar.rays)


def test_force_replaces_another_dataset(store, made):
    build(plan(folder_of(NAME), seed=4, train=20))
    write(force=True)
    assert objects(store) == contents(made)


def test_reading_copies_what_is_opened_once_and_verifies_it(there, made):
    split, here = load(NAME, split="train"), load(made, split="train")
    folder = split.dataset.folder
    assert names(folder) == {"dataset.json"}
    assert split[4].sha256() == here[4].sha256()
    assert names(folder) == {"dataset.json", "train-00001.h5"}
    assert split.dataset.world("train", 1) == here.dataset.world("train", 1)
    assert locate(NAME) == folder
    shutil.rmtree(there)
    again = load(str(folder), split="train")[3]
    assert again.sha256() == here[3].sha256()  # nothing is asked for twice
    with pytest.raises(DatasetError, match=r"train-00000.h5: is missing"):
        split[0]


def test_a_strangers_folder_has_no_say_in_what_is_asked_of_a_place(there, tmp_path):
    folder = locate(NAME)
    shutil.copytree(folder, tmp_path / "theirs")
    shutil.copy(f"{folder}.place", tmp_path / "theirs.place")
    with pytest.raises(DatasetError, match=r"theirs/train-00000.h5: is missing"):
        load(tmp_path / "theirs")[0]


def test_other_bytes_than_the_manifests_are_refused_and_not_kept(there):
    path = there / "test-00000.h5"
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    split = load(NAME, split="test")
    told = f"{NAME}/test-00000.h5: is not the file that the manifest lists"
    with pytest.raises(StoreError, match=told):
        split[0]
    assert names(split.dataset.folder) == {"dataset.json"}
    with pytest.raises(StoreError, match=told):
        locate(NAME, whole=True)


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
        with pytest.raises(StoreError, match=r"others may write to|another user") as refused:
            ask()
        assert str(wrong) in str(refused.value)
    assert names(folder) == {"dataset.json"}


def test_a_copy_that_changed_is_fetched_again(there, made):
    folder, whole = locate(NAME, whole=True), contents(made)
    for number, (name, content) in enumerate(whole.items()):
        (folder / name).write_bytes(content[:-9] if number % 2 else content[:-1] + b"?")
    Path(f"{folder}.place").write_bytes(b"{")
    forget()
    assert load(NAME)[4].sha256() == load(made)[4].sha256()
    fetched = {what.partition(" ")[2] for what in asked() if what.startswith("read")}
    assert fetched == {"dataset.json", "train-00001.h5"}
    locate(NAME, whole=True)
    assert contents(folder) == whole
    count = len(asked())
    assert load(folder, split="test")[0].sha256() == load(made, split="test")[0].sha256()
    assert len(asked()) == count  # what is whole is not asked for


TAKEN = f"""
rescan {NAME} --noise range:0.02 -o s3://lab/again
take {NAME} --split train -o s3://lab/train
take {NAME} --split test -o s3://lab/test
merge s3://lab/train s3://lab/test -o s3://lab/both
"""
NOT_TAKEN = f"""
take {NAME} --n 1 -o {NAME} --force  → itself
rescan {NAME} -o {NAME} --force      → itself
convert {NAME} --to webdataset -o s3://lab/x → s3://… is not written to
world {NAME} 0 -o s3://lab/w.xml     → s3://… is not written to
generate pillar --out gs://lab/x     → gs://… is not written to
inspect s3://lab/none                → s3://lab/none: not a dataset, it has no dataset.json
"""


def test_commands_take_a_place_and_refuse_it_where_they_cannot(
    there, store, made, standing, capsys
):
    said = json.loads(done(capsys, f"inspect {NAME} --json"))
    assert said["bytes"] == sum(path.stat().st_size for path in made.iterdir())
    for words in TAKEN.strip().splitlines():
        done(capsys, f"{words} --quiet")
    for name in ("again", "both"):
        assert verify(locate(f"s3://lab/{name}", whole=True), quick=True).ok
    for words, told in rows(NOT_TAKEN):
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
    with pytest.raises(StoreError, match="is for reading alone"):
        build(plan(folder_of("memory://new")))
    with pytest.raises(DatasetError, match=r"fsspec has nothing here that reads it \(ValueError\)"):
        locate("nothing://there")


PAGE = b"<html>log in</html>"
ODD = {
    "cut": (200, b"half", {"ETag": "e", "Content-Length": "8"}),
    "no ETag": (200, b"whole", {"Content-Length": "5"}),
    "no length": (200, b"half", {"ETag": "e"}),
    "page": (200, PAGE, {"Content-Length": str(len(PAGE)), "Content-Type": "text/html"}),
    "circle": (307, b"", {"Content-Length": "0"}),
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
        self.wfile.write(content)

    do_GET = do_PUT = do_HEAD = _give  # noqa: N815

    def log_message(self, *said):
        """Nothing."""


@pytest.fixture
def bucket(tmp_path, monkeypatch):
    """One of a server at `AWS_ENDPOINT_URL`, which answers oddly, and is not waited for."""
    pytest.importorskip("boto3")
    from scenegen.stores import bucket as module

    monkeypatch.setattr(module.time, "sleep", lambda seconds: None)
    with Served(tmp_path) as server:
        server.RequestHandlerClass = Odd
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        yield module.Bucket("s3://lab/x")


def test_an_odd_servers_answer_ends_in_one_line(bucket, monkeypatch):
    def read(most=100):
        bucket.read("y", io.BytesIO(), most)

    every = read, lambda: list(bucket.list()), lambda: bucket.put("y", b"", None)
    for name, answer in ODD.items():
        monkeypatch.setattr(Odd, "answers", repeat(answer))
        for ask in every if name in ("page", "circle") else every[:1]:
            with pytest.raises(
                StoreError, match=r"s3://lab/x.*: the store does not answer"
            ) as told:
                ask()
            assert str(told.value).isprintable()
    monkeypatch.setattr(Odd, "answers", repeat(ODD["cut"]))
    with pytest.raises(DatasetError, match="8 bytes, expected 3 at most"):
        read(3)


REFUSALS = """
403 → QuotaExceeded       → the store is full (403 QuotaExceeded)
507 → InsufficientStorage → the store is full
400 → ExpiredToken        → the store refuses the credentials (400 ExpiredToken)
403 → AccessDenied        → the store refuses the credentials (403 AccessDenied)
404 → NoSuchBucket        → there is no such bucket (404 NoSuchBucket)
500 → InternalError       → the store does not answer (500 InternalError)
412 → PreconditionFailed  → somebody else has put it
"""


def test_a_refusal_is_told_in_one_line_without_what_the_server_repeats(bucket):
    from botocore.stub import Stubber

    said = "you sent\nAKIATOLD secret"
    for status, code, told in rows(REFUSALS):
        with Stubber(bucket._client) as stub:
            stub.add_client_error("put_object", code, said, http_status_code=int(status))
            with pytest.raises(StoreError) as refused:
                bucket.put("train-00000.h5", b"", None)
        line = str(refused.value)
        assert line.startswith(f"s3://lab/x/train-00000.h5: {told}")
        assert line.isprintable()
        assert not {"AKIATOLD", "secret"} & set(line.split())


def test_an_answer_that_is_cut_off_is_asked_for_again(bucket, monkeypatch):
    whole = 200, b"all of it", {"ETag": "e", "Content-Length": "9"}
    monkeypatch.setattr(Odd, "answers", iter([ODD["cut"], ODD["cut"], whole]))
    file = io.BytesIO()
    assert bucket.read("y", file, 9) == ("y", 9, "e")
    assert file.getvalue() == b"all of it"
