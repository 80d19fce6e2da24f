"""Shards as they are written and found again, in a folder or at a store: notes of jobs, and the
report beside each shard of a store."""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from scenegen.dataset.rules import DIGEST, LIST, REJECTED, check, checked, rules_of, whole
from scenegen.dataset.shard import ShardReport, ShardTask, read_report, relabel, report_of
from scenegen.dataset.trust import Entry
from scenegen.errors import DatasetError
from scenegen.files import Json, read_bounded, sha256_of, write_whole
from scenegen.limits import MOST_MANIFEST_BYTES, MOST_SAMPLES_IN_SHARD
from scenegen.stores import Place, Store

NOTES = f"dataset.part-{'[0-9a-f]' * 12}.json"
"""What they are called."""


def write_note(
    folder: Path, parameters: str, part: Sequence[str], reports: Sequence[ShardReport]
) -> None:
    """Write down the `reports` of a job that sees to the shards `part`, of the dataset whose
    parameters have the digest `parameters`."""
    name = sha256_of("\n".join(part).encode())[:12]
    shards = [report.entry() for report in reports]
    content = json.dumps({"parameters": parameters, "shards": shards})
    write_whole(folder / f"dataset.part-{name}.json", content.encode())


def read_notes(folder: Path, parameters: str) -> dict[str, Entry]:
    """All that jobs wrote down of this dataset's shards, by file. What is damaged counts as not
    there."""
    found: dict[str, Entry] = {}
    for path in folder.glob(NOTES):
        with suppress(OSError, ValueError, RecursionError, DatasetError):
            said = json.loads(read_bounded(path, MOST_MANIFEST_BYTES))
            check(said, {"parameters": DIGEST, "shards": LIST}, "")
            if said["parameters"] == parameters:
                entries = [Entry(**checked(Entry, entry, "")) for entry in said["shards"]]
                found |= {entry.file: entry for entry in entries}
    return found


def remove_notes(folder: Path) -> None:
    """Delete them: the manifest lists everything."""
    for path in folder.glob(NOTES):
        path.unlink(missing_ok=True)


SUFFIX = ".report.json"
AT_A_TIME = 16
"""Reports that are fetched at the same time."""
MAX_REPORT_BYTES = 10_000 + 80 * MOST_SAMPLES_IN_SHARD


def write_shard(place: Place, task: ShardTask) -> ShardReport:
    """Write a shard, whatever its samples come from; at a store, a report beside it. Pure but for
    its files.

    Raises GenerationError, DatasetError, StoreError.
    """
    report = task.write(place)
    if isinstance(place, Store):
        _put_report(place, task, report)
    return report


def report_at(place: Place, task: tuple[ShardTask, Entry | None]) -> ShardReport | None:
    """`read_report` of a shard in a folder or at a store, of which the files are fetched."""
    with _at_hand(place, task[0]) as folder:
        return read_report(folder, task)


def relabel_at(place: Place, task: ShardTask, old: str, listed: Entry) -> None:
    """`relabel` a shard in a folder or at a store."""
    with _at_hand(place, task) as folder:
        if relabel(folder, task, old, listed) and isinstance(place, Store):
            place.put(task.file, (folder / task.file).read_bytes())


def find_reports(
    store: Store, sizes: Mapping[str, int | None], tasks: Sequence[tuple[ShardTask, Entry | None]]
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

    def find(task: tuple[ShardTask, Entry | None]) -> ShardReport | None:
        spec, listed = task
        report = _read_report(store, spec, sizes)
        if report is not None and (listed is None or report.sums == listed.sums):
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
def _at_hand(place: Place, task: ShardTask) -> Iterator[Path]:
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


def _report_name(task: ShardTask) -> str:
    return task.file.removesuffix(".h5") + SUFFIX


def _report_document(task: ShardTask, report: ShardReport) -> Json:
    return {
        "parameters": task.parameters,
        **report.entry(),
        "size": report.size,
        "rejected": report.rejected,
        "digests": report.digests.hex(),
    }


def _put_report(store: Store, task: ShardTask, report: ShardReport) -> None:
    store.put(_report_name(task), json.dumps(_report_document(task, report)).encode())


def _read_report(
    store: Store, task: ShardTask, sizes: Mapping[str, int | None]
) -> ShardReport | None:
    """What the report beside a shard says, if it is of objects of these sizes."""
    if _report_name(task) not in sizes:
        return None
    with suppress(FileNotFoundError, DatasetError, ValueError, RecursionError, KeyError, TypeError):
        document = json.loads(store.read(_report_name(task), MAX_REPORT_BYTES))
        check(document, {**rules_of(Entry), "size": whole(0, sys.maxsize)}, "")
        check(document["rejected"], REJECTED, "")
        sums = document["sha256"], document["worlds_sha256"]
        digests, size = bytes.fromhex(document["digests"]), document["size"]
        report = report_of(task, sums, size, document["rejected"], digests)
        stored = sum(sizes.get(name) or 0 for name in (task.file, task.worlds))
        if (
            document == _report_document(task, report)
            and len(digests) == 32 * task.samples
            and size == stored
        ):
            return report
    return None
