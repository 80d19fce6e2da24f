"""A dataset's samples, one after another, into a folder in another format; a stopped run goes on
where it was.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from scenegen.base.errors import DatasetError, printable, raised_as
from scenegen.base.executors import Counted, Executor, chunked, counted, unheard
from scenegen.base.files import claim, make_parent, remove_drafts, write_whole
from scenegen.base.workers import ALONE
from scenegen.convert import FORMATS, Choices
from scenegen.convert.formats import Classed, OneEach
from scenegen.dataset.read import AnyDataset, Rows
from scenegen.draw.sample import Sample

STATE = "convert.json"
"""What a folder was converted from, and how."""
CHUNK = 100
"""Samples a task of a worker, unless a format says how many share a file."""


@dataclass(frozen=True)
class Converted:
    """What a run did."""

    written: int
    there: int
    """Samples that an earlier run had written."""
    others: int
    """Samples that are left to other ranks."""
    broken: tuple[str, ...]
    """A line for each sample that could not be read."""
    notes: tuple[str, ...]
    """What a user should know of the samples that were written: a sentence each."""


def convert(
    dataset: AnyDataset,
    out: Path,
    *,
    to: str,
    choices: Choices,
    splits: Sequence[str],
    execute: Executor = ALONE,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
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
        execute: What does the work.
        on_start: Called with the number of samples when the work begins.
        on_done: Called with the number of samples done.

    Raises:
        DatasetError: There is no such format, `out` holds another conversion, or the disk refuses.
    """
    with raised_as(DatasetError):
        kind = FORMATS.find(to)
    form = kind(choices)
    manifests = [one.manifest for one in dataset.datasets]
    about = {
        "format": to,
        "choices": asdict(choices),
        "digest": dataset.digest,
        "shards": [shard.sha256 for one in manifests if not one.complete for shard in one.shards],
        "grid": manifests[0].tables.grid,
    }
    classes = {one.parts["labels"].classes for one in manifests if "labels" in one.parts}
    if len(classes) == 1 and isinstance(form, OneEach):
        about["classes"] = form.classes = tuple(*classes)
    claim(out, STATE, about)
    each = getattr(form, "together", None) or CHUNK
    whole = [
        Rows(split, numbers)
        for split in splits
        for numbers in chunked(range(len(dataset.split(split))), each)
    ]
    tasks = execute.mine(whole)
    total = sum(len(rows.numbers) for rows in tasks)
    there, broken = 0, dict[Rows, list[str]]()
    work = partial(_write, dataset, out, form)
    try:
        for rows, count, wrong in counted(
            execute,
            work,
            tasks,
            total=total,
            on_start=on_start,
            on_done=on_done,
            size=lambda result: len(result[0].numbers),
        ):
            there += count
            broken[rows] = wrong
    finally:
        for folder in out.glob("**/"):  # what killed runs have left
            remove_drafts(folder)
    lines = tuple(line for rows in tasks for line in broken[rows])
    others = sum(len(rows.numbers) for rows in whole) - total
    notes = form.notes() if isinstance(form, Classed) else []
    return Converted(total - there - len(lines), there, others, lines, tuple(notes))


def _write(dataset: AnyDataset, out: Path, form: Any, rows: Rows) -> tuple[Rows, int, list[str]]:
    """Writes the samples `rows`; those of a format that takes several together become one file.
    How many were there, and what is wrong with those that are left out."""
    samples, together = dataset.split(rows.split), getattr(form, "together", None)
    there, broken = 0, list[str]()
    for numbers in [rows.numbers] if together else ([number] for number in rows.numbers):
        paths = [out / name for name in form.names(rows.split, numbers[0])]
        left_out = paths[0].with_name(f"{paths[0].name}.left-out")
        if all(path.exists() for path in paths) and not left_out.exists():
            there += len(numbers)
            continue
        sensor = samples.home(numbers[0]).lidar
        chosen, lines = list[tuple[int, Sample]](), list[str]()
        for number in numbers:
            try:
                sample = samples[number]
                samples.check(number)
                if together:
                    copy(sample)  # reads every field, so that none fails among those of others
                else:
                    contents = form.encode(sample, dataset.grid, sensor)
                chosen.append((number, sample))
            except (DatasetError, ValueError) as error:
                lines.append(f"{rows.split} {number} is left out: {printable(error)}")
        broken += lines
        if not chosen:
            continue
        if together:
            contents = form.encode(chosen, dataset.grid, sensor)
        several = (contents,) if isinstance(contents, bytes) else contents
        files = dict(zip(paths, several, strict=True))
        if lines:  # before the others, so that the next run makes them again
            files = {left_out: "\n".join(lines).encode()} | files
        for path, content in files.items():
            make_parent(path)
            write_whole(path, content, sync=False)
        if not lines:
            left_out.unlink(missing_ok=True)
    return rows, there, broken
