"""A shard: the unit of work, of writing and of recovery. It has a file of samples and an archive of
their worlds."""

import io
import json
import math
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import h5py
import isal.isal_zlib
import numpy as np

from lidarsim.engines import DEFAULT, ENGINES, EngineFactory
from lidarsim.jit import cache_trouble, no_kernels
from scenegen.base.errors import CorruptFileError, DatasetError, reraise_as
from scenegen.base.reading import sha256_in, sha256_of
from scenegen.base.stores import Location, create_at
from scenegen.base.workers import Worker
from scenegen.dataset.layout import DIGEST, Layout, open_file, open_shard
from scenegen.dataset.schema import ShardEntry, stem_of
from scenegen.draw.draw import Rejections, Unit, compile_truth, draw_unit, none_rejected
from scenegen.draw.sample import DERIVED, FIELDS
from scenegen.draw.source import Source
from scenegen.worlds.recipe import Recipe

_LEVEL = 1
"""Compression level. The next one saves one percent, the one after takes four times as long
(docs/log)."""
_FIRST = 4
"""Bytes that ISA-L gets before the rest of a block: the minimum that starts its history."""


Drawn = tuple[Callable[[str], Any], bytes]
"""A sample to write: a function from field names to values, and its digest."""


def find_engine(name: str) -> EngineFactory:
    """Factory of an engine.

    Raises:
        DatasetError: if the engine is not available.
    """
    with reraise_as(DatasetError):
        return ENGINES.find(name).of


@dataclass(frozen=True, kw_only=True)
class Units:
    """Units of a split: all that they depend on except their number. Small, and can be pickled."""

    recipe: Recipe
    source: Source
    seed: int = 0
    split: str = "train"
    engine: str = DEFAULT
    """Name of the engine that casts rays; see `lidarsim.engines.ENGINES`."""

    @property
    def derived(self) -> bool:
        """Whether samples have derived fields."""
        return False

    def draw(self, unit: int) -> Unit:
        """Draw a unit. Raises GenerationError, and DatasetError if the engine is not available."""
        return draw_unit(
            self.source,
            self.recipe,
            seed=self.seed,
            split=self.split,
            unit=unit,
            derived=self.derived,
            engine=find_engine(self.engine),
        )


@dataclass(frozen=True, kw_only=True)
class ShardSpec(Units):
    """A shard to write: all that its samples depend on, independent of its location. It is small
    and can be pickled, so that any process on any machine can write it."""

    index: int
    """Position of the shard in its split."""
    samples: int
    first_unit: int
    """First of its units, of which there are as many as `numbers`. Their samples are cut to
    `samples`."""
    numbers: Sequence[int]
    """World numbers of its units, perhaps repeated."""
    parameters: str
    """Fingerprint of the dataset, which is stored in the shard as the mark of its dataset."""
    layout: Layout
    """Layout of the file."""

    @property
    def file(self) -> str:
        """Name of the file of samples."""
        return f"{stem_of(self.split, self.index)}.h5"

    @property
    def worlds(self) -> str:
        """Name of the archive of worlds."""
        return f"{stem_of(self.split, self.index)}.worlds.zip"

    @property
    def derived(self) -> bool:
        """Whether samples have derived fields; see `Units`."""
        return "tudf" in self.layout

    def prepare(self, workers: int) -> None:
        """Compile kernels before workers start, each of which would otherwise compile them. Invalid
        parameters fail here.

        `workers` is the number of processes that may be used.
        """
        with ExitStack() as stack:
            if workers > 1 and no_kernels("scenegen") and not cache_trouble("scenegen"):
                # a second process compiles those that `draw` would come to last
                compiler = Worker(partial(compile_truth, self.source, self.recipe))
                stack.callback(compiler.end)
                compiler.give(self.split)
            self.draw(self.first_unit)

    def write(self, location: Location) -> "ShardReport":
        """Draw the units into memory, a few megabytes, and write the shard. Raises GenerationError,
        DatasetError and StoreError."""
        rejected, documents = none_rejected(), dict[str, bytes]()

        def drawn() -> Iterator[Drawn]:
            remaining = self.samples
            for n in range(len(self.numbers)):
                unit = self.draw(self.first_unit + n)
                for subject, counts in unit.rejected.items():
                    rejected[subject].update(counts)
                # units may share a world, and worlds may share files
                documents.update({f"{unit.number:06d}.xml": unit.world.mjcf, **unit.world.assets})
                # the last flight of a split may have more samples than are needed
                for sample in unit.samples[: max(remaining, 0)]:
                    yield partial(getattr, sample), sample.sha256()
                remaining -= len(unit.samples)

        return put(location, self, drawn(), documents, rejected)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShardReport:
    """A shard on disk."""

    entry: ShardEntry
    """Its entry in the manifest."""
    size: int
    """Size of both files, bytes."""
    rejected: Rejections
    digests: bytes
    """SHA-256 of the samples, 32 bytes each, in order."""


