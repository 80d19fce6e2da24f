"""Datasets from strangers: whatever stands in a manifest, a shard or an archive ends in one line, and soon."""

import copy
import json
import math
import shutil
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import scenegen
from scenegen.dataset import manifest
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError
from scenegen.inspect import inspect

BAD = (None, 3, -1, 1e308, 10**12, "x", "../x", [], [[1]], {}, {"a": 1}, True)


def refused(action: Callable[[], Any]) -> str:
    with pytest.raises(DatasetError) as error:
        action()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600
    return str(error.value)


def test_no_value_in_a_manifest_ends_in_a_traceback(dataset: Path) -> None:
    good = manifest.read(dataset)
    tables = [(), ("grid",), ("lidar",), ("recipe",), ("counts",), ("shards", 0), ("rejected",)]
    count = 0
    for table in tables:
        keys = list(_at(good, table))
        for key in keys:
            for value in (*BAD, ...):
                changed = copy.deepcopy(good)
                if value is ...:
                    del _at(changed, table)[key]
                else:
                    _at(changed, table)[key] = value
                (dataset / manifest.NAME).write_text(json.dumps(changed))
                try:
                    split = scenegen.load(dataset)
                    assert math.prod(split.describe()["tudf"]["shape"]) < 1 << 27
                    assert split.names is not None
                    assert len(split[:1]) <= 1
                except DatasetError as error:
                    count += str(error).count("\n") == 0
    assert count > 250


def _at(found: Any, path: tuple[Any, ...]) -> Any:
    for step in path:
        found = found[step]
    return found


@pytest.mark.parametrize("content", [b"", b"[]", b"[" * 10**6, b"\xff\xfe", b'{"shards": 1}', b"{" + b" " * 10**6])
def test_what_is_no_manifest_is_refused(dataset: Path, content: bytes) -> None:
    (dataset / manifest.NAME).write_bytes(content)
    assert manifest.NAME in refused(lambda: Dataset(dataset))
    refused(lambda: inspect(dataset))


def _replace(file: h5py.File, name: str, **options: Any) -> None:
    shape, dtype = file[name].shape, file[name].dtype
    del file[name]
    options = {"shape": shape, "dtype": dtype, **options}
    file.create_dataset(name, **options)


def _bomb(file: h5py.File) -> None:
    stored = file["tudf"]
    pack = zlib.compressobj(9)
    block = bytes(1 << 20)
    packed = b"".join(pack.compress(block) for _ in range(512)) + pack.flush()
    stored.id.write_direct_chunk((0,) * stored.ndim, packed)


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.pop("tudf"),
        lambda file: _replace(file, "tudf", dtype="f8"),
        lambda file: _replace(file, "tudf", shape=(3, 4, 4)),
        lambda file: _replace(file, "tudf", shape=(10**6, 10**4, 10**4), chunks=(1, 10**4, 10**4)),
        lambda file: _replace(file, "tudf", external=[("/etc/passwd", 0, 10**9)]),
        lambda file: (file.pop("tudf"), file.create_group("tudf")),
        lambda file: (file.pop("tudf"), file.__setitem__("tudf", h5py.SoftLink("/observed"))),
        lambda file: (file.pop("tudf"), file.__setitem__("tudf", h5py.ExternalLink("/etc/passwd", "/tudf"))),
        lambda file: file["tudf"].id.write_direct_chunk((0, 0, 0, 0), b"not gzip at all"),
        _bomb,
    ],
)
def test_no_shard_ends_in_a_traceback_or_takes_the_memory(dataset: Path, damage: Callable[[h5py.File], Any]) -> None:
    with h5py.File(dataset / "train-00000.h5", "r+") as file:
        damage(file)
    assert "train-00000.h5" in refused(lambda: scenegen.load(dataset)[0])
    assert np.isfinite(scenegen.load(dataset)[3].tudf).all()  # the next shard


@pytest.mark.parametrize("keep", [0, 100, 5000, -20])
def test_a_shard_cut_short_is_refused(dataset: Path, keep: int) -> None:
    path = dataset / "train-00000.h5"
    path.write_bytes(path.read_bytes()[:keep])
    assert "train-00000.h5" in refused(lambda: list(scenegen.load(dataset)))


def test_an_archive_writes_nowhere_else_and_takes_no_memory(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = dataset / "train-00000.worlds.zip"
    whole = path.read_bytes()
    for name in ("../up.obj", "/tmp/up.obj", "a/b.obj", ".hidden"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("000000.xml", f'<mujoco file="{name}"/>')
            archive.writestr(name, "up")
        assert "expected a plain file name" in refused(lambda: Dataset(dataset).world("train", 0))
    path.write_bytes(whole[: len(whole) // 2])
    assert "not a whole zip file" in refused(lambda: Dataset(dataset).world("train", 0))
    path.write_bytes(whole)
    monkeypatch.setattr("scenegen.dataset.archive.MOST_DOCUMENT_BYTES", 10)
    assert "expected 10 at most" in refused(lambda: Dataset(dataset).world("train", 0))
    shutil.rmtree(dataset)
    assert "not a dataset" in refused(lambda: scenegen.load(dataset))
