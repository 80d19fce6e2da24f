"""Datasets from strangers: whatever stands in a manifest, a shard or an archive ends in one line,
and soon."""

import dataclasses
import itertools
import json
import re
import resource
import shutil
import tracemalloc
import zipfile
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
from tests.mutations import damage_hdf5
from tests.mutations.case import REFUSED
from tests.mutations.nasty import places
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.verification.conftest import failed
from tests.scenegen.verification.forge import edit_at, read
from tests.scenegen.verification.forge import edit_manifest as edit

BAD = 'null -1 1e308 "x" [] [[1]] {} {"a":1} true'
BAD = [*BAD.split(), r'"\nverify: ok\u001b[2J"', r'{"\nverify: ok\u001b[2J":{}}', ""]
"""JSON to put in place of what stands in a manifest, or that nothing stands there."""


def read_whole(dataset, number=0):
    """All fields of a training sample, each of which is read when asked for."""
    sample = scenegen.load(dataset)[number]
    return tuple(getattr(sample, name) for name in GROUPS[""])


def test_no_value_in_a_manifest_ends_in_a_traceback(tmp_path):
    """Or in another sample. The manifest has all that there may be, but for worlds from files."""
    rays = BeamTable.of(Lidar(rows=4, columns=12))
    recipe = small_recipe(noise={"stages": "range:0.02"}, mapping={"scans": 2})
    parts = {"labels": labels_by("class", ()), "normals": Normals()}
    dataset = dataset_in(tmp_path / "d", dataclasses.replace(recipe, lidar=rays, parts=parts))
    folder, good = dataset.folder, (dataset.folder / NAME).read_text()

    def read():
        opened = Dataset(folder)
        assert opened.manifest.recipe.grid == opened.grid
        return opened.split("train")[0].sha256(), opened.world("train", 0)

    expected, loaded, lines = read(), [], []
    # of a list, the first item
    paths = {re.sub(r"\.\d+", ".0", name[1:]) for *_, name in places(json.loads(good))}
    for path, value in itertools.product(sorted(paths), BAD):
        (folder / NAME).write_text(good)
        edit_at(folder, path, value)
        try:
            loaded.append(read())
        except DatasetError as error:
            lines.append(str(error))
    assert loaded == [expected] * len(loaded)
    assert len(lines) > 10 * len(loaded) > 0
    assert max(map(len, lines)) < 700 + 2 * len(str(folder))
    assert [line for line in lines if not line.isprintable()] == []


@each_case("dataset/trust_newer", "path value")
def test_what_this_version_does_not_know_is_called_newer(dataset, path, value):
    edit_at(dataset, path, value)
    refuses(f"{path} {value}", Dataset, dataset)
    assert not verify(dataset, quick=True).ok


@pytest.mark.parametrize("version", ["99.1.0", __version__])
def test_damage_is_called_newer_where_a_later_version_wrote(dataset, version):
    edit(dataset, counts=7, software={"scenegen": version})
    refuses(version.replace(__version__, "this"), Dataset, dataset)


@pytest.mark.parametrize("version", [1, 1.1, "1.4", "1.x", None, -1, [1, 4], True])
def test_earlier_formats_are_refused_in_one_line(dataset, version):
    edit(dataset, version=version)
    refuses(repr(version), Dataset, dataset)


NO_MANIFESTS = {
    **{"empty": b"", "list": b"[]", "deep": b"[" * 10**6, "shards": b'{"shards": 1}'},
    "no UTF-8": b'{"format": "\xff\xfe"}',
    "digits": b'{"seed": 3' + b"0" * 9999 + b"}",
}


def test_what_is_no_manifest_is_refused(tmp_path):
    for case, content in NO_MANIFESTS.items():
        (tmp_path / NAME).write_bytes(content)
        refuses(case, Dataset, tmp_path)
    (tmp_path / NAME).unlink()
    (tmp_path / NAME).symlink_to(tmp_path / NAME)
    refuses("circle", Dataset, tmp_path)


