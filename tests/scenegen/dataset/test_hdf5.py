"""An index is what the HDF5 library finds, and bytes that no library should see end in one line."""

import functools
import multiprocessing
import os
import struct
import time
import tracemalloc

import h5py
import numpy as np
import pytest

from scenegen.dataset import hdf5
from scenegen.dataset.layout import layout_of, open_shard
from scenegen.errors import BrokenError
from scenegen.sample import GROUPS, Schema
from tests.conftest import small_recipe
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed


def by_library(path):
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


def by_index(path, most=10**6, read=hdf5.read_index):
    with open(path, "rb") as file:
        index = read(file, most)
    found = {"": dict(index.attributes)}
    for name, it in index.objects.items():
        assert isinstance(it, hdf5.Stored)
        dtype, places = np.dtype(it.dtype), sorted(map(tuple, it.places.tolist()))
        found[name] = (dtype, it.shape, it.chunk, it.filters, places)
    return found


@pytest.mark.parametrize("libver", ["earliest", "latest"])
def test_indexes_are_those_of_the_library(tmp_path, libver):
    path, rng = tmp_path / "x.h5", np.random.default_rng(0)
    packed = {"compression": "gzip", "shuffle": True}
    columns = {
        "a": ("bool", (), {}),
        "b": ("<f4", (3,), {"compression": "gzip"}),
        "c": ("<f8", (2, 3), packed),
        "d": ("<i8", (2, 1, 3), packed | {"fletcher32": True}),
    }
    with h5py.File(path, "w", libver=libver) as file:
        for name, (dtype, shape, more) in columns.items():
            values = rng.integers(0, 2, (700, *shape)).astype(dtype)
            file.create_dataset(name, data=values, chunks=(1, *shape), **more)
        file.attrs.update({"text": "ä" * 700, "number": -7, "bytes": np.bytes_(b"plain")})
        file.attrs.update({"empty": "", "several": [1, 2], "real": 0.5})
    expected = by_library(path)
    expected[""] |= {"bytes": "plain", "several": None, "real": None}
    assert by_index(path) == expected
    with pytest.raises(hdf5.Hdf5Error, match="more than 699 chunks"):
        by_index(path, 699)


def test_a_shard_tells_its_own_index_and_no_library_is_asked(made, tmp_path, monkeypatch):
    path, bad = next(made.glob("train-*.h5")), tmp_path / "bad.h5"

    def index(path, read=hdf5.read_index):
        with open(path, "rb") as file:
            return read(file, 10**6)

    expected = index(path, hdf5.library_index)
    monkeypatch.setattr(hdf5, "library_index", None)
    assert index(path) == expected
    content, end = path.read_bytes(), len(hdf5.MARK) + 8
    length = int.from_bytes(content[-end:-16], "little")
    text = content[-end - length : -end]
    changes = (b"[", b"{"), (b'"objects"', b'"object"'), (b'"78', b'"79'), (b'"<', b'"?')
    changed = [text.replace(*change) for change in changes]
    changed.append(text.replace(b'"split": "train"', b'"split": 0.5'))
    assert text not in changed
    said = [(wrong, len(wrong)) for wrong in (*changed, text[:-9], b"[]", b"[" * 100_000)]
    for wrong, size in (*said, (b"", 2**60)):
        bad.write_bytes(content[:-end] + wrong + size.to_bytes(8, "little") + hdf5.MARK)
        with pytest.raises(hdf5.Hdf5Error, match="its index"):
            index(bad)


def test_an_index_that_is_not_the_librarys_is_found(made, tmp_path):
    path = forge.copy(made, tmp_path / "data") / "train-00000.h5"
    own = path.read_bytes()
    with h5py.File(path, "r+") as file:  # as a file of others: the library drops what is behind it
        file.attrs["first_world"] = 7
        file.flush()
        edited = bytes(file.id.get_file_image())
    assert not path.read_bytes().endswith(hdf5.MARK)
    path.write_bytes(edited + own[-24 - int.from_bytes(own[-24:-16], "little") :])
    found = failed(path.parent, quick=True)
    assert "is not what the HDF5 library finds" in str(found)


def shard_arrays(path):
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}


@functools.cache
def layout():
    recipe = small_recipe()
    return layout_of(GROUPS[""], Schema(grid=recipe.grid, lidar=recipe.lidar))


def read_all(path):
    with open(path, "rb") as file:
        shard = open_shard(file, path, 3, layout())
        return {
            name: np.stack([shard.value(name, row) for row in range(3)]) for name in shard.columns
        }


