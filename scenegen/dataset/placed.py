"""Shards in a folder or at a store: written, and found again by notes of jobs or by reports beside
shards."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from scenegen.base.errors import DatasetError
from scenegen.base.files import write_atomic
from scenegen.base.limits import MAX_MANIFEST_BYTES, MAX_SAMPLES_IN_SHARD
from scenegen.base.reading import read_bounded, sha256_of
from scenegen.base.stores import Location, Store
from scenegen.dataset.schema import ShardEntry
from scenegen.dataset.shard import ShardReport, ShardSpec, read_report, report_of

NOTES = f"dataset.part-{'[0-9a-f]' * 12}.json"
"""Names of notes."""


class Note(msgspec.Struct):
    """Shards that one job wrote."""

    parameters: str
    """Fingerprint of the dataset."""
    shards: list[ShardEntry]


def write_note(
    folder: Path, parameters: str, part: Sequence[str], reports: Sequence[ShardReport]
) -> None:
    """Record the shards of a job.

    Args:
        folder: Folder of the dataset.
        parameters: Fingerprint of the dataset.
        part: Files of all shards of the job; they determine the name of the note.
        reports: Reports of the finished shards.
    """
    # by its shards: the same job finds its note again, and jobs do not share one
    name = sha256_of("\n".join(part).encode())[:12]
    note = Note(parameters=parameters, shards=[report.entry for report in reports])
    write_atomic(folder / f"dataset.part-{name}.json", msgspec.json.encode(note))


def read_notes(folder: Path, parameters: str) -> dict[str, ShardEntry]:
    """Read the notes of all jobs. Damaged notes are ignored.

    Args:
        folder: Folder of the dataset.
        parameters: Fingerprint of the dataset. Notes of others are ignored.

    Returns:
        Entries of finished shards, by file.
    """
    entries: dict[str, ShardEntry] = {}
    for path in folder.glob(NOTES):
        # a damaged note only costs time: its shards are examined again
        with suppress(OSError, msgspec.MsgspecError, RecursionError, DatasetError):
            note = msgspec.json.decode(read_bounded(path, MAX_MANIFEST_BYTES), type=Note)
            if note.parameters == parameters:
                entries |= {entry.file: entry for entry in note.shards}
    return entries


def remove_notes(folder: Path) -> None:
    """Delete all notes, once the manifest lists every shard."""
    for path in folder.glob(NOTES):
        path.unlink(missing_ok=True)


SUFFIX = ".report.json"
AT_A_TIME = 16
"""Number of concurrent requests."""
# 64 hexadecimal digits a sample, with room for quotes and escapes
MAX_REPORT_BYTES = 10_000 + 80 * MAX_SAMPLES_IN_SHARD


class PlacedReport(msgspec.Struct, forbid_unknown_fields=True):
    """Report beside a shard at a store."""

    parameters: str
    """Fingerprint of the dataset."""
    entry: ShardEntry
    size: int
    """Size of both objects, bytes."""
    rejected: dict[str, dict[str, int]]
    digests: str
    """SHA-256 of the samples, in hexadecimal."""


def write_shard(location: Location, task: ShardSpec) -> ShardReport:
    """Write a shard; at a store, also a report.

    Args:
        location: Location of the dataset.
        task: The shard.

    Raises:
        GenerationError: if a sample cannot be drawn.
        DatasetError: if the folder cannot be written.
        StoreError: if the store cannot be written.
    """
    report = task.write(location)
    if isinstance(location, Store):
        # last, so that no report tells of objects that are not there
        _put_report(location, task, report)
    return report


def report_at(location: Location, task: tuple[ShardSpec, ShardEntry | None]) -> ShardReport | None:
    """Read the report of a shard; see `read_report`. Files at a store are fetched.

    Args:
        location: Location of the dataset.
        task: The shard, and its entry in the manifest, if it has one.

    Returns:
        The report; None if there is no such shard, or it is damaged.
    """
    with _at_hand(location, task[0]) as folder:
        return read_report(folder, task)


def find_reports(
    store: Store,
    sizes: Mapping[str, int | None],
    tasks: Sequence[tuple[ShardSpec, ShardEntry | None]],
) -> Iterator[ShardReport | None]:
    """Yield reports of shards at a store, in order; None for a shard that is damaged.

    A shard is not fetched if a report beside it has the same sizes, as stores keep what they
    accepted. Other shards are read, and removed if they are damaged.

    Args:
        store: The store.
        sizes: Sizes of all objects, bytes, by name.
        tasks: Shards, each with its entry in the manifest, if it has one.

    Raises:
        StoreError: if the store does not answer. Nothing is removed then.
    """

    def find(task: tuple[ShardSpec, ShardEntry | None]) -> ShardReport | None:
        spec, listed = task
        report = _read_report(store, spec, sizes)
        if report is not None and (listed is None or report.entry.sums == listed.sums):
            return report
        if (report := report_at(store, task)) is None:
            # a damaged shard must go: `Store.create` refuses to replace it by other bytes
            for name in (spec.file, spec.worlds):
                store.remove(name)
        else:
            _put_report(store, spec, report)
        return report

    from concurrent.futures import ThreadPoolExecutor  # importing it takes time

    with ThreadPoolExecutor(AT_A_TIME) as pool:
        yield from pool.map(find, tasks)


@contextmanager
def _at_hand(location: Location, task: ShardSpec) -> Iterator[Path]:
    """Give a local folder with the files of a shard, as far as they exist."""
    if isinstance(location, Path):
        yield location
        return
    with TemporaryDirectory(prefix="scenegen-") as name:
        folder = Path(name)
        (folder / task.file).parent.mkdir(exist_ok=True)
        with suppress(FileNotFoundError):
            for file in (task.file, task.worlds):
                location.fetch(file, folder / file)
        yield folder


def _report_name(task: ShardSpec) -> str:
    return task.file.removesuffix(".h5") + SUFFIX


def _put_report(store: Store, task: ShardSpec, report: ShardReport) -> None:
    placed = PlacedReport(
        parameters=task.parameters,
        entry=report.entry,
        size=report.size,
        rejected={subject: dict(counts) for subject, counts in report.rejected.items()},
        digests=report.digests.hex(),
    )
    # without a condition: it follows from its shard, so whoever wrote it said the same
    store.put(_report_name(task), msgspec.json.encode(placed))


def _read_report(
    store: Store, task: ShardSpec, sizes: Mapping[str, int | None]
) -> ShardReport | None:
    """Read the report beside a shard; None if it does not fit the shard or the sizes of its
    objects."""
    if _report_name(task) not in sizes:
        return None
    with suppress(FileNotFoundError, DatasetError, ValueError, RecursionError):
        content = store.read(_report_name(task), MAX_REPORT_BYTES)
        placed = msgspec.json.decode(content, type=PlacedReport)
        rejected = {subject: Counter(counts) for subject, counts in placed.rejected.items()}
        digests = bytes.fromhex(placed.digests)
        report = report_of(task, placed.entry.sums, placed.size, rejected, digests)
        # it may be an earlier dataset's, or of objects that were put anew since
        stored = sum(sizes.get(name) or 0 for name in (task.file, task.worlds))
        if (
            (placed.parameters, placed.entry) == (task.parameters, report.entry)
            and len(digests) == 32 * task.samples
            and placed.size == stored
        ):
            return report
    return None
