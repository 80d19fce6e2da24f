"""Datasets from strangers: whatever stands in a manifest, a shard or an archive ends in one line,
and soon."""

import itertools
import json
import math
import resource
import shutil
import time
import tracemalloc
import zipfile
from random import Random

import h5py
import numpy as np
import pytest

import scenegen
from scenegen.dataset import manifest
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME
from scenegen.display.inspect import inspect
from scenegen.errors import DatasetError
from scenegen.sample import GROUPS
from scenegen.verification import verify
from tests.command_line import rows
from tests.conftest import dataset_in
from tests.mutations.case import REFUSED
from tests.mutations.damage_hdf5 import external, link, other_shape, other_type, virtual
from tests.mutations.hdf5_chunks import (
    chunk_missing,
    chunk_of_our_own,
    shuffled_bomb,
    unknown_filter,
)
from tests.scenegen.verification.conftest import failed
from tests.scenegen.verification.forge import edit_at
from tests.scenegen.verification.forge import edit_manifest as edit

BAD = 'null 3 -1 1e308 1000000000000 "x" "../x" [] [[1]] {} {"a":1} true'
BAD = [*BAD.split(), ""]
"""JSON to put in place of what stands in a manifest, or that nothing stands there."""


def refused(action):
    with pytest.raises(DatasetError) as error:
        action()
    assert len(str(error.value)) < 600
    return str(error.value)


def whole(sample):
    """All its fields, each of which is read when asked for."""
    return tuple(getattr(sample, name) for name in GROUPS[""])


def test_no_value_in_a_manifest_ends_in_a_traceback(dataset):
    good, count = manifest.read(dataset), 0
    paths = [*good, *(f"shards.0.{key}" for key in good["shards"][0])]
    for name in ("grid", "lidar", "recipe", "counts", "rejected"):
        paths += [f"{name}.{key}" for key in good[name]]
    for path, value in itertools.product(paths, BAD):
        (dataset / NAME).write_text(json.dumps(good))
        edit_at(dataset, path, value)
        try:
            split = scenegen.load(dataset)
            assert math.prod(split.describe()["tudf"]["shape"]) < 1 << 27
            assert split.names is not None
            assert len([whole(sample) for sample in split[:1]]) <= 1
        except DatasetError:
            count += 1
    assert count == 550  # which of them are refused


NEWER = """
version      → 1.99        → 1.99
version      → "1.10"      → 1.10
version      → 2           → 2
fields.0     → "intensity" → intensity
grid.colour  → 1           → colour
lidar.colour → 1           → lidar: unknown parameter 'colour': expected rows, columns,
counts       → 7           → counts = 7
"""


@pytest.mark.parametrize(("path", "value", "said"), rows(NEWER))
def test_what_a_newer_scenegen_wrote_is_not_called_damaged(dataset, path, value, said):
    edit_at(dataset, path, value)
    if path == "counts":  # which means something there, for all that is known here
        edit_at(dataset, "software.scenegen", '"99.1.0"')
    line = refused(lambda: Dataset(dataset))
    assert ("newer scenegen" in line, "damaged" in line) == (True, False)
    assert said in line
    assert not verified(dataset)


def verified(dataset):
    try:
        return verify(dataset, quick=True).ok
    except DatasetError:
        return False


def test_a_version_that_nobody_wrote_is_not_called_newer(dataset):
    for version in (1.1, "1.4", 1.6, "1", "1.x", None, -1, [1, 4], "1.5.6", "9" * 9999):
        edit(dataset, version=version)
        line = refused(lambda: Dataset(dataset))
        assert ("newer" in line, "version" in line) == (False, True)


def test_what_is_no_manifest_is_refused(dataset):
    for content in (b"", b"[]", b"[" * 10**6, b"\xff\xfe", b'{"shards": 1}'):
        (dataset / NAME).write_bytes(content)
        assert NAME in refused(lambda: Dataset(dataset))
    (dataset / NAME).unlink()
    (dataset / NAME).symlink_to(dataset / NAME)
    refused(lambda: Dataset(dataset))
    refused(lambda: inspect(dataset))


DAMAGES = {
    virtual: [0],
    external: [0],
    link: [0, 5],
    other_type: [1, 9, 17],
    other_shape: [1, 19],
    unknown_filter: [0],
    chunk_missing: [0],
    chunk_of_our_own: [5, 13, 25, 31],
    shuffled_bomb: [0],
}
"""Of the campaign in tests/mutations, with seeds by which they come out otherwise."""


@pytest.mark.parametrize(
    ("damage", "seed"), [(damage, seed) for damage, seeds in DAMAGES.items() for seed in seeds]
)
def test_no_shard_ends_in_a_traceback_or_takes_the_memory(dataset, damage, seed):
    with h5py.File(dataset / "train-00000.h5", "r+") as file:
        assert damage(file, "occupancy", Random(seed))[1] == REFUSED
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "train-00000.h5" in refused(lambda: whole(scenegen.load(dataset)[0]))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + (100 << 10)  # KB
    assert np.isfinite(scenegen.load(dataset)[3].tudf).all()  # the next shard
    assert "train-00000.h5" in failed(dataset, quick=True)["layout"]


