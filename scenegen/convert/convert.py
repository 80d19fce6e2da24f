"""Writes the samples of a dataset into a folder in another format. The same call continues a
stopped run.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from scenegen.base.errors import DatasetError, printable, reraise_as
from scenegen.base.executors import Counted, Executor, chunked, counted, unheard
from scenegen.base.files import claim, make_parent, remove_temp_files, write_atomic
from scenegen.base.workers import ALONE
from scenegen.convert import FORMATS, Choices
from scenegen.convert.formats import FUTURE_S, OneEach, SemanticFormat
from scenegen.dataset.read import AnyDataset, Rows
from scenegen.draw.sample import Sample

STATE = "convert.json"
"""File that names the source and the parameters of a conversion."""
CHUNK = 100
"""Samples in a task of a worker, unless the format sets how many share a file."""


@dataclass(frozen=True)
class Converted:
    """Result of a run."""

    written: int
    """Samples that this run wrote."""
    existing: int
    """Samples that an earlier run wrote."""
    of_other_ranks: int
    """Samples that other ranks write."""
    broken: tuple[str, ...]
    """A line for each sample that could not be read."""
    notes: tuple[str, ...]
    """Remarks on the written samples, a sentence each."""


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
    """Write every sample of some splits in another format.

    Files that exist are not written again. Each file appears complete or not at all, but is not
    synced to disk: unlike a dataset, a conversion can be made again.

    Args:
        dataset: The dataset, collection or selection.
        out: The folder to write.
        to: Name of a format, or MODULE:CLASS.
        choices: Parameters of the format.
        splits: Names of the splits.
        execute: Executor of the work.
        on_start: Called with the number of samples when the work begins.
        on_done: Called with the number of samples done, after each task.

    Returns:
        Counts of samples, lines for samples that could not be read, and notes.

    Raises:
        DatasetError: There is no such format, the dataset has no movers to tell the future of,
            `out` holds another conversion, or the disk fails.
    """
    with reraise_as(DatasetError):
        kind = FORMATS.find(to)
    form = kind(choices)
    manifests = [part.manifest for part in dataset.datasets]
    if choices.future and min(one.schema.after_s for one in manifests) < FUTURE_S[-1]:
        raise DatasetError(
            f"{dataset.name}: --future needs courses of movers for {FUTURE_S[-1]} s after each "
            "sample; generate it with --movers, and with a longer movers.after_s"
        )
    state = {
        "format": to,
        "choices": asdict(choices),
        "digest": dataset.digest,
        # an incomplete dataset has no digest yet: its shards tell its state
        "shards": [
            shard.sha256
            for manifest in manifests
            if not manifest.complete
            for shard in manifest.shards
        ],
        "grid": manifests[0].tables.grid,
    }
    classes = {
        manifest.parts["labels"].classes for manifest in manifests if "labels" in manifest.parts
    }
    if len(classes) == 1 and isinstance(form, OneEach):
        state["classes"] = form.classes = tuple(*classes)
    # refuses a folder of another dataset or other parameters, whose files would be kept
    claim(out, STATE, state)
    chunk = getattr(form, "together", None) or CHUNK
    whole = [
        Rows(split, numbers)
        for split in splits
        for numbers in chunked(range(len(dataset.split(split))), chunk)
    ]
    tasks = execute.mine(whole)
    total = sum(len(rows.numbers) for rows in tasks)
    existing, broken = 0, dict[Rows, list[str]]()
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
            existing += count
            broken[rows] = wrong
    finally:
        for folder in out.glob("**/"):  # temporary files of killed runs
            remove_temp_files(folder)
    # in the order of samples, however workers finished
    lines = tuple(line for rows in tasks for line in broken[rows])
    remaining = sum(len(rows.numbers) for rows in whole) - total
    notes = form.notes() if isinstance(form, SemanticFormat) else []
    return Converted(total - existing - len(lines), existing, remaining, lines, tuple(notes))


def _write(dataset: AnyDataset, out: Path, form: Any, rows: Rows) -> tuple[Rows, int, list[str]]:
    """Write samples, those of a format with `together` into one file. Return the rows, how many
    samples existed, and a line for each sample that was left out."""
    samples, together = dataset.split(rows.split), getattr(form, "together", None)
    existing, broken = 0, list[str]()
    for numbers in [rows.numbers] if together else ([number] for number in rows.numbers):
        paths = [out / name for name in form.names(rows.split, numbers[0])]
        left_out = paths[0].with_name(f"{paths[0].name}.left-out")
        if all(path.exists() for path in paths) and not left_out.exists():
            existing += len(numbers)
            continue
        # datasets of a collection may have different sensors
        sensor = samples.home(numbers[0]).lidar
        chosen, lines = list[tuple[int, Sample]](), list[str]()
        for number in numbers:
            try:
                sample = samples[number]
                # what can be read may still differ from its digest
                samples.check(number)
                if together:
                    copy(
                        sample
                    )  # reads every field: a damaged sample must not spoil the others' file
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
        if lines:  # written first: while it exists, a later run writes the files again
            files = {left_out: "\n".join(lines).encode()} | files
        for path, content in files.items():
            make_parent(path)
            write_atomic(path, content, sync=False)
        if not lines:
            left_out.unlink(missing_ok=True)
    return rows, existing, broken
