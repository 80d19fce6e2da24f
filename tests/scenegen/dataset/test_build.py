"""Laws of a dataset: its content does not depend on how it was made, and a folder is never taken
for another."""

import errno
import itertools
import json
import os
import shutil
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from scenegen import SPLITS
from scenegen.dataset import build as module
from scenegen.dataset import manifest
from scenegen.dataset.build import build
from scenegen.dataset.layout import ShardFile
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME
from scenegen.dataset.shard import ShardSpec, compress, read_report
from tests.conftest import THREE, contents, picky_recipe, plan_of, small_recipe, stop_at_val
from tests.refusals import refuses
from tests.scenegen import cases, each_case
from tests.scenegen.conftest import same
from tests.scenegen.verification.forge import edit_manifest, read

pytestmark = pytest.mark.usefixtures("drawn_once")

COUNTS = {"train": 13, "val": 3, "test": 4}
MORE, FEW = {"train": 20, "val": 3, "test": 8}, {"seed": 5, "counts": THREE}
SEED = 3
"""One at which every shard rejects worlds, and all but one viewpoints, too."""


def plan(folder, *, recipe=None, **options):
    options = {"seed": SEED, "counts": COUNTS, "shard_samples": 6, **options}
    return plan_of(folder, recipe or picky_recipe(), **options)


def make(folder, *, workers=1, **options):
    return build(plan(folder, **options), workers=workers)


def assert_finished(folder, whole, drawn=None):
    """The same command finishes the dataset of `whole`, and draws as many samples."""
    assert make(folder).samples_written == drawn or drawn is None
    assert contents(folder) == contents(whole)


@pytest.fixture(scope="session")
def whole(once):
    """A folder that was made in one go; not to be changed."""
    return once("build-whole", make)


@pytest.fixture(scope="session")
def few(once):
    """Few samples of another seed."""
    return once("build-few", lambda folder: make(folder, **FEW))


@pytest.fixture
def folder(whole, tmp_path):
    """A copy of the first, to change."""
    return Path(shutil.copytree(whole, tmp_path / "d"))


def test_a_chunk_is_the_same_wherever_a_threads_stack_lies():
    """The shorter it is, the more stacks ISA-L alone gives other bytes on: here one in some
    sixty."""
    values = np.frombuffer(b"abcdefgh" + bytes(range(24)) + b"abcdefgh", np.uint8)
    before, together = threading.stack_size(1 << 18), threading.Barrier(400)
    with ThreadPoolExecutor(400) as pool:
        (packed,) = set(pool.map(lambda _: together.wait() + 1 and compress(values), range(400)))
    threading.stack_size(before)
    assert zlib.decompress(packed) == values.tobytes()


def test_shard_size_and_compactness_change_no_sample(tmp_path, whole, few):
    digest = read(whole)["digest"]
    assert make(tmp_path / "b", shard_samples=1).digest == digest
    assert make(tmp_path / "c", shard_samples=1000, compact=True).digest == digest
    assert read(few)["digest"] != digest
    assert "tudf" not in read(tmp_path / "c")["fields"]
    for split in SPLITS:
        both = (Dataset(folder).split(split) for folder in (whole, tmp_path / "c"))
        assert all(itertools.starmap(same, zip(*both, strict=True)))


def test_a_dataset_grows_into_the_one_that_was_made_at_once(folder, tmp_path):
    """Byte by byte; whole shards are not touched, and one that was not full is made again."""
    untouched = ("train-00000.h5", "train-00001.worlds.zip", "val-00000.h5")
    before = [(folder / name).stat().st_mtime_ns for name in untouched]
    assert make(folder, counts=MORE).samples_written == 20 + 8 - 12
    make(tmp_path / "larger", counts=MORE)
    assert contents(folder) == contents(tmp_path / "larger")
    assert [(folder / name).stat().st_mtime_ns for name in untouched] == before


def test_a_manifest_comes_again_from_the_shards(folder, whole):
    for damage in {"shards": [{"file": 1}]}, {"shards": None}, {"rejected": 0, "digest": "x"}:
        edit_manifest(folder, **damage)
        assert_finished(folder, whole, drawn=0)
    (folder / NAME).unlink()
    refuses("lost, and another seed", make, folder, seed=4)
    assert_finished(folder, whole, drawn=0)


def test_what_is_finished_is_written_down_on_the_way(tmp_path, monkeypatch):
    """A run that is killed has listed its shards, and the next one does not hash their samples
    again."""
    monkeypatch.setattr(module, "NOTE_S", 0.0)
    with pytest.raises(KeyboardInterrupt):
        build(plan(tmp_path / "d"), on_shard=stop_at_val)
    assert len(read(tmp_path / "d")["shards"]) == 3
    monkeypatch.setattr(ShardFile, "check", pytest.fail)
    (tmp_path / "d" / "val-00000.h5").unlink()
    assert make(tmp_path / "d").complete


def test_the_format_is_the_contract(whole):
    """What the numbers are, `verify` says, which shares no code with what writes them."""
    fields = [name for name, _, _ in cases("dataset/format")]
    expected = {"format": "scenegen-dataset", "version": 2, "fields": fields}
    assert read(whole).items() >= expected.items()
    with h5py.File(whole / "train-00000.h5") as shard:
        for name, dtype, size in cases("dataset/format"):
            stored, shape = shard[name], tuple(map(int, size.split()))
            assert stored.dtype == dtype
            assert stored.shape == (6, *shape)
            assert stored.chunks == (1, *shape)
            assert (stored.compression or "gzip") == "gzip"