@each_case("dataset/damages", "damage seed")
def test_no_shard_ends_in_a_traceback_or_takes_the_memory(dataset, damage, seed):
    """By the campaign in tests/mutations, with seeds by which damages come out otherwise."""
    with h5py.File(dataset / "train-00000.h5", "r+") as file:
        assert getattr(damage_hdf5, damage)(file, "occupancy", Random(int(seed)))[1] == REFUSED
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refuses(f"{damage} {seed}", read_whole, dataset)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + (100 << 10)  # KB
    assert np.isfinite(scenegen.load(dataset)[3].tudf).all()  # the next shard
    assert "train-00000.h5" in failed(dataset, quick=True)["layout"]


def put(dataset, document, members):
    """An archive of a world and some members in place of a shard's."""
    path = dataset / "train-00000.worlds.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {"000000.xml": document, **members}.items():
            archive.writestr(name, content)
    return path


def test_an_archive_unpacks_to_what_its_directory_says_and_no_further(dataset, monkeypatch):
    document = b'<mujoco><asset><mesh file="mesh"/></asset></mujoco>'
    put(dataset, document, dict.fromkeys(("mesh", "unused", "esh"), b"v"))
    assert Dataset(dataset).world("train", 0) == {"world.xml": document, "mesh": b"v"}
    for size in (999, 40 << 20):
        path = put(dataset, document, {"mesh": bytes(size)})
        # where its head and the directory say how large it is; they say 1000 bytes
        said = size.to_bytes(4, "little")
        path.write_bytes(path.read_bytes().replace(said, (1000).to_bytes(4, "little")))
        opened = Dataset(dataset)
        tracemalloc.start()
        refuses(size, opened.world, "train", 0)
        assert tracemalloc.get_traced_memory()[1] < 10 << 20
        tracemalloc.stop()
    monkeypatch.setattr("scenegen.dataset.archive.MAX_ARCHIVE_BYTES", 1000)
    put(dataset, document, {"mesh": bytes(1000)})
    refuses("too large", Dataset(dataset).world, "train", 0)


def test_a_shard_belongs_to_the_manifest_that_it_was_written_for(dataset):
    """What a compact dataset leaves out is derived by the manifest's sensor and grid."""
    good = read(dataset)
    for path, value in (("lidar.max_range_m", "9.0"), ("grid.voxel_m", "0.25")):
        edit_at(dataset, f"recipe.{path}", value)
        refuses(path, read_whole, dataset)
        edit(dataset, **good)
    # another file: HDF5 would share the metadata of one that an earlier reading has not closed yet
    (dataset / "train-00000.h5").unlink()
    shutil.copy(dataset / "train-00001.h5", dataset / "train-00000.h5")
    refuses("another shard", read_whole, dataset)


def test_shards_are_as_many_as_the_counts_say_and_none_is_there_twice(dataset):
    shards, counts = read(dataset)["shards"], {"train": 6, "val": 0, "test": 0}
    edit(dataset, shards=shards[1:])
    refuses("one too few", scenegen.load, dataset)
    edit(dataset, shards=shards[:1] * 2, counts=counts)
    refuses("the same", scenegen.load, dataset)
    edit(dataset, shards=[{**shards[0], "samples": 6}])
    refuses("a short one", read_whole, dataset)


@each_case("dataset/trust_broken", "field value")
def test_a_compact_dataset_derives_nothing_from_a_broken_pose(tmp_path, field, value):
    dataset_in(tmp_path / "d", seed=3, compact=True)
    with h5py.File(tmp_path / "d" / "train-00000.h5", "r+") as file:
        file[field][1] = float(value)
    assert scenegen.load(tmp_path / "d")[0].free.any()
    refuses(f"{field} {value}", read_whole, tmp_path / "d", 1)
