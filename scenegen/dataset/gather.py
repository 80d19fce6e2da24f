"""Datasets made of samples that are there: which may be one, what the new one is to hold, and its
shards."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BufferedReader
from pathlib import Path

import numpy as np

from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.archive import open_archive
from scenegen.dataset.choose import Choice, Chosen, choose
from scenegen.dataset.layout import DIGEST, Layout, ShardFile, check_sum, open_file, open_shard
from scenegen.dataset.read import Dataset, advised
from scenegen.dataset.shard import Drawn, ShardReport, ShardTask, put, report_of
from scenegen.dataset.state import Plan
from scenegen.dataset.trust import Entry, Manifest
from scenegen.draw import none_rejected
from scenegen.errors import BrokenError, DatasetError
from scenegen.files import Json, real_path, world_digest
from scenegen.limits import MOST_SHARDS, MOST_SOURCES
from scenegen.run.workers import run
from scenegen.sample import DERIVED, GROUPS
from scenegen.stores import Place, create_at

CONTENT = tuple(name for name in GROUPS[""] if name not in (*DERIVED, "world", "viewpoint"))
"""The fields of every sample that do not follow from others, less its name."""
KEPT = 8
"""Bytes of each digest by which samples and worlds are told apart: among ten million samples, two
that differ are taken for one with a probability of 3e-6."""


def check_disjoint(datasets: Sequence[Dataset], *, workers: int = 1) -> None:
    """Raise DatasetError where `datasets` have a sample in common, or a world in different splits.

    Samples are told apart by their own digests, and those that were taken from the same pose by
    their content, for one sample may have two names: where a world from a file has another number
    in each dataset. Worlds are told apart by the bytes of their MJCF and of the files that it
    refers to.
    """
    shards = [(dataset, entry) for dataset in datasets for entry in dataset.manifest.shards]
    tasks = [
        (n, dataset.folder, entry, dataset.manifest.home(entry).layout)
        for n, (dataset, entry) in enumerate(shards)
    ]
    found = dict(run(_look, tasks, workers))
    names = [dataset.folder / entry.file for dataset, entry in shards]

    def check_samples(digests: Sequence[np.ndarray]) -> None:
        for one, other in _twice(digests):
            raise DatasetError(
                f"{names[one]} and {names[other]}: hold the same sample; leave one of the two "
                f"datasets out, or make one with another --seed"
            )

    check_samples([found[n][0] for n in range(len(shards))])
    posed_alike = _repeated([found[n][1] for n in range(len(shards))])
    of_same_pose = [
        (*task, rows) for task, rows in zip(tasks, posed_alike, strict=True) if len(rows)
    ]
    contents = dict(run(_hash_content, of_same_pose, workers))
    check_samples([contents.get(n, np.empty(0, np.uint64)) for n in range(len(shards))])
    for one, other in _twice([found[n][2] for n in range(len(shards))]):
        if shards[one][1].split != shards[other][1].split:
            raise DatasetError(
                f"{names[one]} and {names[other]}: samples of one world would be in two splits; "
                "take one split of either, with `scenegen take --split`"
            )


def _look(task: tuple[int, Path, Entry, Layout]) -> tuple[int, tuple[np.ndarray, ...]]:
    """A shard's number, and the first bytes of the digests of its samples, of their poses, and of
    its worlds, as whole numbers."""
    number, there, entry, layout = task
    path, archive, worlds = there / entry.file, entry.worlds, b""
    with advised(there):
        with open_file(path) as file:
            shard = open_shard(file, path, entry.samples, layout)
            own = shard.column(DIGEST)
            poses = np.hstack([shard.column("position"), shard.column("quaternion")])
        with open_file(there / archive) as file, open_archive(file, archive) as members:
            for name in sorted(name for name in members if name.endswith(".xml")):
                worlds += world_digest(*members.world(name))[:KEPT]
    samples = np.ascontiguousarray(own[:, :KEPT]).view(np.uint64)[:, 0]
    posed = b"".join(hashlib.sha256(pose.tobytes()).digest()[:KEPT] for pose in poses)
    return number, (samples, np.frombuffer(posed, np.uint64), np.frombuffer(worlds, np.uint64))


def _hash_content(
    task: tuple[int, Path, Entry, Layout, np.ndarray],
) -> tuple[int, np.ndarray]:
    """A shard's number, and the first bytes of the digests of what its samples in `rows` hold
    besides their names, as whole numbers."""
    number, there, entry, layout, rows = task
    path, digests = there / entry.file, b""
    with advised(there), open_file(path) as file:
        shard = open_shard(file, path, entry.samples, layout)
        for row in rows.tolist():
            content = b"".join(shard.value(name, row).tobytes() for name in CONTENT)
            digests += hashlib.sha256(content).digest()[:KEPT]
    return number, np.frombuffer(digests, np.uint64)


def _repeated(digests: Sequence[np.ndarray]) -> list[np.ndarray]:
    """For every shard, the rows whose digest comes more than once among all shards."""
    whole = np.concatenate([*digests, np.empty(0, np.uint64)])
    _, inverse, counts = np.unique(whole, return_inverse=True, return_counts=True)
    ends = np.cumsum([len(one) for one in digests])
    parts = np.split(counts[inverse] > 1, ends)[:-1]
    return [np.flatnonzero(part) for part in parts]


def _twice(digests: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Pairs of shards that have a digest in common, one for each digest's neighbours."""
    owner = np.repeat(np.arange(len(digests)), [len(one) for one in digests])
    values = np.concatenate([*digests, np.empty(0, np.uint64)])
    order = np.argsort(values, kind="stable")
    same = np.flatnonzero(values[order][1:] == values[order][:-1])
    return [(int(owner[order[n]]), int(owner[order[n + 1]])) for n in same]