def test_going_on_with_other_parameters_is_refused_by_name(folder, whole):
    recipe = small_recipe(flight={"robot_radius_m": 0.4})
    changes = {"seed": 5, "counts": {**COUNTS, "train": 12}, "compact": True, "recipe": recipe}
    for name, value in changes.items():
        refuses(name, make, folder, **{name: value})
    assert build(plan(folder), force=True, shard_range=(0, 1)).samples_written == 0
    assert contents(folder) == contents(whole)


MINE = "train-00003.h5 notes.txt rays.npy train-00099.worlds.zip test-00050.h5 dataset.part-a.json"


def test_force_replaces_a_dataset_and_none_of_a_users_files(folder, few):
    """Whatever they are called: another dataset's shard that a user put there is his, too. A file
    in the way of a new shard ends it before anything is touched."""
    mine = dict.fromkeys(MINE.split(), b"mine")
    mine["train-00098.h5"] = (few / "train-00000.h5").read_bytes()
    for name, content in mine.items():
        (folder / name).write_bytes(content)
    before = contents(folder)
    make(folder)
    longer = plan(folder, seed=5, counts=THREE | {"train": 24})
    refuses("a user's shard", build, longer, force=True)
    assert contents(folder) == before
    build(plan(folder, **FEW), force=True)
    assert contents(folder) == contents(few) | mine


@pytest.mark.parametrize(
    ("owner", "name", "nth"),
    [(ShardSpec, "prepare", 1), (manifest, "write", 1), (manifest, "write", 2)],
)
def test_jobs_that_finish_while_another_works_lose_nothing(
    owner, name, nth, tmp_path, monkeypatch, whole
):
    """Before it begins, just before it writes that it begins, and before it writes what it saw."""
    parts, original, calls = plan(tmp_path / "d"), getattr(owner, name), []

    def overtaken(*given):
        calls.append(given)
        if len(calls) == nth:
            assert build(parts, shard_range=(1, len(parts.shards))).samples_written
        return original(*given)

    monkeypatch.setattr(owner, name, overtaken)
    outcome = build(parts, shard_range=(0, 1))
    assert (outcome.complete, outcome.samples_written) == (True, parts.shards[0].samples)
    assert contents(tmp_path / "d") == contents(whole)


def test_damage_in_another_jobs_part_is_neither_signed_nor_waited_for(whole, tmp_path):
    parts = plan(tmp_path / "parts")
    last = len(parts.shards) - 1
    build(parts, shard_range=(0, 1))
    build(parts, shard_range=(last, last + 1))
    os.truncate(parts.folder / parts.shards[0].file, 500)
    with h5py.File(parts.folder / parts.shards[last].file, "r+") as file:
        file["position"][0, 0] += 1e-9
    between = build(parts, shard_range=(1, last))
    assert (between.complete, between.shards_missing) == (False, 2)
    assert_finished(tmp_path / "parts", whole)


def test_a_run_that_drew_nothing_stands_in_nobodys_way(tmp_path):
    hopeless = plan(tmp_path / "d", recipe=small_recipe(accept={"min_solids": 1e6, "max_draws": 1}))
    refuses("no dataset there", build, hopeless)
    assert not (tmp_path / "d").exists()
    make(tmp_path / "d")
    refuses("in place of a dataset", build, hopeless, force=True)
    assert make(tmp_path / "d").samples_written == 0


@each_case("dataset/build", "options")
def test_numbers_beyond_those_that_readers_take_are_refused_at_once(tmp_path, options):
    refuses(options, plan, tmp_path / "d", **json.loads(options))


def test_a_folder_that_is_no_dataset_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    refuses("force True", build, plan(tmp_path), force=True)
    assert contents(tmp_path) == {"thesis.tex": b"years of work"}
    refuses("a file", make, tmp_path / "thesis.tex")


@each_case("dataset/strange", "name value")
def test_a_shard_of_strange_notes_counts_as_absent(folder, name, value):
    shard = plan(folder).shards[0]
    assert read_report(folder, (shard, None))
    with h5py.File(folder / shard.file, "r+") as file:
        del file.attrs[name]
        file.attrs.update({name: json.loads(value)} if value else {})
    assert read_report(folder, (shard, None)) is None


@pytest.mark.parametrize(
    ("name", "axes", "mask"), [("world", 1, 0), ("ranges", 3, 1), ("tudf", 4, 0)]
)
def test_a_shard_with_a_cut_chunk_counts_as_absent(folder, name, axes, mask):
    shard = plan(folder).shards[0]
    with h5py.File(folder / shard.file, "r+") as file:
        file[name].id.write_direct_chunk((0,) * axes, b"few", mask)
    assert read_report(folder, (shard, None)) is None


def test_a_full_disk_ends_in_one_line_and_loses_nothing(tmp_path, monkeypatch, whole):
    synced, sync = [], os.fsync

    def refuse(handle):
        synced.append(handle)
        if len(synced) == 8:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", refuse)
        refuses("full", make, tmp_path / "d")
    assert not list((tmp_path / "d").glob(".*.tmp"))
    assert_finished(tmp_path / "d", whole)


def test_too_small_a_disk_is_noticed_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=10, total=20))
    refuses("10 bytes", make, tmp_path / "d")


def die_of_test_worlds(folder, spec):
    if spec.split == "test":
        os.kill(os.getpid(), 9)
    return spec.write(folder)


def test_a_killed_worker_is_reported_and_the_rest_is_kept(tmp_path, monkeypatch, whole):
    with monkeypatch.context() as patch:
        patch.setattr(module, "write_shard", die_of_test_worlds)
        refuses("killed", make, tmp_path / "d", workers=2)
    assert_finished(tmp_path / "d", whole)
