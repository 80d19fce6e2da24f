"""Datasets from strangers: whatever stands in a manifest, a shard or an archive ends in one line,
and soon."""

import dataclasses
import itertools
import json
import math
import resource
import shutil
import time
import tracemalloc
import zipfile
from collections import Counter
from random import Random

import h5py
import numpy as np
import pytest

import scenegen
from lidarsim import BeamTable, Lidar
from scenegen import __version__
from scenegen.base.errors import DatasetError
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME
from scenegen.draw.parts.normals import Normals
from scenegen.draw.sample import GROUPS
from scenegen.verification import verify
from scenegen.worlds.labels import labels_by
from tests.conftest import dataset_in, small_recipe
from tests.mutations.case import REFUSED
from tests.mutations.damage_hdf5 import external, link, other_shape, other_type, virtual
from tests.mutations.hdf5_chunks import (
    chunk_missing,
    chunk_of_our_own,
    shuffled_bomb,
    unknown_filter,
)
from tests.scenegen import cases
from tests.scenegen.verification.conftest import failed
from tests.scenegen.verification.forge import copy, edit_at, read
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


def paths_in(value, above=""):
    """The dotted paths of all that stands in a manifest; of a list, of its first item."""
    inner = value.items() if isinstance(value, dict) else list(enumerate(value))[:1]
    for name, item in inner:
        yield f"{above}{name}"
        if isinstance(item, dict | list):
            yield from paths_in(item, f"{above}{name}.")


@pytest.fixture(scope="module")
def rich(tmp_path_factory):
    """A dataset whose manifest has all that there may be, but for worlds from files."""
    rays = BeamTable.of(Lidar(rows=4, columns=12))
    recipe = small_recipe(noise={"stages": "range:0.02"}, mapping={"scans": 2})
    parts = {"labels": labels_by("class", ()), "normals": Normals()}
    recipe = dataclasses.replace(recipe, lidar=rays, parts=parts)
    return dataset_in(tmp_path_factory.mktemp("rich") / "d", recipe).folder


@pytest.mark.parametrize("original", ["made", "rich"])
def test_no_value_in_a_manifest_ends_in_a_traceback(original, request, tmp_path):
    """Or in another sample."""
    folder = copy(request.getfixturevalue(original), tmp_path / "d")
    good, dataset = (folder / NAME).read_text(), Dataset(folder)
    expected = dataset.split("train")[0].sha256(), dataset.world("train", 0)
    outcomes, lines = Counter(), set()
    for path, value in itertools.product(paths_in(json.loads(good)), BAD):
        (folder / NAME).write_text(good)
        edit_at(folder, path, value)
        try:
            dataset = Dataset(folder)
            split = dataset.split("train")
            assert math.prod(split.describe()["tudf"]["shape"]) < 1 << 27
            assert (split[0].sha256(), dataset.world("train", 0)) == expected
            assert dataset.manifest.recipe.grid == dataset.grid
            outcomes["loaded"] += 1
        except DatasetError as error:
            outcomes["refused"] += 1
            lines.add(str(error))
    assert outcomes["refused"] > 10 * outcomes["loaded"] > 0
    assert max(map(len, lines)) < 700 + 2 * len(str(folder))


@pytest.mark.parametrize(("path", "value"), cases("dataset/trust_newer"))
def test_what_this_version_does_not_know_is_called_newer(dataset, path, value):
    edit_at(dataset, path, value)
    line = refused(lambda: Dataset(dataset))
    assert ("newer scenegen" in line, "damaged" in line) == (True, False)
    assert path.rpartition(".")[2] in line
    assert not verified(dataset)


@pytest.mark.parametrize(
    ("scenegen_version", "word"), [("99.1.0", "newer scenegen"), (__version__, "damaged")]
)
def test_damage_is_called_newer_where_a_later_version_wrote(dataset, scenegen_version, word):
    software = {"scenegen": scenegen_version}
    edit(dataset, counts=7, software=software)
    assert word in refused(lambda: Dataset(dataset))


def verified(dataset):
    try:
        return verify(dataset, quick=True).ok
    except DatasetError:
        return False


