"""Shards that are written elsewhere: what a job notes of its own, and what lies beside each in a
store."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from scenegen.dataset.schema import ShardEntry
from scenegen.dataset.shard import ShardReport, ShardSpec, read_report, report_of
from scenegen.errors import DatasetError
from scenegen.files import read_bounded, sha256_of, write_whole
from scenegen.limits import MOST_MANIFEST_BYTES, MOST_SAMPLES_IN_SHARD
from scenegen.stores import StorePath, Version

NOTES = f"dataset.part-{'[0-9a-f]' * 12}.json"
"""What they are called."""


class Note(msgspec.Struct):
    """What a job wrote of a dataset."""

    parameters: str
    """The dataset's fingerprint."""
    shards: list[ShardEntry]


def write_note(
    folder: Path, parameters: str, part: Sequence[str], reports: Sequence[ShardReport]
) -> None:
    """Write down the `reports` of a job that sees to the shards `part`, of the dataset whose
    parameters have the digest `parameters`."""
    name = sha256_of("\n".join(part).encode())[:12]
    note = Note(parameters=parameters, shards=[report.entry for report in reports])
    content = msgspec.json.encode(note)
    write_whole(folder / f"dataset.part-{name}.json", content)


def read_notes(folder: Path, parameters: str) -> dict[str, ShardEntry]:
    """All that jobs wrote down of this dataset's shards, by file. What is damaged counts as not
    there."""
    entries: dict[str, ShardEntry] = {}
    for path in folder.glob(NOTES):
        with suppress(OSError, msgspec.MsgspecError, RecursionError, DatasetError):
            note = msgspec.json.decode(read_bounded(path, MOST_MANIFEST_BYTES), type=Note)
            if note.parameters == parameters:
                entries |= {entry.file: entry for entry in note.shards}
    return entries


def remove_notes(folder: Path) -> None:
    """Delete them: the manifest lists everything. A store has none."""
    for path in () if isinstance(folder, StorePath) else folder.glob(NOTES):
        path.unlink(missing_ok=True)


SUFFIX = ".report.json"
AT_A_TIME = 16
"""Reports that are fetched at the same time."""
MOST_BYTES = 10_000 + 80 * MOST_SAMPLES_IN_SHARD
"""A report is no larger."""


def write_shard(spec: ShardSpec) -> ShardReport:
    """Write a shard, whatever its samples come from, and at a place its report beside it. Pure but
    for its files. Raises GenerationError, DatasetError, StoreError."""
    report = spec.write()
    if isinstance(spec.folder, StorePath):
        _note(spec, report, [place.version for place in _places(spec)])
    return report


def look(
    there: Mapping[str, Version], tasks: Sequence[tuple[ShardSpec, ShardEntry | None]]
) -> Iterator[ShardReport | None]:
    """The reports of shards, each with what the manifest lists of it, at the place where objects
    are `there`, by their versions; None for one that is not as it should be.

    Objects that are those which a report beside them was written for are taken as they are: stores
    keep what they took. Any other shard is read, and removed where it is damaged. Raises
    StoreError.
    """

    def one(task: tuple[ShardSpec, ShardEntry | None]) -> ShardReport | None:
        spec, listed = task
        now = [there.get(name) for name in (spec.file, spec.worlds)]
        report = _noted(spec, now, there) if None not in now else None
        if report is None or (listed and report.entry.sums != listed.sums):
            report = read_report(task)
            if report is None:
                for place in _places(spec):
                    place.unlink(missing_ok=True)
            else:
                _note(spec, report, now)
        return report

    from concurrent.futures import ThreadPoolExecutor  # importing it takes time

    with ThreadPoolExecutor(AT_A_TIME) as pool:
        yield from pool.map(one, tasks)


def _places(spec: ShardSpec) -> list[Any]:
    """Where its objects are, the samples, which commit it, first."""
    return [spec.folder / spec.file, spec.folder / spec.worlds]


class PlacedReport(msgspec.Struct, forbid_unknown_fields=True):
    """The report beside a shard."""

    parameters: str
    versions: list[Version]
    entry: ShardEntry
    size: int
    rejected: dict[str, dict[str, int]]
    digests: str

    def report(self) -> ShardReport:
        """What it says of the shard."""
        return ShardReport(
            entry=self.entry,
            size=self.size,
            rejected={what: Counter(counts) for what, counts in self.rejected.items()},
            digests=bytes.fromhex(self.digests),
        )


def _note(spec: ShardSpec, report: ShardReport, versions: Sequence[Version]) -> None:
    placed = PlacedReport(
        parameters=spec.parameters,
        versions=list(versions),
        entry=report.entry,
        size=report.size,
        rejected={what: dict(counts) for what, counts in report.rejected.items()},
        digests=report.digests.hex(),
    )
    assert isinstance(spec.folder, StorePath)
    spec.folder.store.put(_report_name(spec), msgspec.json.encode(placed))


def _report_name(spec: ShardSpec) -> str:
    return spec.file.removesuffix(".h5") + SUFFIX


def _noted(
    spec: ShardSpec, now: Sequence[Version], there: Mapping[str, Version]
) -> ShardReport | None:
    """What the report beside a shard says, if it is of just these objects."""
    if (name := _report_name(spec)) not in there:
        return None
    with suppress(FileNotFoundError, DatasetError, ValueError, RecursionError):
        content = read_bounded(spec.folder / name, MOST_BYTES)
        placed = msgspec.json.decode(content, type=PlacedReport)
        report = placed.report()
        if (
            placed.parameters == spec.parameters
            and placed.versions == list(now)
            and placed.entry == report_of(spec, placed.entry.sums, 0, {}, b"").entry
            and len(report.digests) == 32 * spec.samples
        ):
            return report
    return None
