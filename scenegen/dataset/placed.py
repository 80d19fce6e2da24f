"""Shards as they are written and found again, in a folder or at a store: notes of jobs, and the
report beside each shard of a store."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from scenegen.base.errors import DatasetError
from scenegen.base.files import read_bounded, sha256_of, write_whole
from scenegen.base.limits import MOST_MANIFEST_BYTES, MOST_SAMPLES_IN_SHARD
from scenegen.base.stores import Place, Store
from scenegen.dataset.schema import ShardEntry
from scenegen.dataset.shard import ShardReport, ShardSpec, read_report, report_of

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
    fingerprint is `parameters`."""
    name = sha256_of("\n".join(part).encode())[:12]
    note = Note(parameters=parameters, shards=[report.entry for report in reports])
    write_whole(folder / f"dataset.part-{name}.json", msgspec.json.encode(note))


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
    """Delete them: the manifest lists everything."""
    for path in folder.glob(NOTES):
        path.unlink(missing_ok=True)


SUFFIX = ".report.json"
AT_A_TIME = 16
"""Reports that are fetched at the same time."""
MAX_REPORT_BYTES = 10_000 + 80 * MOST_SAMPLES_IN_SHARD


class PlacedReport(msgspec.Struct, forbid_unknown_fields=True):
    """The report beside a shard of a store."""

    parameters: str
    """The dataset's fingerprint."""
    entry: ShardEntry
    size: int
    """Bytes of both objects."""
    rejected: dict[str, dict[str, int]]
    digests: str
    """The samples' own SHA-256s, in hexadecimal."""


def write_shard(place: Place, task: ShardSpec) -> ShardReport:
    """Write a shard; at a store, a report beside it. Pure but for its files.

    Raises GenerationError, DatasetError, StoreError.
    """
    report = task.write(place)
    if isinstance(place, Store):
        _put_report(place, task, report)
    return report


def report_at(place: Place, task: tuple[ShardSpec, ShardEntry | None]) -> ShardReport | None:
    """`read_report` of a shard in a folder or at a store, of which the files are fetched."""
    with _at_hand(place, task[0]) as folder:
        return read_report(folder, task)


def find_reports(
    store: Store,
    sizes: Mapping[str, int | None],
    tasks: Sequence[tuple[ShardSpec, ShardEntry | None]],
) -> Iterator[ShardReport | None]:
    """Reports of shards at a store, in order; None for one that is not as it should be.

    A shard is not fetched if the report beside it is of objects of these sizes: stores keep what
    they took. Any other is read, and removed if it is damaged.

    Args:
        store: Where the shards are.
        sizes: Bytes of all objects by name.
        tasks: Shards, each with its entry in the manifest, if it is listed.

    Raises:
        StoreError: The store does not answer. Nothing is removed then.
    """

    def find(task: tuple[ShardSpec, ShardEntry | None]) -> ShardReport | None:
        spec, listed = task
        report = _read_report(store, spec, sizes)
        if report is not None and (listed is None or report.entry.sums == listed.sums):
            return report
        if (report := report_at(store, task)) is None:
            for name in (spec.file, spec.worlds):
                store.remove(name)
        else:
            _put_report(store, spec, report)
        return report

    from concurrent.futures import ThreadPoolExecutor  # importing it takes time

    with ThreadPoolExecutor(AT_A_TIME) as pool:
        yield from pool.map(find, tasks)


@contextmanager
def _at_hand(place: Place, task: ShardSpec) -> Iterator[Path]:
    """A folder of this machine with a shard's files, as far as there are any."""
    if isinstance(place, Path):
        yield place
        return
    with TemporaryDirectory(prefix="scenegen-") as name:
        folder = Path(name)
        (folder / task.file).parent.mkdir(exist_ok=True)
        with suppress(FileNotFoundError):
            for file in (task.file, task.worlds):
                place.fetch(file, folder / file)
        yield folder


def _report_name(task: ShardSpec) -> str:
    return task.file.removesuffix(".h5") + SUFFIX


def _put_report(store: Store, task: ShardSpec, report: ShardReport) -> None:
    placed = PlacedReport(
        parameters=task.parameters,
        entry=report.entry,
        size=report.size,
        rejected={what: dict(counts) for what, counts in report.rejected.items()},
        digests=report.digests.hex(),
    )
    store.put(_report_name(task), msgspec.json.encode(placed))


def _read_report(
    store: Store, task: ShardSpec, sizes: Mapping[str, int | None]
) -> ShardReport | None:
    """What the report beside a shard says, if it is of objects of these sizes."""
    if _report_name(task) not in sizes:
        return None
    with suppress(FileNotFoundError, DatasetError, ValueError, RecursionError):
        content = store.read(_report_name(task), MAX_REPORT_BYTES)
        placed = msgspec.json.decode(content, type=PlacedReport)
        rejected = {what: Counter(counts) for what, counts in placed.rejected.items()}
        digests = bytes.fromhex(placed.digests)
        report = report_of(task, placed.entry.sums, placed.size, rejected, digests)
        stored = sum(sizes.get(name) or 0 for name in (task.file, task.worlds))
        if (
            (placed.parameters, placed.entry) == (task.parameters, report.entry)
            and len(digests) == 32 * task.samples
            and placed.size == stored
        ):
            return report
    return None
