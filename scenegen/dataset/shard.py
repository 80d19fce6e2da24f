"""A shard: the unit of work, of writing and of recovery. One file of samples and one archive of
their worlds."""

import io
import json
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
from scenegen.base.errors import BrokenError, DatasetError, raised_as
from scenegen.base.files import sha256_in, sha256_of
from scenegen.base.stores import Place, create_at
from scenegen.base.workers import Worker
from scenegen.dataset.layout import DIGEST, Layout, open_file, open_shard
from scenegen.dataset.schema import ShardEntry, stem_of
from scenegen.draw.draw import Rejections, Unit, compile_truth, draw_unit, none_rejected
from scenegen.draw.sample import DERIVED, FIELDS
from scenegen.draw.source import Source
from scenegen.worlds.recipe import Recipe

_LEVEL = 1
"""The level of compression: the next one saves a hundredth, the one after takes four times as long
(docs/log)."""
_FIRST = 4
"""Bytes of a block that ISA-L is fed before the rest: the fewest that begin its history."""


Drawn = tuple[Callable[[str], Any], bytes]
"""A sample that is to be written: what gives its fields by their names, and its digest."""


def find_engine(name: str) -> EngineFactory:
    """What makes the engine called `name`. Raises DatasetError for one that is not to be had."""
    with raised_as(DatasetError):
        return ENGINES.find(name).of


@dataclass(frozen=True, kw_only=True)
class Units:
    """The units of a split: all that they are drawn by, but for their number; small, and can be
    pickled."""

    recipe: Recipe
    source: Source
    seed: int = 0
    split: str = "train"
    engine: str = DEFAULT
    """Name of the engine that casts the rays; see `lidarsim.engines.ENGINES`."""

    @property
    def derived(self) -> bool:
        """Whether samples hold what could be derived."""
        return False

    def draw(self, unit: int) -> Unit:
        """Unit `unit` of the split. Raises GenerationError, and DatasetError for an engine that is
        not to be had."""
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
    """A shard that is to be, wherever it is to lie, and all that its samples depend on; small, and
    can be pickled, so that any process anywhere can write it."""

    index: int
    """The shard's place within its split."""
    samples: int
    first_unit: int
    """The first of as many as `numbers`; their samples, in order, are cut to `samples`."""
    numbers: Sequence[int]
    """Numbers of the worlds of its units; a world may stand there several times."""
    parameters: str
    """Fingerprint of the dataset; written into the shard, so that it is never taken for another
    dataset's."""
    layout: Layout
    """What the shard is to hold."""

    @property
    def file(self) -> str:
        """The file of the samples."""
        return f"{stem_of(self.split, self.index)}.h5"

    @property
    def worlds(self) -> str:
        """The file of the worlds."""
        return f"{stem_of(self.split, self.index)}.worlds.zip"

    @property
    def derived(self) -> bool:
        """See `Units`."""
        return "tudf" in self.layout

    def prepare(self, workers: int) -> None:
        """Compile the kernels, with up to so many processes, which every writing process would else
        do by itself; hopeless parameters end here."""
        with ExitStack() as stack:
            if workers > 1 and no_kernels("scenegen") and not cache_trouble("scenegen"):
                other = Worker(partial(compile_truth, self.source, self.recipe))
                stack.callback(other.end)
                other.give(self.split)
            self.draw(self.first_unit)

    def write(self, place: Place) -> "ShardReport":
        """Draw its units into memory, a few megabytes, and write them into a folder, or put them at
        a store. Raises GenerationError, DatasetError, StoreError."""
        rejected, documents = none_rejected(), dict[str, bytes]()

        def drawn() -> Iterator[Drawn]:
            left = self.samples
            for n in range(len(self.numbers)):
                unit = self.draw(self.first_unit + n)
                for what, counts in unit.rejected.items():
                    rejected[what].update(counts)
                documents.update({f"{unit.number:06d}.xml": unit.world.mjcf, **unit.world.assets})
                for sample in unit.samples[: max(left, 0)]:
                    yield partial(getattr, sample), sample.sha256()
                left -= len(unit.samples)

        return put(place, self, drawn(), documents, rejected)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShardReport:
    """A shard on disk."""

    entry: ShardEntry
    """What the manifest lists."""
    size: int
    """Bytes on disk."""
    rejected: Rejections
    digests: bytes
    """The samples' own SHA-256s, 32 bytes each, in order."""


