"""Shards that are written elsewhere: what a job notes of its own, and what lies beside each in a
store."""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from scenegen.dataset.rules import DIGEST, LIST, REJECTED, check, checked, rules_of, whole
from scenegen.dataset.shard import ShardReport, ShardTask, read_report, report_of
from scenegen.dataset.trust import Entry
from scenegen.errors import DatasetError
from scenegen.files import Json, read_bounded, sha256_of, write_whole
from scenegen.limits import MOST_MANIFEST_BYTES, MOST_SAMPLES_IN_SHARD
from scenegen.stores import StorePath, Version

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
    """Delete them: the manifest lists everything. A store has none."""
    for path in () if isinstance(folder, StorePath) else folder.glob(NOTES):
        path.unlink(missing_ok=True)


SUFFIX = ".report.json"
AT_A_TIME = 16
"""Reports that are fetched at the same time."""
MOST_BYTES = 10_000 + 80 * MOST_SAMPLES_IN_SHARD
"""A report is no larger."""


def write_shard(spec: ShardTask) -> ShardReport:
    """Write a shard, whatever its samples come from, and at a place its report beside it. Pure but
    for its files. Raises GenerationError, DatasetError, StoreError."""
    report = spec.write()
    if isinstance(spec.folder, StorePath):
        _note(spec, report, [place.version for place in _places(spec)])
    return report


def look(
    there: Mapping[str, Version], tasks: Sequence[tuple[ShardTask, Entry | None]]
) -> Iterator[ShardReport | None]:
    """The reports of shards, each with what the manifest lists of it, at the place where objects
    are `there`, by their versions; None for one that is not as it should be.

    Objects that are those which a report beside them was written for are taken as they are: stores
    keep what they took. Any other shard is read, and removed where it is damaged. Raises
    StoreError.
    """

    def one(task: tuple[ShardTask, Entry | None]) -> ShardReport | None:
        spec, listed = task
        now = [there.get(name) for name in (spec.file, spec.worlds)]
        report = _noted(spec, now, there) if None not in now else None
        if report is None or (listed and report.sums != listed.sums):
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


def _places(spec: ShardTask) -> list[Any]:
    """Where its objects are, the samples, which commit it, first."""
    return [spec.folder / spec.file, spec.folder / spec.worlds]


def _said(spec: ShardTask, report: ShardReport, versions: Sequence[Version]) -> Json:
    """What stands in the report beside a shard whose objects are of these versions."""
    return {
        "parameters": spec.parameters,
        "versions": versions,
        **report.entry(),
        "size": report.size,
        "rejected": report.rejected,
        "digests": report.digests.hex(),
    }


def _note(spec: ShardTask, report: ShardReport, versions: Sequence[Version]) -> None:
    content = json.dumps(_said(spec, report, versions)).encode()
    assert isinstance(spec.folder, StorePath)
    spec.folder.store.put(_report_name(spec), content)


def _report_name(spec: ShardTask) -> str:
    return spec.file.removesuffix(".h5") + SUFFIX


def _noted(
    spec: ShardTask, now: Sequence[Version], there: Mapping[str, Version]
) -> ShardReport | None:
    """What the report beside a shard says, if it is of just these objects."""
    if (name := _report_name(spec)) not in there:
        return None
    with suppress(FileNotFoundError, DatasetError, ValueError, RecursionError, KeyError, TypeError):
        said = json.loads(read_bounded(spec.folder / name, MOST_BYTES))
        check(said, {**rules_of(Entry), "size": whole(0, sys.maxsize)}, "")
        check(said["rejected"], REJECTED, "")
        sums, digests = (said["sha256"], said["worlds_sha256"]), bytes.fromhex(said["digests"])
        report = report_of(spec, sums, said["size"], said["rejected"], digests)
        if said == _said(spec, report, now) and len(digests) == 32 * spec.samples:
            return report
    return None