@dataclass(frozen=True, kw_only=True)
class Part(ShardTask):
    """A shard that is a part of one that is there."""

    there: Path
    """The folder of the dataset that it is of."""
    entry: Entry
    """The shard, as that dataset's manifest lists it."""
    rows: tuple[int, ...] | None = None
    """The samples that are taken, in order; None for all."""
    tells = False

    def write(self, place: Place) -> ShardReport:
        """See `ShardTask`. Raises DatasetError where the shard there is no longer what its manifest
        lists, or a sample that is taken out of it has not its digest."""
        path = self.there / self.entry.file
        with (
            advised(self.there),
            open_file(self.there / self.entry.worlds) as worlds,
            open_file(path) as file,
        ):
            check_sum(worlds, self.entry.worlds, self.entry.worlds_sha256)
            check_sum(file, self.entry.file, self.entry.sha256)
            shard = open_shard(file, path, self.entry.samples, self.layout)
            shard.check_origin(
                split=self.split,
                worlds_sha256=self.entry.worlds_sha256,
                parameters=self.parameters,
            )
            for row in self.rows or ():  # a whole shard is the file that its manifest signs
                shard.check(row)
            return (
                self._copy(place, worlds, file, shard)
                if self.rows is None
                else self._repack(place, worlds, shard, self.rows)
            )

    def _copy(
        self, place: Place, worlds: BufferedReader, samples: BufferedReader, shard: ShardFile
    ) -> ShardReport:
        """The same files under other names: the worlds first, then the samples, which commit
        them."""
        shard.check_origin(first_world=min(self.numbers))
        size = 0
        for file, target in ((worlds, self.worlds), (samples, self.file)):
            file.seek(0)
            create_at(place, target, content := file.read())
            size += len(content)
        own = shard.column(DIGEST).tobytes()
        return report_of(self, self.entry.sums, size, shard.rejected(), own)

    def _repack(
        self, place: Place, worlds: BufferedReader, shard: ShardFile, rows: tuple[int, ...]
    ) -> ShardReport:
        """The `rows` packed anew, and the worlds that they are of."""
        documents = dict[str, bytes]()
        with open_archive(worlds, self.entry.worlds) as members:
            for member in (f"{number:06d}.xml" for number in self.numbers):
                if member not in members:
                    raise BrokenError(f"{self.entry.worlds}: has no member {member}")
                document, others = members.world(member)
                documents |= {member: document, **others}

        def stored() -> Iterator[Drawn]:
            for row in rows:
                yield partial(shard.value, row=row), shard.value(DIGEST, row).tobytes()

        # what was rejected on the way to the whole shard cannot be told apart; the source's own
        # manifest has it
        return put(place, self, stored(), documents, none_rejected())


EMPTY: Json = {
    "kind": manifest.SEVERAL,
    "engine": manifest.SEVERAL,
    "seed": None,
    "recipe": {},
    "software": {},
}
"""What a manifest says where the datasets differ that its samples were made for."""


def plan_take(dataset: Dataset, folder: Place, choice: Choice, *, workers: int = 1) -> Plan:
    """Plan in `folder` the samples of `dataset` that `choice` lets through, in their order. Raises
    DatasetError."""
    pieces = choose(dataset, choice, workers=workers)
    nothing = (
        f"{dataset.folder}: no sample is as asked for ({str(choice) or 'any'}); ask for others"
    )
    return _plan(folder, pieces, taken=str(choice), nothing=nothing)


def plan_merge(datasets: Sequence[Dataset], folder: Place, *, workers: int = 1) -> Plan:
    """Plan in `folder` all samples of `datasets`, split by split in the order in which these are
    named.

    Raises DatasetError for datasets that do not go together: of other grids or labels; ones that
    have a sample in common; ones that share a world, unless both have it in the same split.
    """
    first = datasets[0]
    for other in datasets[1:]:
        if said := unlike(first.manifest.parameters, other.manifest.parameters):
            raise DatasetError(
                f"{other.folder}: {said} by {first.folder}; merge datasets that share it"
            )
    check_disjoint(datasets, workers=workers)
    pieces = (
        one
        for split in SPLITS
        for dataset in datasets
        for one in choose(dataset, Choice(splits=(split,)))
    )
    return _plan(folder, pieces, taken="", nothing="the datasets hold no sample; merge others")