def put(
    location: Location,
    spec: ShardSpec,
    samples: Iterable[Drawn],
    documents: Mapping[str, bytes],
    rejected: Rejections,
) -> ShardReport:
    """Write a shard. The archive is written first; the file of samples commits the shard.

    Args:
        location: Location of the dataset.
        spec: The shard.
        samples: The samples, in order. They may be drawn while they are consumed.
        documents: Files of the worlds by name. Read after the last sample.
        rejected: Numbers of rejected draws. Read after the last sample.

    Returns:
        The report of the shard.

    Raises:
        DatasetError: if it cannot be written. Errors of `samples` pass through.
    """
    digests = list[bytes]()
    layout = {name: column for name, column in spec.layout.items() if name != DIGEST}
    # in memory, so that the file can be written atomically, or put at a store
    with h5py.File(spec.file, "w", driver="core", backing_store=False, block_size=1 << 20) as file:
        packed = _create(file, layout, spec.samples)
        # scalars and poses are not compressed, and written together at the end
        small: dict[str, list[Any]] = {name: [] for name in layout if name not in packed}
        for value_of, digest in samples:
            for name, values in small.items():
                values.append(value_of(name))
            for name, column in packed.items():
                value = value_of(name)
                # past HDF5's own filter, as ISA-L packs several times as fast as zlib
                column.write_direct_chunk((len(digests),) + (0,) * value.ndim, compress(value))
            digests.append(digest)
        for name, values in small.items():
            file[name][:] = np.array(values)
        joined_digests = b"".join(digests)
        # a chunk for each sample, as of all fields: readers refuse any other
        file.create_dataset(
            DIGEST, data=np.frombuffer(joined_digests, np.uint8).reshape(-1, 32), chunks=(1, 32)
        )
        worlds = zip_reproducibly(tuple(documents.items()))
        file.attrs["split"] = spec.split
        # the least, and not the first: worlds from files come round within a shard
        file.attrs["first_world"] = min(spec.numbers)
        file.attrs["worlds_sha256"] = sha256_of(worlds)
        file.attrs["parameters"] = spec.parameters
        # sorted: counts come in the order of rejections, and equal shards must have equal bytes
        file.attrs["rejected"] = json.dumps(rejected, sort_keys=True)
        # the image is complete only after a flush
        file.flush()
        content = file.id.get_file_image()
    # the archive first: the file of samples marks the shard as complete
    create_at(location, spec.worlds, worlds)
    create_at(location, spec.file, content)
    sums = sha256_of(content), sha256_of(worlds)
    return report_of(spec, sums, len(content) + len(worlds), rejected, joined_digests)


LARGE_BYTES = 1000
"""A table of more bytes a sample is compressed."""


def _create(file: h5py.File, layout: Layout, samples: int) -> dict[str, h5py.h5d.DatasetID]:
    """Make the HDF5 datasets of a shard, one chunk for each sample. Returns those of grids, ranges
    and large tables, which are compressed."""
    opened = {}
    for name, (dtype, shape) in layout.items():
        packed = not {"grid", "rays"}.isdisjoint(FIELDS[name]["axes"].split())
        # of tables of movers, 200 KB a sample, most rows are unused
        packed |= dtype.itemsize * math.prod(shape) > LARGE_BYTES
        packing = {"compression": "gzip", "compression_opts": _LEVEL} if packed else {}
        dataset = file.create_dataset(
            name, shape=(samples, *shape), dtype=dtype, chunks=(1, *shape), **packing
        )
        # the others must be closed here: HDF5's layout of the file, and so its bytes, depends on it
        if packed:
            opened[name] = dataset.id
    return opened


