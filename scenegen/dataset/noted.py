"""What a job that sees to a part of the shards writes down of them: the one that completes the
dataset then need not read their samples. Such a file is trusted as far as the manifest is: whoever
reads it holds the shards' files against the digests in it."""

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path

from scenegen.dataset.rules import DIGEST, LIST, check, checked
from scenegen.dataset.shard import ShardReport
from scenegen.dataset.trust import Entry
from scenegen.errors import BrokenError, DatasetError
from scenegen.files import read_bounded, write_whole
from scenegen.limits import MOST_MANIFEST_BYTES

NOTES = f"dataset.part-{'[0-9a-f]' * 12}.json"
"""What they are called."""


def write_note(
    folder: Path, parameters: str, part: Sequence[Path], reports: Sequence[ShardReport]
) -> None:
    """Write down the `reports` of a job that sees to the shards `part`, of the dataset whose
    parameters have the digest `parameters`."""
    name = hashlib.sha256("\n".join(path.name for path in part).encode()).hexdigest()[:12]
    shards = [
        {item.name: getattr(report, item.name) for item in fields(Entry)} for report in reports
    ]
    content = json.dumps({"parameters": parameters, "shards": shards}, indent=1) + "\n"
    write_whole(folder / f"dataset.part-{name}.json", content.encode())


def read_notes(folder: Path, parameters: str) -> dict[str, Entry]:
    """All that jobs wrote down of this dataset's shards, by file. What is damaged counts as not
    there."""
    found: dict[str, Entry] = {}
    for path in folder.glob(NOTES):
        with suppress(OSError, ValueError, RecursionError, BrokenError, DatasetError):
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