def bits(arrays):
    """What arrays hold, to compare."""
    return {name: (it.dtype, it.shape, it.tobytes()) for name, it in arrays.items()}


def test_values_are_the_librarys_whoever_wrote_them_and_whoever_reads(made, tmp_path):
    path, repacked = made / "train-00000.h5", tmp_path / "repacked.h5"
    expected = shard_arrays(path)
    assert bits(read_all(path)) == bits(expected)
    options = {"compression": "gzip", "shuffle": True, "fletcher32": True}
    with h5py.File(repacked, "w", libver="latest") as file:
        for name, values in expected.items():
            file.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), **options)
    assert bits(read_all(repacked)) == bits(expected)
    with multiprocessing.get_context("fork").Pool(1) as pool:  # a daemon, as torch's loaders are
        assert bits(pool.apply(read_all, (repacked,))) == bits(expected)
        pool.close()
        pool.join()
    with h5py.File(repacked, "w", libver="latest") as file:
        for name, values in expected.items():
            file.create_dataset(name, data=values)
    with pytest.raises(BrokenError, match=r"repacked\.h5: \w+ has other chunks than one a sample"):
        read_all(repacked)


def places_of_structure(content, path):
    """Bytes that are no sample's."""
    structure = np.ones(len(content), bool)
    for name, parts in by_library(path).items():
        for _, begin, size, _ in parts[4] if name else ():
            structure[begin : begin + size] = False
    return np.flatnonzero(structure)


NUMBERS = [struct.pack("<Q", number) for number in (0, 96, 2**63, 2**64 - 1)]
TELLING = [*NUMBERS, b"\1\0\0\0", b"\xff\xff", b"\0" * 50]


def test_bytes_changed_anywhere_end_in_the_same_values_or_one_line(made, tmp_path):
    """Deflate notices what is changed in a packed sample; a pose is not packed, but stays a pose in
    form."""
    path, target = made / "train-00000.h5", tmp_path / "train-00000.h5"
    whole, expected, rng = path.read_bytes(), shard_arrays(path), np.random.default_rng(7)
    whole = whole[: -24 - int.from_bytes(whole[-24:-16], "little")]  # the library's part of it
    structure = places_of_structure(whole, path)
    refusals, begin = [], time.monotonic()
    tracemalloc.start()
    for n in range(150):
        content = bytearray(whole)
        for _ in range(1 + n % 3):
            at = int(rng.choice(structure) if n % 4 else rng.integers(len(whole)))
            put = TELLING[int(rng.integers(len(TELLING)))] if n % 2 else rng.bytes(1)
            if n % 5 == 0 and len(put) == 8:  # a pointer to somewhere in the file
                put = struct.pack("<Q", int(rng.choice(structure)))
            content[at : at + len(put)] = put
        target.write_bytes(content[: len(whole) if n % 11 else int(rng.integers(len(whole)))])
        try:
            found = read_all(target)
            for name, values in expected.items():
                assert (found[name].shape, found[name].dtype) == (values.shape, values.dtype)
        except BrokenError as error:
            refusals.append(str(error))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert not [line for line in refusals if "\n" in line or len(line) > 400]
    assert 40 < len(refusals) < 150
    assert peak < 64 << 20
    assert time.monotonic() - begin < 60


def end_it():
    """End the library's process, which this one has begun."""
    with open(__file__, "rb") as file, pytest.raises(hdf5.Hdf5Error, match="signature not found"):
        hdf5.read_index(file, 1)
    process = hdf5._LIBRARIES[os.getpid()]._process
    process.kill()
    process.wait()


@pytest.mark.parametrize(
    ("does", "said"),
    [
        ("time.sleep(600)", "took too long"),
        ("bytearray(2 << 30)", "does not read it: MemoryError"),
        ("os.abort()", "crashed"),
    ],
)
def test_a_library_that_hangs_swells_or_crashes_does_so_elsewhere(made, monkeypatch, does, said):
    patched = f"import os, time; from {hdf5.__name__} import serve; g = serve.__globals__; "
    patched += f"g.update(SECONDS=1, _index=lambda *_: {does}); serve()"
    path = made / "train-00000.h5"
    with monkeypatch.context() as patch:
        patch.setattr(hdf5, "SERVE", patched)
        end_it()
        with pytest.raises(hdf5.Hdf5Error, match=f"the HDF5 library {said}"):
            by_index(path, read=hdf5.library_index)
        hdf5._LIBRARIES.clear()
    assert by_index(path) == by_library(path)
