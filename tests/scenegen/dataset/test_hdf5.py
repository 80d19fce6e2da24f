"""The walker finds what the HDF5 library finds, and on bytes that no library should see it ends in
one line."""

import functools
import multiprocessing
import os
import struct
import time
import tracemalloc
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from scenegen.dataset.foreign import read_index
from scenegen.dataset.hdf5 import ForeignError, Hdf5Error, Stored, walk
from scenegen.dataset.layout import Layout, layout_of, open_shard
from scenegen.errors import BrokenError
from scenegen.sample import GROUPS, Schema
from tests.conftest import small_recipe


def by_library(path: Path) -> dict[str, Any]:
    """What h5py says of every dataset: type, shape, chunk, filters, and its chunks in the order of
    rows."""
    found = {}
    with h5py.File(path) as file:
        for name, dataset in file.items():
            plan, chunks = dataset.id.get_create_plist(), []
            dataset.id.chunk_iter(chunks.append)
            filters = tuple(plan.get_filter(n)[0] for n in range(plan.get_nfilters()))
            places = sorted(
                (c.chunk_offset[0], c.byte_offset, c.size, c.filter_mask) for c in chunks
            )
            found[name] = (dataset.dtype, dataset.shape, dataset.chunks, filters, places)
        return {"": dict(file.attrs), **found}


def by_walk(path: Path, most: int = 10**6, *, foreign: bool = False) -> dict[str, Any]:
    with open(path, "rb") as file:
        index = read_index(file.fileno(), path, most) if foreign else walk(file.fileno(), most)
    found: dict[str, Any] = {"": dict(index.attributes)}
    for name, it in index.objects.items():
        assert isinstance(it, Stored)
        found[name] = (
            it.dtype,
            it.shape,
            it.chunk,
            it.filters,
            sorted(map(tuple, it.places.tolist())),
        )
    return found


@pytest.mark.parametrize("count", [1, 63, 64, 65, 700, 4200])
def test_indexes_of_any_depth_are_those_of_the_library(tmp_path: Path, count: int) -> None:
    """64 chunks fill a node: 4200 take three levels of them."""
    path, rng = tmp_path / "x.h5", np.random.default_rng(count)
    with h5py.File(path, "w") as file:
        for n, dtype in enumerate(("bool", "<f4", "<f8", "<i8", "u1")):
            shape = [(), (3,), (2, 3), (2, 1, 3)][n % 4]
            packed = (
                {"compression": "gzip", "shuffle": n % 2 == 0, "fletcher32": n == 3} if n else {}
            )
            values = rng.integers(0, 2, (count, *shape)).astype(dtype)
            file.create_dataset(f"column {n}", data=values, chunks=(1, *shape), **packed)
        file.attrs.update(
            {"text": "ä" * count, "number": -count, "bytes": np.bytes_(b"plain"), "empty": ""}
        )
    expected = by_library(path)
    expected[""]["bytes"] = "plain"
    assert by_walk(path) == expected
    with h5py.File(tmp_path / "y.h5", "w", libver="latest") as other, h5py.File(path) as file:
        for name in file:
            file.copy(name, other)
        other.attrs.update(file.attrs)
    with pytest.raises(ForeignError):
        by_walk(tmp_path / "y.h5")
    again = by_library(tmp_path / "y.h5")
    again[""]["bytes"] = "plain"
    assert by_walk(tmp_path / "y.h5", foreign=True) == again


def test_shards_are_what_the_library_says(made: Path) -> None:
    for path in made.glob("*.h5"):
        assert by_walk(path) == by_library(path)


def shard_arrays(path: Path) -> dict[str, np.ndarray]:
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}


@functools.cache
def layout() -> Layout:
    recipe = small_recipe()
    return layout_of(GROUPS[""], Schema(grid=recipe.grid, lidar=recipe.lidar))


def read_all(path: Path) -> dict[str, np.ndarray]:
    with open(path, "rb") as file:
        shard = open_shard(file, path, 3, layout())
        return {
            name: np.stack([shard.value(name, row) for row in range(3)]) for name in shard.columns
        }


def same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> bool:
    return set(found) == set(expected) and all(
        found[name].dtype == expected[name].dtype and np.array_equal(found[name], expected[name])
        for name in expected
    )


def test_values_are_the_librarys_whoever_wrote_them_and_whoever_reads(
    made: Path, tmp_path: Path
) -> None:
    path, repacked = made / "train-00000.h5", tmp_path / "repacked.h5"
    expected = shard_arrays(path)
    assert same(read_all(path), expected)
    options = {"compression": "gzip", "shuffle": True, "fletcher32": True}
    with h5py.File(repacked, "w", libver="latest") as file:
        for name, values in expected.items():
            file.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), **options)
    assert same(read_all(repacked), expected)
    with multiprocessing.get_context("fork").Pool(1) as pool:  # a daemon, as torch's loaders are
        assert same(pool.apply(read_all, (repacked,)), expected)
        pool.close()
        pool.join()
    with h5py.File(repacked, "w", libver="latest") as file:
        for name, values in expected.items():
            file.create_dataset(name, data=values)
    with pytest.raises(BrokenError, match=r"repacked\.h5: \w+ has other chunks than one a sample"):
        read_all(repacked)