def test_an_archive_writes_nowhere_else_and_takes_no_memory(dataset, monkeypatch):
    path = dataset / "train-00000.worlds.zip"
    whole = path.read_bytes()
    for name in ("../up.obj", ".hidden"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("000000.xml", f'<mujoco file="{name}"/>')
            archive.writestr(name, "up")
        assert "expected a plain file name" in refused(lambda: Dataset(dataset).world("train", 0))
    path.write_bytes(whole)
    monkeypatch.setattr("scenegen.dataset.archive.MOST_DOCUMENT_BYTES", 10)
    assert "expected 10 at most" in refused(lambda: Dataset(dataset).world("train", 0))


def test_an_archive_unpacks_to_what_its_directory_says_and_no_further(dataset, monkeypatch):
    path = dataset / "train-00000.worlds.zip"
    document = b'<mujoco><asset><mesh file="mesh.obj"/></asset></mujoco>'

    def put(**members):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("000000.xml", document)
            for name, content in members.items():
                archive.writestr(f"{name}.obj", content)

    def world():
        return Dataset(dataset).world("train", 0)

    put(mesh=b"v", unused=b"v", esh=b"v")
    assert world() == {"world.xml": document, "mesh.obj": b"v"}
    monkeypatch.setattr("scenegen.dataset.archive.MOST_ARCHIVE_BYTES", 50 << 20)
    put(a=bytes(20 << 20), b=bytes(20 << 20), c=bytes(20 << 20))
    assert "bytes unpacked, expected 52428800 at most" in refused(world)
    put(mesh=bytes(40 << 20))
    content = bytearray(path.read_bytes())
    for mark, size_at in ((b"PK\3\4", 22), (b"PK\1\2", 24)):
        place = content.index(mark, content.index(mark) + 4) + size_at
        content[place : place + 4] = (1000).to_bytes(4, "little")  # says 1000 bytes, holds 40 MB
    path.write_bytes(content)
    opened = Dataset(dataset)
    tracemalloc.start()
    assert "is damaged (Bad CRC-32" in refused(lambda: opened.world("train", 0))
    assert tracemalloc.get_traced_memory()[1] < 10 << 20
    tracemalloc.stop()
    content[-42:-38] = b"PK\6\7"  # another directory
    path.write_bytes(content)
    assert "not a whole zip file" in refused(world)


def test_a_shard_belongs_to_the_manifest_that_it_was_written_for(dataset):
    """What a compact dataset leaves out is derived by the manifest's sensor and grid."""
    good = manifest.read(dataset)
    for name, changed in (
        ("lidar", good["lidar"] | {"max_range_m": 9.0}),
        ("grid", good["grid"] | {"voxel": 0.25}),
        ("seed", 4),
    ):
        edit(dataset, **good | {name: changed})
        assert "was written with parameters" in refused(lambda: scenegen.load(dataset)[0])
    (dataset / "train-00000.h5").unlink()
    shutil.copy(dataset / "train-00001.h5", dataset / "train-00000.h5")
    edit(dataset, **good)
    assert "was written with" in refused(lambda: scenegen.load(dataset)[0])


def test_shards_are_as_many_as_the_counts_say_and_none_is_there_twice(dataset):
    shards = manifest.read(dataset)["shards"]
    edit(dataset, shards=shards[1:])
    assert "counts.train = 11, but its shards hold 8 samples" in refused(
        lambda: scenegen.load(dataset)
    )
    edit(dataset, shards=shards[:1] * 10_000, complete=False)
    begin = time.process_time()
    assert "'train-00000.h5' is listed 10000 times" in refused(lambda: inspect(dataset))
    assert time.process_time() - begin < 5
    edit(
        dataset,
        shards=[{**shards[0], "samples": 10**5}],
        counts={"train": 10**5, "val": 0, "test": 0},
    )
    assert "train-00000.h5" in refused(lambda: inspect(dataset))


def test_no_manifest_prints_lines_of_its_own_or_nests_without_end(dataset):
    line = "\nverify: all 17 checks passed\x1b[2J"
    good = manifest.read(dataset)
    for changed in (
        {"rejected": {"worlds": {line: "x"}, "viewpoints": {}}},
        {"fields": [line]},
        {"version": line},
        {"lidar": {line: 1}},
        {"kind": line},
    ):
        edit(dataset, **{**good, **changed})
        assert "\x1b" not in refused(lambda: Dataset(dataset))
    deep = 1
    for _ in range(300):
        deep = {"a": deep}
    edit(dataset, **{**good, "recipe": {**good["recipe"], "world": deep}})
    assert "nests deeper than 200" in refused(lambda: Dataset(dataset))


BROKEN = """
position   → nan → pose: position =
quaternion → 2   → pose: quaternion has length
origin     → inf → origin
"""


@pytest.mark.parametrize(("field", "value", "said"), rows(BROKEN))
def test_a_compact_dataset_derives_nothing_from_a_broken_pose(tmp_path, field, value, said):
    dataset_in(tmp_path / "d", seed=3, compact=True)
    with h5py.File(tmp_path / "d" / "train-00000.h5", "r+") as file:
        file[field][1] = float(value)
    samples = scenegen.load(tmp_path / "d")
    assert samples[0].free.any()
    assert f"train-00000.h5: sample 1: {said}" in refused(lambda: whole(samples[1]))