def put(
    place: Place,
    spec: ShardSpec,
    samples: Iterable[Drawn],
    documents: Mapping[str, bytes],
    rejected: Rejections,
) -> ShardReport:
    """Write a shard of `samples` and of worlds: these first, then the samples, which commit it.
    `documents` and `rejected` are looked at once the samples have come to their end.

    Raises DatasetError, and whatever `samples` raise.
    """
    digests = list[bytes]()
    layout = {name: column for name, column in spec.layout.items() if name != DIGEST}
    with h5py.File(spec.file, "w", driver="core", backing_store=False, block_size=1 << 20) as file:
        packed = _create(file, layout, spec.samples)
        small: dict[str, list[Any]] = {name: [] for name in layout if name not in packed}
        for value_of, digest in samples:
            for name, values in small.items():
                values.append(value_of(name))
            for name, column in packed.items():
                value = value_of(name)
                column.write_direct_chunk((len(digests),) + (0,) * value.ndim, compress(value))
            digests.append(digest)
        for name, values in small.items():
            file[name][:] = np.array(values)
        own = b"".join(digests)
        file.create_dataset(
            DIGEST, data=np.frombuffer(own, np.uint8).reshape(-1, 32), chunks=(1, 32)
        )
        worlds = zip_reproducibly(tuple(documents.items()))
        file.attrs["split"] = spec.split
        file.attrs["first_world"] = min(spec.numbers)
        file.attrs["worlds_sha256"] = sha256_of(worlds)
        file.attrs["parameters"] = spec.parameters
        file.attrs["rejected"] = json.dumps(rejected, sort_keys=True)
        file.flush()
        content = file.id.get_file_image()
    create_at(place, spec.worlds, worlds)
    create_at(place, spec.file, content)
    sums = sha256_of(content), sha256_of(worlds)
    return report_of(spec, sums, len(content) + len(worlds), rejected, own)


def _create(file: h5py.File, layout: Layout, samples: int) -> dict[str, h5py.h5d.DatasetID]:
    """Make the shard's datasets, one chunk a sample, and return those that are packed: grids and
    ranges."""
    found = {}
    for name, (dtype, shape) in layout.items():
        packed = not {"grid", "rays"}.isdisjoint(FIELDS[name]["axes"].split())
        packing = {"compression": "gzip", "compression_opts": _LEVEL} if packed else {}
        dataset = file.create_dataset(
            name, shape=(samples, *shape), dtype=dtype, chunks=(1, *shape), **packing
        )
        if packed:  # the others are closed meanwhile, which decides where HDF5 puts what
            found[name] = dataset.id
    return found


def report_of(
    spec: ShardSpec, sums: tuple[str, str], size: int, rejected: Rejections, digests: bytes
) -> ShardReport:
    """The report of a shard whose two files have these SHA-256 `sums`, and `size` bytes in all."""
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
    """A chunk as HDF5's gzip filter would write it: the same bytes for the same values.

    Fed all at once, ISA-L hashes an address on the stack as if it were the third byte
    (`write_first_byte` in igzip_icf_body_h1_gr_bt.asm, where `tmp2` is not set), and one process in
    hundreds writes other bytes.
    """
    raw = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
    stream = isal.isal_zlib.compressobj(_LEVEL)
    first = stream.compress(raw[:_FIRST]) + stream.flush(isal.isal_zlib.Z_SYNC_FLUSH)
    return first + stream.compress(raw[_FIRST:]) + stream.flush()


def read_report(folder: Path, task: tuple[ShardSpec, ShardEntry | None]) -> ShardReport | None:
    """The report of a shard that is in a folder already, or None where there is none as `task` has
    it: what the shard is to be, and what the manifest lists of it.

    A shard whose files are no longer what its entry says, or whose archive is not the one that was
    written with it, is damaged, and counts as absent. Where there is no entry, samples are held
    against their own digests.
    """
    spec, listed = task
    try:
        path = folder / spec.file
        with open_file(path) as file, open_file(folder / spec.worlds) as worlds:
            shard = open_shard(path, spec.samples, spec.layout)
            size = sum(os.fstat(each.fileno()).st_size for each in (file, worlds))
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
                    shard.value(name, row, read_only=True)  # which must be there
            return report_of(spec, sums, size, shard.rejected(), shard.column(DIGEST).tobytes())
    except (BrokenError, OSError, KeyError, ValueError):
        return None


ARCHIVE = b"PK\x03\x04\x14\0\0\0\x08\0\0\0!\0"
"""How what `zip_reproducibly` makes begins."""


@lru_cache(maxsize=1)  # the shards of a large map all have the same
def zip_reproducibly(members: tuple[tuple[str, bytes], ...]) -> bytes:
    """A zip file whose bytes depend on its members alone."""
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for name, content in sorted(members):
            member = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            member.compress_type = zipfile.ZIP_DEFLATED
            member.create_system = 3
            member.external_attr = 0o644 << 16
            archive.writestr(member, content, compresslevel=6)
    return memory.getvalue()
