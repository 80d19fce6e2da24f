"""Whether datasets may be one: no sample twice, and no world in two splits."""

import hashlib
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenegen import SPLITS
from scenegen.dataset.archive import open_archive
from scenegen.dataset.layout import DIGEST, Layout, open_file, open_shard
from scenegen.dataset.read import Dataset
from scenegen.dataset.trust import Entry
from scenegen.errors import BrokenError, DatasetError
from scenegen.run.workers import run

KEPT = 8
"""Bytes of each digest by which samples and worlds are told apart: among ten million samples, two
that differ are taken for one with a probability of 3e-6."""


@dataclass(frozen=True)
class _Task:
    """One shard, to be looked at."""

    number: int
    folder: Path
    entry: Entry
    layout: Layout


def check_disjoint(datasets: Sequence[Dataset], *, workers: int = 1) -> None:
    """Raise DatasetError where `datasets` have a sample in common, or a world in different splits.

    Samples are told apart by their own digests, worlds by the bytes of their MJCF and of the files
    that it refers to.
    """
    tasks = [
        _Task(n, dataset.folder, entry, dataset.manifest.layout)
        for n, (dataset, entry) in enumerate(
            (one, entry) for one in datasets for entry in one.manifest.shards
        )
    ]
    with closing(run(_look, tasks, workers)) as results:
        found = sorted(results, key=lambda one: one[0])
    names = [f"{task.folder}/{task.entry.file}" for task in tasks]
    splits = np.array([SPLITS.index(task.entry.split) for task in tasks])
    for one, other in _twice([samples for _, samples, _ in found]):
        raise DatasetError(
            f"{names[one]} and {names[other]}: hold the same sample; leave one of the two "
            f"datasets out"
        )
    for one, other in _twice([worlds for _, _, worlds in found]):
        if splits[one] != splits[other]:
            raise DatasetError(
                f"{names[one]} and {names[other]}: samples of one world would be in two splits; "
                f"take one split of "
                "either, with `scenegen take --split`"
            )


def _look(task: _Task) -> tuple[int, NDArray[np.uint64], NDArray[np.uint64]]:
    """A shard's number, and the first bytes of the digests of its samples and of its worlds."""
    path, archive, worlds = task.folder / task.entry.file, task.entry.worlds, b""
    try:
        with open_file(path) as file:
            own = open_shard(file, path, task.entry.samples, task.layout).column(DIGEST)
        with open_file(task.folder / archive) as file, open_archive(file, archive) as members:
            for name in sorted(name for name in members if name.endswith(".xml")):
                document, others = members.world(name)
                digest = hashlib.sha256(document)
                for other, content in sorted(others.items()):
                    digest.update(other.encode() + hashlib.sha256(content).digest())
                worlds += digest.digest()[:KEPT]
    except BrokenError as error:
        raise DatasetError(f"{task.folder}/{error}; verify the dataset, or copy it again") from None
    return (
        task.number,
        np.ascontiguousarray(own[:, :KEPT]).view(np.uint64)[:, 0],
        np.frombuffer(worlds, np.uint64),
    )


def _twice(digests: Sequence[NDArray[np.uint64]]) -> list[tuple[int, int]]:
    """Pairs of shards that have a digest in common, one for each digest's neighbours."""
    owner = np.repeat(np.arange(len(digests)), [len(one) for one in digests])
    values = np.concatenate([*digests, np.empty(0, np.uint64)])
    order = np.argsort(values, kind="stable")
    same = np.flatnonzero(values[order][1:] == values[order][:-1])
    return [(int(owner[order[n]]), int(owner[order[n + 1]])) for n in same]
