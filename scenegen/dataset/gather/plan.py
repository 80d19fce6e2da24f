"""What a gathered dataset is to be: its shards, each a part of one that is there, and what its
manifest says of where they are from."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.gather.choose import Choice, Chosen, choose
from scenegen.dataset.gather.part import Part
from scenegen.dataset.gather.survey import check_disjoint
from scenegen.dataset.read import Dataset
from scenegen.dataset.state import Plan
from scenegen.dataset.trust import ALIKE, GatheredEntry, Manifest
from scenegen.errors import DatasetError, short
from scenegen.limits import MOST_SHARDS, MOST_SOURCES

EMPTY: Mapping[str, Any] = {
    "kind": manifest.SEVERAL,
    "engine": manifest.SEVERAL,
    "seed": None,
    "recipe": {},
    "software": {},
}
"""What a manifest says where the datasets differ that its samples were made for."""


def plan_take(dataset: Dataset, folder: Path, choice: Choice, *, workers: int = 1) -> Plan:
    """Plan in `folder` the samples of `dataset` that `choice` lets through, in their order. Raises
    DatasetError."""
    pieces = ((dataset, one) for one in choose(dataset, choice, workers=workers))
    nothing = (
        f"{dataset.folder}: no sample is as asked for ({choice}); ask for others"
        if str(choice)
        else (f"{dataset.folder}: holds no sample; take of another dataset")
    )
    return _plan(folder, pieces, taken=str(choice), nothing=nothing)


def plan_merge(datasets: Sequence[Dataset], folder: Path, *, workers: int = 1) -> Plan:
    """Plan in `folder` all samples of `datasets`, split by split in the order in which these are
    named.

    Raises DatasetError for datasets that do not go together: of other grids, sensors or fields;
    ones that have a sample in common; ones that share a world, unless both have it in the same
    split.
    """
    for other in datasets[1:]:
        _check_alike(datasets[0], other)
    check_disjoint(datasets, workers=workers)
    pieces = (
        (dataset, one)
        for split in SPLITS
        for dataset in datasets
        for one in choose(dataset, Choice(splits=(split,)))
    )
    return _plan(folder, pieces, taken="", nothing="the datasets hold no sample; merge others")


def _check_alike(first: Dataset, other: Dataset) -> None:
    ours, theirs = (manifest.completed(one.manifest.parameters) for one in (first, other))
    for name in ALIKE:
        ours_is, theirs_is = ours.get(name), theirs.get(name)
        if ours_is == theirs_is:
            continue
        if isinstance(ours_is, dict) and isinstance(theirs_is, dict):
            part = next(
                key for key in (*ours_is, *theirs_is) if ours_is.get(key) != theirs_is.get(key)
            )
            name, ours_is, theirs_is = f"{name}.{part}", ours_is.get(part), theirs_is.get(part)
        raise DatasetError(
            f"{other.folder}: {name} is {short(theirs_is)} there, and {short(ours_is)} in "
            f"{first.folder}; merge "
            "datasets that share it"
        )


def _plan(
    folder: Path, pieces: Iterable[tuple[Dataset, Chosen]], *, taken: str, nothing: str
) -> Plan:
    """The plan of `pieces`, which stand in the order train, val, test; `taken` says how they were
    chosen, and `nothing` what is wrong where there is none."""
    sources = _Sources()
    counts = dict.fromkeys(SPLITS, 0)
    parts: list[Part] = []
    index = dict.fromkeys(SPLITS, 0)
    dataset: Dataset | None = None
    for dataset, chosen in pieces:
        if dataset.folder.resolve() in (folder.resolve(), *folder.resolve().parents):
            raise DatasetError(
                f"{folder}: is {dataset.folder} itself, or in it; choose another folder with --out"
            )
        source, home, split = *sources.add(dataset, chosen, taken), chosen.entry.split
        start, stop = int(chosen.places[0]), int(chosen.places[-1]) + 1
        numbering = home.numbering(split)
        cut = stop - start > len(chosen.places)
        worlds = numbering.worlds(start, stop - start)  # most often a range, which is small
        if cut:
            worlds = sorted(set(numbering.name(chosen.places)[0].tolist()))
        rows = None if len(chosen.rows) == chosen.entry.samples else tuple(chosen.rows.tolist())
        parts.append(
            Part(
                folder=folder,
                split=split,
                index=index[split],
                samples=len(chosen.rows),
                parameters=home.fingerprint,
                there=dataset.folder,
                entry=chosen.entry,
                format=dataset.manifest.layout,
                rows=rows,
                source=source,
                start=start,
                stop=stop,
                of_worlds=worlds,
            )
        )
        counts[split] += len(chosen.rows)
        index[split] += 1
    if dataset is None:
        raise DatasetError(nothing)
    if max(index.values()) > MOST_SHARDS:
        raise DatasetError(
            f"{folder}: {max(index.values())} shards of a split, expected {MOST_SHARDS} at most"
        )
    given = sources.parameters(counts, max(part.samples for part in parts))
    return Plan(folder=folder, parameters=given, shards=tuple(parts), lidar=dataset.lidar)


class _Sources:
    """The datasets that samples were made for, each once, in the order in which they are met."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], tuple[Manifest, list[str]]] = {}

    def add(self, dataset: Dataset, chosen: Chosen, taken: str) -> tuple[int, Manifest]:
        """The number of the dataset for which what is `chosen` was made, and its manifest. Raises
        DatasetError."""
        it = dataset.manifest
        home, before = it.home(chosen.entry), [""]
        if isinstance(chosen.entry, GatheredEntry):
            before = it.parameters["sources"][chosen.entry.source]["taken"] or before
        key = home.fingerprint, str(home.digest)
        ways = self._found.setdefault(key, (home, []))[1]
        ways += [
            way
            for old in before
            if (way := ", then ".join(filter(None, (old, taken)))) and way not in ways
        ]
        if len(self._found) > MOST_SOURCES:
            raise DatasetError(
                f"{dataset.folder}: more than {MOST_SOURCES} datasets in one; merge fewer"
            )
        return list(self._found).index(key), home

    def parameters(self, counts: Mapping[str, int], shard_samples: int) -> dict[str, Any]:
        """Those of the new dataset's manifest."""
        each = [manifest.completed(home.parameters) for home, _ in self._found.values()]
        first = each[0]
        given = {name: first[name] for name in ALIKE if name in first}
        for name, instead in EMPTY.items():
            given[name] = first[name] if all(one[name] == first[name] for one in each) else instead
        if all(one.get("rescan") == first.get("rescan") is not None for one in each):
            given["rescan"] = first["rescan"]
        given |= {"counts": dict(counts), "shard_samples": shard_samples}
        given["sources"] = [
            {"digest": home.digest, "taken": ways, "parameters": dict(home.parameters)}
            for home, ways in self._found.values()
        ]
        return given | {"version": manifest.version_of(given)}