@pytest.mark.parametrize(
    "version", [1, 1.1, "1.4", 0, "1.x", None, -1, [1, 4], "1.5.6", "9" * 9999, True]
)
def test_earlier_formats_are_refused_in_one_line(dataset, version):
    edit(dataset, version=version)
    line = refused(lambda: Dataset(dataset))
    assert ("newer" in line, "generate the dataset again" in line) == (False, True)


def test_what_is_no_manifest_is_refused(dataset):
    good = (dataset / NAME).read_bytes()
    for content in (
        *(b"", b"[]", b"[" * 10**6, b"\xff\xfe", b'{"shards": 1}'),
        good.replace(b"pillar", b"\xff\xfe"),
        good.replace(b'"seed": 3', b'"seed": 3' + b"0" * 99),
    ):
        (dataset / NAME).write_bytes(content)
        assert NAME in refused(lambda: Dataset(dataset))
    (dataset / NAME).unlink()
    (dataset / NAME).symlink_to(dataset / NAME)
    refused(lambda: Dataset(dataset))


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
    monkeypatch.setattr("scenegen.dataset.archive.MAX_DOCUMENT_BYTES", 10)
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
    monkeypatch.setattr("scenegen.dataset.archive.MAX_ARCHIVE_BYTES", 1000)
    put(mesh=bytes(1000))
    assert "bytes unpacked, expected 1000 at most" in refused(world)


def test_a_shard_belongs_to_the_manifest_that_it_was_written_for(dataset):
    """What a compact dataset leaves out is derived by the manifest's sensor and grid."""
    good = read(dataset)
    for path, value in (
        ("recipe.lidar.max_range_m", "9.0"),
        ("recipe.grid.voxel_m", "0.25"),
        ("seed", "4"),
    ):
        edit(dataset, **good)
        edit_at(dataset, path, value)
        assert "was written with parameters" in refused(lambda: scenegen.load(dataset)[0])
    (dataset / "train-00000.h5").unlink()
    shutil.copy(dataset / "train-00001.h5", dataset / "train-00000.h5")
    edit(dataset, **good)
    assert "was written with" in refused(lambda: scenegen.load(dataset)[0])


def test_shards_are_as_many_as_the_counts_say_and_none_is_there_twice(dataset):
    shards = read(dataset)["shards"]
    edit(dataset, shards=shards[1:])
    assert "counts.train = 11, but its shards hold 8 samples" in refused(
        lambda: scenegen.load(dataset)
    )
    counts = {"train": 10**5, "val": 0, "test": 0}
    edit(dataset, shards=shards[:1] * 10_000, counts=counts, complete=False)
    begin = time.process_time()
    assert "listed more than once" in refused(lambda: Dataset(dataset))
    assert time.process_time() - begin < 5
    edit(dataset, shards=[{**shards[0], "samples": 10**5}], complete=True)
    assert "train-00000.h5" in refused(lambda: scenegen.load(dataset)[0])


def test_no_manifest_prints_lines_of_its_own_or_nests_without_end(dataset):
    line = json.dumps("\nverify: all 17 checks passed\x1b[2J")
    good = read(dataset)
    for path, value in (
        ("rejected.worlds", f'{{{line}: "x"}}'),
        ("fields", f"[{line}]"),
        ("version", line),
        ("recipe.lidar", f"{{{line}: 1}}"),
        ("recipe.kind", line),
        ("recipe.parts", f"{{{line}: {{}}}}"),
        ("recipe.world", '{"a":' * 300 + "1" + "}" * 300),
    ):
        edit(dataset, **good)
        edit_at(dataset, path, value)
        assert "\x1b" not in refused(lambda: scenegen.load(dataset)[0])


@pytest.mark.parametrize(("field", "value", "said"), cases("dataset/trust_broken"))
def test_a_compact_dataset_derives_nothing_from_a_broken_pose(tmp_path, field, value, said):
    dataset_in(tmp_path / "d", seed=3, compact=True)
    with h5py.File(tmp_path / "d" / "train-00000.h5", "r+") as file:
        file[field][1] = float(value)
    samples = scenegen.load(tmp_path / "d")
    assert samples[0].free.any()
    assert f"train-00000.h5: sample 1: {said}" in refused(lambda: whole(samples[1]))
