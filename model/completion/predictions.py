"""Completions of a whole split of a dataset, in a folder of files."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scenegen.base.errors import DatasetError, empty_split, reraise_as
from scenegen.base.executors import Counted, Executor, chunked, counted, unheard
from scenegen.base.files import claim, make_parent
from scenegen.base.workers import ALONE
from scenegen.dataset.read import AnyDataset, Split
from scenegen.dataset.schema import stem_of
from scenegen.draw.sample import rng_of
from scenegen.model.completion.completer import Completer, opened_once
from scenegen.model.completion.stored import (
    DIGEST,
    SAMPLES,
    WHO,
    about_others,
    check_file,
    digest_of,
    new_hdf5,
    read_guarded,
    sample_digest,
    write_map,
)
from scenegen.model.config import PREDICTIONS
from scenegen.model.inputs import channels

PART = 100
"""Samples in a file, which is the unit of work, of writing and of recovery, as a shard is."""
PredictionTask = tuple[str, Sequence[int]]
"""The name of a file, and the samples whose predictions it holds, by their numbers."""


class SplitReport(NamedTuple):
    """Result of completing a split."""

    away: list[float]
    """How unfamiliar each sample is that was completed now (`Prediction.away`); [] if unknown."""
    damaged: list[str]
    """Names of existing files that were damaged, and were made again."""


def predict_split(
    completer: Completer,
    dataset: AnyDataset,
    split: str,
    out: Path,
    *,
    execute: Executor | None = None,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
) -> SplitReport:
    """Complete every sample of a split into a folder of predictions.

    The files are named as shards are, and hold `PART` samples each. They are written whole or not
    at all. Those that exist as they were written are kept, so a stopped run continues.

    Args:
        completer: The network.
        dataset: The dataset.
        split: Name of the split.
        out: The folder.
        execute: Does the work, on one thread a process; None: this process does.
        on_start: Called with the number of samples once the work has begun.
        on_done: Called with the number of samples of each part that is written.

    Returns:
        How unfamiliar the samples are, and the files that were made again.

    Raises:
        DatasetError: The grid differs, the split is empty, the disk refuses, or `out` is something
            else already.
    """
    with reraise_as(DatasetError, f"{dataset.name}: "):
        completer.check_grid(dataset.grid)
    samples = dataset.split(split)
    if not (count := len(samples)):
        raise DatasetError(f"{dataset.name}: {empty_split(split)}, or give another --split")
    facts = {
        "dataset": dataset.digest,
        "split": split,
        "method": completer.name,
        "weights": completer.digest,
    }
    # by digests: a network that was trained again, or another dataset, must not continue the folder
    existing = claim(out, PREDICTIONS, {**facts, "samples": PART})
    parts = [
        (f"{stem_of(split, number)}.h5", numbers)
        for number, numbers in enumerate(chunked(range(count), PART))
    ]
    # a runtime's threads do not outlive a fork: each process opens the network by itself
    network = completer if execute is None else completer.opened
    execute = execute or ALONE
    tasks, damaged = list[PredictionTask](), list[str]()
    for part in execute.mine(parts):
        if part[0] in existing:
            # a disk may have damaged it since: each file is read before it is relied on
            if _is_intact(out, samples, facts, part):
                continue
            damaged.append(part[0])
        tasks.append(part)
    work, total = partial(_write, network, samples, facts, out), sum(len(n) for _, n in tasks)
    results = counted(execute, work, tasks, total=total, on_start=on_start, on_done=on_done)
    return SplitReport([far for some in results for far in some if far is not None], damaged)


def _is_intact(out: Path, samples: Split, facts: Mapping[str, str], part: PredictionTask) -> bool:
    """Check that an existing file holds the predictions of these samples as they were written."""
    name, numbers = part
    shape = samples.dataset.grid.shape
    check = partial(check_file, facts=facts, max_samples=len(numbers), shape=shape, sealed=True)
    try:
        pairs = read_guarded(check, out / name, 1 << 62)
    except DatasetError:
        return False
    return pairs == [samples.names[number][1:] for number in numbers]


def _write(
    network: Completer | tuple[str, str, int],
    samples: Split,
    facts: Mapping[str, str],
    out: Path,
    part: PredictionTask,
) -> list[float | None]:
    """Write the predictions of some samples into a file of the folder `out`, whole or not at all. A
    network that is not passed is opened. Returns how unfamiliar each sample is; None if unknown."""
    completer = opened_once(*network) if isinstance(network, tuple) else network
    (file_name, numbers), grid = part, samples.dataset.grid
    names = "observed", *completer.inputs
    pairs, digests = list[tuple[int, int]](), list[bytes]()
    away: list[float | None] = []
    make_parent(out / file_name)
    with new_hdf5(out / file_name) as file:
        for first in range(0, len(numbers), completer.batch):
            batch = [samples[number] for number in numbers[first : first + completer.batch]]
            inputs = [channels(names, sample, grid, sample.lidar) for sample in batch]
            prediction = completer(
                {name: np.stack([maps[name] for maps in inputs]) for name in names},
                # by the sample's number, so that a run that continues draws the same
                rng=rng_of(0, numbers[first]),
            )
            predicted = prediction.arrays()
            for n, sample in enumerate(batch):
                maps = {name: values[n] for name, values in predicted.items()}
                for name, values in maps.items():
                    write_map(file, name, values, row=first + n, count=len(numbers))
                pairs.append((int(sample.world), int(sample.viewpoint)))
                digests.append(sample_digest(pairs[-1], maps))
            far = prediction.away
            away += [None] * len(batch) if far is None else far.tolist()
        # last, since the digest of the file covers every row
        columns = dict(zip(WHO, np.array(pairs, np.int64).T, strict=True))
        columns[SAMPLES] = np.frombuffer(b"".join(digests), np.uint8).reshape(-1, 32)
        for name, values in columns.items():
            file[name] = values
        facts = {**facts, **about_others(prediction)}
        file.attrs.update({**facts, DIGEST: digest_of(facts, columns).hex()})
    return away
