"""A dataset's samples, one after another, into a folder in another format; a stopped run goes on
where it was."""

import dataclasses
import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from scenegen.dataset.read import Dataset, Rows, Split
from scenegen.display.exchange import FORMATS, Choices
from scenegen.errors import DatasetError, printable
from scenegen.files import make_parent, remove_drafts, write_whole
from scenegen.run import Counted, Executor, unheard
from scenegen.run.workers import ALONE
from scenegen.sample import Sample

STATE = "convert.json"
"""What a folder was converted from, and how."""
CHUNK = 100
"""Samples a task of a worker, unless a format says how many share a file."""


@dataclass(frozen=True)
class Converted:
    """What a run did, or a part of it."""

    written: int
    there: int
    """Samples that an earlier run had written."""
    others: int
    """Samples that are left to other ranks."""
    broken: tuple[str, ...]
    """A line for each sample that could not be read."""


def convert(
    dataset: Dataset,
    out: Path,
    *,
    to: str,
    choices: Choices,
    splits: Sequence[str],
    execute: Executor = ALONE,
    on_start: Counted = unheard,
    on_sample: Counted = unheard,
) -> Converted:
    """Writes every sample of some splits in another format.

    What is there already is passed over. Each file appears whole or not at all; the disk is trusted
    to keep it, unlike a dataset's.

    Args:
        dataset: What is converted.
        out: The folder to write.
        to: Name of a format, or MODULE:CLASS.
        choices: What the format is told.
        splits: Names of the splits.
        execute: What does the work; this process alone unless given.
        on_start: Called with the number of samples when the work begins.
        on_sample: Called with the number of samples done, now and then.

    Raises:
        DatasetError: `out` holds another conversion, or the disk refuses.
    """
    form = FORMATS.find(to)(choices)
    _claim(dataset, out, to, choices)
    each = getattr(form, "together", None) or CHUNK
    whole = [
        Rows(split, range(first, min(first + each, count)))
        for split, count in ((split, len(dataset.split(split))) for split in splits)
        for first in range(0, count, each)
    ]
    tasks = execute.mine(whole)
    total = sum(len(rows.numbers) for rows in tasks)
    parts: dict[Rows, Converted] = {}
    work = partial(_write, dataset, out, form)
    try:
        with closing(execute(work, tasks, lambda: on_start(total))) as results:
            for rows, done in results:
                parts[rows] = done
                on_sample(len(rows.numbers))
    finally:
        for folder in out.glob("**/"):  # what killed runs have left
            remove_drafts(folder)
    found = [parts[rows] for rows in tasks]
    return Converted(
        written=sum(part.written for part in found),
        there=sum(part.there for part in found),
        others=sum(len(rows.numbers) for rows in whole) - total,
        broken=tuple(line for part in found for line in part.broken),
    )


def _write(dataset: Dataset, out: Path, form: Any, rows: Rows) -> tuple[Rows, Converted]:
    """Writes the samples `rows`; those of a format that takes several together become one file."""
    samples, together = dataset.split(rows.split), bool(getattr(form, "together", None))
    written, there, broken = 0, 0, list[str]()
    for numbers in [rows.numbers] if together else ([number] for number in rows.numbers):
        paths = [out / name for name in form.names(rows.split, numbers[0])]
        if all(path.exists() for path in paths):
            there += len(numbers)
            continue
        found, lines = _sound(samples, numbers)
        broken += lines
        if not found:
            continue
        given: Any = list(found.items()) if together else found[numbers[0]]
        try:
            sensor = samples.home(numbers[0]).lidar
            contents = form.encode(given, dataset.grid, sensor)
        except (DatasetError, ValueError) as error:
            broken += [f"{rows.split} {number} is left out: {printable(error)}" for number in found]
            continue
        several = (contents,) if isinstance(contents, bytes) else contents
        for path, content in zip(paths, several, strict=True):
            make_parent(path)
            write_whole(path, content, sync=False)
        written += len(found)
    return rows, Converted(written, there, 0, tuple(broken))


def _sound(samples: Split, numbers: Sequence[int]) -> tuple[dict[int, Sample], list[str]]:
    """Samples by number, and a line for each that cannot be read or does not have its digest."""
    found, lines = dict[int, Sample](), list[str]()
    for number in numbers:
        try:
            sample = samples[number]
            samples.check(number)  # which reads every stored field
            found[number] = sample
        except (DatasetError, ValueError) as error:
            lines.append(f"{samples.name} {number} is left out: {printable(error)}")
    return found, lines


def _claim(dataset: Dataset, out: Path, to: str, choices: Choices) -> None:
    """Says in `out` what it holds. Raises DatasetError where it holds something else."""
    manifest = dataset.manifest
    about = {
        "format": to,
        "choices": dataclasses.asdict(choices),
        "dataset": manifest.fingerprint,
        "digest": manifest.digest,
        "grid": manifest.parameters["grid"],
    }
    content = json.dumps(about, indent=1).encode()
    state = out / STATE
    # listed first: what another rank begins meanwhile, it begins with the state
    there = list(out.iterdir()) if out.is_dir() else [out] if out.exists() else []
    if state.exists():
        if state.read_bytes() == content:
            return
        raise DatasetError(f"{out}: holds another conversion; choose another folder")
    if any(path.suffix != ".tmp" for path in there):
        raise DatasetError(f"{out}: is there, and no conversion of ours; choose another folder")
    make_parent(state)
    write_whole(state, content)
