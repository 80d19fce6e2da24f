"""A shard of samples that are there: another dataset's shard, whole, or some rows of it. No sample
changes a bit."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any

from scenegen.dataset.archive import open_archive
from scenegen.dataset.layout import DIGEST, Layout, ShardFile, check_sum, open_file, open_shard
from scenegen.dataset.shard import ShardReport, ShardTask, put, read_report
from scenegen.dataset.trust import Entry
from scenegen.draw import Rejections
from scenegen.errors import BrokenError, DatasetError
from scenegen.files import write_whole


@dataclass(frozen=True, kw_only=True)
class Part(ShardTask):
    """A shard that is a part of one that is there."""

    there: Path
    """The folder of the dataset that it is of."""
    entry: Entry
    """The shard, as that dataset's manifest lists it."""
    format: Layout
    """What it holds."""
    rows: tuple[int, ...] | None = None
    """The samples that are taken, in order; None for all."""
    source: int
    """The place, among the new manifest's `sources`, of the dataset that the samples were made
    for."""
    start: int
    stop: int
    """The places there of the first and of one beyond the last sample."""
    of_worlds: Sequence[int]
    """Numbers there of the worlds of which the samples are, rising."""

    @property
    def layout(self) -> Layout:
        """See `ShardTask`."""
        return self.format

    @property
    def numbers(self) -> Sequence[int]:
        """See `ShardTask`."""
        return self.of_worlds

    @property
    def more(self) -> Mapping[str, int]:
        """See `ShardTask`."""
        return {"source": self.source, "start": self.start, "stop": self.stop}

    def write(self) -> ShardReport:
        """See `ShardTask`. Raises DatasetError where the shard there is no longer what its manifest
        lists, or a sample that is taken has not its digest."""
        path = self.there / self.entry.file
        try:
            with (
                open_file(self.there / self.entry.worlds) as worlds,
                open_file(path) as file,
            ):
                check_sum(worlds, self.entry.worlds, self.entry.worlds_sha256)
                check_sum(file, self.entry.file, self.entry.sha256)
                shard = open_shard(file, path, self.entry.samples, self.format)
                shard.check_origin(
                    split=self.split,
                    worlds_sha256=self.entry.worlds_sha256,
                    parameters=self.parameters,
                )
                for row in range(self.entry.samples) if self.rows is None else self.rows:
                    shard.check(row)
                return (
                    self._copy(worlds, file)
                    if self.rows is None
                    else self._repack(worlds, shard, self.rows)
                )
        except BrokenError as error:
            raise DatasetError(
                f"{self.there}/{error}; verify the dataset, or copy it again"
            ) from None

    def _copy(self, *files: BufferedReader) -> ShardReport:
        """The same files under other names: the worlds first, then the samples, which commit
        them."""
        for file, target in zip(files, (self.worlds_file, self.file), strict=True):
            file.seek(0)
            write_whole(target, file.read())
        report = read_report(self, self.entry)
        if report is None:
            raise BrokenError(f"{self.entry.file}: is not the shard that its manifest describes")
        return report

    def _repack(
        self, worlds: BufferedReader, shard: ShardFile, rows: tuple[int, ...]
    ) -> ShardReport:
        """The `rows` packed anew, and the worlds that they are of."""
        documents = dict[str, bytes]()
        with open_archive(worlds, self.entry.worlds) as members:
            for member in (f"{number:06d}.xml" for number in self.of_worlds):
                if member not in members:
                    raise BrokenError(f"{self.entry.worlds}: has no member {member}")
                document, others = members.world(member)
                documents |= {member: document, **others}

        def stored() -> Iterator[tuple[Callable[[str], Any], bytes]]:
            for row in rows:
                yield partial(shard.value, row=row), shard.value(DIGEST, row).tobytes()

        # what was rejected on the way to the whole shard cannot be told apart; the source's own
        # manifest has it
        return put(self, stored(), documents, Rejections())
