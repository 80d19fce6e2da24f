"""A shard's values are those that HDF5 itself reads, whoever wrote and whoever reads it; what is
damaged ends in one line."""

import functools
import zlib

import h5py
import numpy as np
import pytest

from scenegen.dataset.layout import Chunks, layout_of, open_shard
from scenegen.draw.sample import GROUPS, Schema
from tests.conftest import small_recipe
from tests.refusals import refuses


def shard_arrays(path):
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}


@functools.cache
def layout():
    recipe = small_recipe()
    return layout_of(GROUPS[""], Schema(grid=recipe.grid, lidar=recipe.lidar))


def read_all(path, samples=3):
    shard = open_shard(path, samples, layout())
    return {
        name: np.stack([shard.value(name, row) for row in range(samples)]) for name in shard.columns
    }


def bits(arrays):
    """What arrays hold, to compare."""
    return {name: (it.dtype, it.shape, it.tobytes()) for name, it in arrays.items()}


@pytest.fixture
def shard(made):
    return made / "train-00000.h5"


PACKED = {"compression": "gzip", "shuffle": True, "fletcher32": True}


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("options", [{}, {"compression": "gzip"}, PACKED])
@pytest.mark.parametrize("samples", [1, 3])
def test_any_writers_values_are_read(shard, tmp_path, libver, options, samples):
    """Written as another program might, and by ourselves."""
    expected = {name: values[:samples] for name, values in shard_arrays(shard).items()}
    with h5py.File(tmp_path / "x.h5", "w", libver=libver) as file:
        for name, values in expected.items():
            file.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), **options)
    assert bits(read_all(tmp_path / "x.h5", samples)) == bits(expected)
    assert bits(read_all(shard)) == bits(shard_arrays(shard))


def test_a_shard_is_closed_when_nobody_holds_it(shard, tmp_path):
    path = tmp_path / "x.h5"
    path.write_bytes(shard.read_bytes())
    held = open_shard(path, 3, layout())
    h5py.File(path).close()  # others may read meanwhile
    with pytest.raises(OSError):
        h5py.File(path, "r+")
    del held
    refuses("two samples", open_shard, path, 2, layout())
    h5py.File(path, "r+").close()


def test_a_chunk_is_read_into_its_size_and_no_more(tmp_path):
    packed = zlib.compress(bytes([7] * 100)), zlib.compress(bytes(101)), bytes(99), bytes(1102)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        data = file.create_dataset("x", (4, 100), "u1", chunks=(1, 100), compression="gzip")
        for row, content in enumerate(packed):
            data.id.write_direct_chunk((row, 0), content, row > 1)
        chunks = Chunks(data.id)
        assert chunks.read((0, 0)) == bytes([7] * 100)
        for row in (1, 2, 3):
            refuses(row, chunks.read, (row, 0))