def places_of_structure(content: bytes, path: Path) -> np.ndarray:
    """Bytes that are no sample's."""
    structure = np.ones(len(content), bool)
    for name, parts in by_library(path).items():
        for _, begin, size, _ in parts[4] if name else ():
            structure[begin : begin + size] = False
    return np.flatnonzero(structure)


TELLING = [
    b"\0" * 8,
    b"\xff" * 8,
    struct.pack("<Q", 96),
    struct.pack("<Q", 2**63),
    b"\1\0\0\0",
    b"\xff\xff",
    b"\0" * 50,
]


def test_bytes_changed_anywhere_end_in_the_same_values_or_one_line(
    made: Path, tmp_path: Path
) -> None:
    """Deflate notices what is changed in a packed sample; a pose is not packed, but stays a pose in
    form."""
    path, target = made / "train-00000.h5", tmp_path / "train-00000.h5"
    whole, expected, rng = path.read_bytes(), shard_arrays(path), np.random.default_rng(7)
    structure = places_of_structure(whole, path)
    refusals = []
    begin = time.monotonic()
    peak = 0
    for n in range(400):
        content = bytearray(whole)
        for _ in range(1 + n % 3):
            at = int(rng.choice(structure) if n % 4 else rng.integers(len(whole)))
            put = TELLING[int(rng.integers(len(TELLING)))] if n % 2 else rng.bytes(1)
            if n % 5 == 0 and len(TELLING[0]) == len(put):  # a pointer to somewhere in the file
                put = struct.pack("<Q", int(rng.choice(structure)))
            content[at : at + len(put)] = put
        target.write_bytes(
            content[: len(whole)] if n % 11 else content[: int(rng.integers(len(whole)))]
        )
        if n % 7 == 0:  # tracing takes most of the time
            tracemalloc.start()
        try:
            found = read_all(target)
            for name, values in expected.items():
                assert (found[name].shape, found[name].dtype) == (values.shape, values.dtype)
        except BrokenError as error:
            refusals.append(str(error))
        if n % 7 == 0:
            peak = max(peak, tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    assert not [line for line in refusals if "\n" in line or len(line) > 400]
    assert 100 < len(refusals) < 400
    assert peak < 64 << 20
    assert time.monotonic() - begin < 120


def test_no_pointer_is_followed_in_a_circle(made: Path, tmp_path: Path) -> None:
    """A node of the index that names itself, a header that goes on in itself, an index of more than
    there can be."""
    path = made / "train-00000.h5"
    whole = path.read_bytes()
    node = whole.index(b"TREE\1")
    rank = 4
    itself = bytearray(whole)
    itself[node + 5] = 1  # a level up
    struct.pack_into("<Q", itself, node + 24 + 8 + 8 * (rank + 1), node)
    going_on = bytearray(whole)
    struct.pack_into(
        "<QQ", going_on, 96 + 16 + 8, 96 + 16, 200
    )  # the root's header begins with a continuation
    for content in (itself, going_on):
        (tmp_path / "x.h5").write_bytes(content)
        with (
            open(tmp_path / "x.h5", "rb") as file,
            pytest.raises(Hdf5Error, match="two pointers lead to byte"),
        ):
            walk(file.fileno(), 10)
    with open(path, "rb") as file, pytest.raises(Hdf5Error, match="more than 2"):
        walk(file.fileno(), 2)
    os.truncate(tmp_path / "x.h5", 50)
    with open(tmp_path / "x.h5", "rb") as file, pytest.raises(Hdf5Error):
        walk(file.fileno(), 10)


def hang(task: object) -> None:
    time.sleep(600)


def swell(task: object) -> None:
    bytearray(2 << 30)


def test_structures_that_overlap_are_not_read_over_and_over(made: Path, tmp_path: Path) -> None:
    """Sixty blocks of a header, each beginning 32 bytes after the other and 64 KB long."""
    path = tmp_path / "x.h5"
    content = bytearray((made / "test-00000.h5").read_bytes()[:96])
    root, first, blocks, length = 96, 136, 60, 1 << 16
    content += struct.pack("<BxHIIIHHBxxxQQ", 1, 1, 1, 24, 0, 0x10, 16, 0, first, length)
    for n in reversed(range(blocks)):  # to the next block, and past the others' beginnings
        content += struct.pack(
            "<HHBxxxQQHHBxxx", 0x10, 16, 0, first + 32 * (blocks - n), length, 0, 32 * n, 0
        )
    content += bytes(length)
    struct.pack_into("<Q", content, 40, len(content))
    struct.pack_into("<Q", content, 64, root)
    path.write_bytes(content)
    with pytest.raises(Hdf5Error, match="overlap"):
        by_walk(path)


@pytest.mark.parametrize(("does", "said"), [(hang, "took too long"), (swell, "MemoryError")])
def test_a_library_that_hangs_or_swells_does_so_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, does: object, said: str
) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w", libver="latest") as file:
        file["x"] = 1
    monkeypatch.setattr("scenegen.dataset.foreign._index", does)
    monkeypatch.setattr("scenegen.dataset.foreign.SECONDS", 5.0 if does is swell else 0.5)
    with pytest.raises(
        Hdf5Error, match=rf"its superblock has version \d, and the HDF5 library .*{said}"
    ):
        by_walk(path, foreign=True)