def unlike(first: Json, other: Json) -> str:
    """The first parameter in which datasets of these parameters differ, and cannot be in one, as
    `manifest.differences` says it of the other; "" where there is none."""
    names = [name for name in manifest.ALIKE if name not in manifest.MAY_DIFFER]
    there, asked = (
        {name: one.get(name) for name in names} for one in map(manifest.completed, (other, first))
    )
    return next(iter(manifest.differences(there, asked)), "")


Sources = dict[tuple[str, str], tuple[Manifest, dict[str, None]]]
"""The datasets that samples were made for, by fingerprint and digest, and the ways in which samples
of each were taken."""


def _plan(folder: Place, pieces: Iterable[Chosen], *, taken: str, nothing: str) -> Plan:
    """The plan of `pieces`, which stand in the order train, val, test; `taken` says how they were
    chosen, and `nothing` what is wrong where there is none."""
    sources: Sources = {}
    counts = dict.fromkeys(SPLITS, 0)
    parts: list[Part] = []
    index = dict.fromkeys(SPLITS, 0)
    target, previous = real_path(folder), None
    for chosen in pieces:
        dataset = chosen.dataset
        if dataset is not previous and real_path(dataset.folder) in (target, *target.parents):
            raise DatasetError(
                f"{folder}: is {dataset.folder} itself, or in it; choose another folder with --out"
            )
        previous = dataset
        source, home = _source(sources, chosen, taken)
        split = chosen.entry.split
        start, stop = int(chosen.places[0]), int(chosen.places[-1]) + 1
        worlds, _ = home.numbering(split).name(chosen.places)
        rows = None if len(chosen.rows) == chosen.entry.samples else tuple(chosen.rows.tolist())
        parts.append(
            Part(
                split=split,
                index=index[split],
                samples=len(chosen.rows),
                parameters=home.fingerprint,
                there=dataset.folder,
                entry=chosen.entry,
                layout=home.layout,
                rows=rows,
                more={"source": source, "start": start, "stop": stop},
                numbers=np.unique(worlds).tolist(),
            )
        )
        counts[split] += len(chosen.rows)
        index[split] += 1
    if not parts:
        raise DatasetError(nothing)
    if len(parts) > MOST_SHARDS:
        raise DatasetError(f"{folder}: {len(parts)} shards, expected {MOST_SHARDS} at most")
    homes = [(home.parameters, home.digest, ways) for home, ways in sources.values()]
    merged = gathered(homes, counts, max(part.samples for part in parts))
    lidars = tuple(home.lidar for home, _ in sources.values())
    return Plan(folder=folder, parameters=merged, shards=tuple(parts), lidars=lidars)


def _source(sources: Sources, chosen: Chosen, taken: str) -> tuple[int, Manifest]:
    """The number, among `sources`, of the dataset for which what is `chosen` was made, and its
    manifest; noted there with the ways in which samples were taken. Raises DatasetError."""
    dataset = chosen.dataset.manifest
    home, former = dataset.home(chosen.entry), [""]
    if dataset.sources:
        former = dataset.parameters["sources"][chosen.entry.source]["taken"] or former
    key = home.fingerprint, str(home.digest)
    ways = [", then ".join(filter(None, (old, taken))) for old in former]
    sources.setdefault(key, (home, {}))[1].update(dict.fromkeys(filter(None, ways)))
    if len(sources) > MOST_SOURCES:
        raise DatasetError(
            f"{dataset.folder}: more than {MOST_SOURCES} datasets in one; merge fewer"
        )
    return list(sources).index(key), home


def gathered(
    sources: Sequence[tuple[Json, str | None, Iterable[str]]],
    counts: Mapping[str, int],
    shard_samples: int,
) -> Json:
    """The parameters of the manifest of a dataset whose samples were made for `sources`: of each
    its parameters, its digest (None where it was never there by itself), and how samples were
    taken."""
    documents = [manifest.completed(parameters) for parameters, _, _ in sources]
    first = documents[0]
    merged = {name: first[name] for name in manifest.ALIKE if name in first}
    for name, instead in EMPTY.items():
        alike = all(document[name] == first[name] for document in documents)
        merged[name] = first[name] if alike else instead
    if all(document.get("rescan") == first.get("rescan") is not None for document in documents):
        merged["rescan"] = first["rescan"]
    if differ := manifest.differing(first, documents):
        merged["differ"] = differ
    merged |= {"counts": dict(counts), "shard_samples": shard_samples}
    merged["sources"] = [
        {"digest": digest, "taken": list(taken), "parameters": dict(parameters)}
        for parameters, digest, taken in sources
    ]
    return merged | {"version": manifest.version_of(merged)}