def report_of(
    spec: ShardSpec, sums: tuple[str, str], size: int, rejected: Rejections, digests: bytes
) -> ShardReport:
    """Make the report of a shard.

    Args:
        spec: The shard.
        sums: SHA-256 of the file of samples and of the archive.
        size: Size of both, bytes.
        rejected: Numbers of rejected draws.
        digests: SHA-256 of the samples, 32 bytes each.
    """
    entry = ShardEntry(
        file=spec.file,
        worlds=spec.worlds,
        split=spec.split,
        samples=spec.samples,
        first_world=min(spec.numbers),
        sha256=sums[0],
        worlds_sha256=sums[1],
    )
    return ShardReport(entry=entry, size=size, rejected=rejected, digests=digests)


def compress(values: np.ndarray) -> bytes:
    """Compress a chunk as HDF5's gzip filter would. Equal values give equal bytes.

    ISA-L hashes uninitialised memory in place of the third byte if it gets all bytes at once
    (`write_first_byte` in igzip_icf_body_h1_gr_bt.asm, where `tmp2` is not set): one process in
    hundreds would write other bytes. Therefore the first bytes are passed separately.
    """
    raw = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
    stream = isal.isal_zlib.compressobj(_LEVEL)
    first = stream.compress(raw[:_FIRST]) + stream.flush(isal.isal_zlib.Z_SYNC_FLUSH)
    return first + stream.compress(raw[_FIRST:]) + stream.flush()


def read_report(folder: Path, task: tuple[ShardSpec, ShardEntry | None]) -> ShardReport | None:
    """Read the report of an existing shard.

    A listed shard is compared with its sums. The samples of an unlisted one are compared with their
    digests.

    Args:
        folder: Folder of the dataset.
        task: The expected shard, and its entry in the manifest, if it has one.

    Returns:
        The report; None if the shard is missing, damaged, or another dataset's.
    """
    spec, listed = task
    try:
        path = folder / spec.file
        with open_file(path) as file, open_file(folder / spec.worlds) as worlds:
            shard = open_shard(path, spec.samples, spec.layout)
            size = sum(os.fstat(handle.fileno()).st_size for handle in (file, worlds))
            sums = sha256_in(file), sha256_in(worlds)
            shard.check_origin(
                split=spec.split,
                first_world=min(spec.numbers),
                worlds_sha256=sums[1],
                parameters=spec.parameters,
            )
            if listed is not None and listed.sums != sums:
                return None
            for row in range(spec.samples) if listed is None else ():
                shard.check(row)
                for name in (name for name in DERIVED if name in shard.columns):
                    # digests do not cover derived fields: check that they can be unpacked
                    shard.value(name, row, read_only=True)
            return report_of(spec, sums, size, shard.rejected(), shard.column(DIGEST).tobytes())
    # whatever is wrong, the shard will be written again
    except (CorruptFileError, OSError, KeyError, ValueError):
        return None


# a local header: version 2.0, no flags, deflate, midnight, 1 January 1980
ARCHIVE = b"PK\x03\x04\x14\0\0\0\x08\0\0\0!\0"
"""First bytes of files made by `zip_reproducibly`."""


@lru_cache(maxsize=1)  # all shards of a large map have the same archive
def zip_reproducibly(members: tuple[tuple[str, bytes], ...]) -> bytes:
    """Make a zip file whose bytes depend only on its members."""
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for name, content in sorted(members):
            # fixed values for everything that depends on the time or the machine
            member = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            member.compress_type = zipfile.ZIP_DEFLATED
            member.create_system = 3
            member.external_attr = 0o644 << 16
            archive.writestr(member, content, compresslevel=6)
    return memory.getvalue()
