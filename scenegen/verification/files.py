"""Checks of the manifest, and of files as a whole: can they be read, and are they what the manifest
lists?"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scenegen import SPLITS
from scenegen.base.errors import DatasetError, printable, raised_as, short
from scenegen.base.files import names_in, sha256_in, world_digest
from scenegen.dataset import manifest
from scenegen.dataset.archive import referred
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import NAME, ShardEntry, stem_of
from scenegen.verification.check import Check, Shard, SignedFile, Worlds
from scenegen.verification.report import BrokenError, Ledger, Page
from scenegen.worlds.kinds import find_kind


def read_contract(folder: Path, ledger: Ledger, kind: str | None = None) -> Manifest | None:
    """The contract of the dataset in `folder`; faults go to the ledger's `manifest`, None where it
    cannot be read on.

    `kind` names a user's own kind whose module may be imported. Raises DatasetError where the
    folder holds no dataset at all, or one of another kind than that.
    """
    content = manifest.read_content(folder)
    contract = None
    with ledger.checking("manifest") as page:
        page.count(files=1)
        with raised_as(BrokenError, f"{NAME}: ", of=BrokenError):
            parsed = manifest.parse(content, folder, kind)
            if kind is not None:
                if kind != parsed.kind:
                    raise DatasetError(
                        f"--kind {kind}: the dataset's kind is {short(parsed.kind)}; leave "
                        "--kind out, or give that"
                    )
                with raised_as(DatasetError, "--kind: "):
                    find_kind(kind)
            # spelled out now, so that what is wrong with it is found here
            parsed.recipe  # noqa: B018
        _check_shards(parsed, page)
        contract = parsed
    return contract


def _check_shards(contract: Manifest, page: Page) -> None:
    """Whether the shards listed are those that the counts ask for, in order, and no other lies in
    the folder."""
    where = NAME
    page.expect(
        contract.complete, f"{where}: complete is false: give the command that made it again"
    )
    page.expect(
        (contract.digest is not None) == contract.complete,
        f"{where}: digest = {contract.digest}: expected one exactly where complete is true",
    )
    order = [SPLITS.index(entry.split) for entry in contract.shards]
    page.expect(order == sorted(order), f"{where}: shards are not in the order train, val, test")
    for split in SPLITS:
        entries = [entry for entry in contract.shards if entry.split == split]
        total = sum(entry.samples for entry in entries)
        promised = contract.counts[split]
        complete = contract.complete
        page.expect(
            total == promised if complete else total <= promised,
            f"{where}: counts.{split} = {promised}, but its shards hold {total} samples",
        )
        for number, entry in enumerate(entries):
            scenes = contract.scenes
            if scenes is not None and not scenes.get(split):
                raise BrokenError(f"{where}: scenes names no world for {split}, which has samples")
            # of an incomplete dataset, shards between may be missing
            stem = stem_of(split, number) if complete else entry.file.removesuffix(".h5")
            page.expect(
                (entry.file, entry.worlds) == (f"{stem}.h5", f"{stem}.worlds.zip")
                and stem.startswith(split),
                f"{where}: shard files {entry.file}, {entry.worlds} of {split} stand where "
                f"{stem}.h5, {stem}.worlds.zip are expected",
            )
            _check_size(contract, entry, number == len(entries) - 1, page)
    files = {name for name in names_in(contract.folder) if name.endswith((".h5", ".zip"))}
    stray = printable(", ".join(sorted(files - contract.files.keys())[:3]))
    page.expect(not stray, f"{stray}: in the folder, but {where} does not list it")


def _check_size(contract: Manifest, entry: ShardEntry, is_last: bool, page: Page) -> None:
    """Whether a shard holds as many samples as the manifest says: whole flights, unless it is the
    last of its split; and all shards but that one alike."""
    where, each = NAME, contract.recipe.flight.viewpoints
    page.expect(
        is_last or entry.samples % each == 0,
        f"{where}: {entry.file} holds {entry.samples} samples: a flight is cut",
    )
    expected = max(contract.shard_samples // each, 1) * each
    page.expect(
        entry.samples <= expected and (is_last or entry.samples == expected),
        f"{where}: {entry.file} holds {entry.samples} samples, expected {expected} with "
        f"shard_samples = {contract.shard_samples}",
    )


def _written_for_these_parameters(shard: Shard, page: Page) -> None:
    page.kept.append(shard.rejected)
    page.expect(
        shard.file.attributes["parameters"] == shard.task.contract.fingerprint,
        f"{shard.task.entry.file}: was written for other parameters than the manifest's: one of "
        "the two was edited, or the shard is another dataset's",
    )


def _rejections_add_up(contract: Manifest, page: Page) -> None:
    if len(page.kept) < len(contract.shards):
        return  # a shard could not be read: a fault of another check
    for what in ("worlds", "viewpoints"):
        total: Counter[str] = Counter()
        for rejected in page.kept:
            total.update(rejected[what])
        listed = contract.rejected.get(what, {})  # a manifest may leave it out
        page.expect(
            dict(total) == listed,
            f"{NAME}: rejected.{what} = {listed}, the shards count {dict(total)}",
        )


MANIFEST = Check(
    name="manifest",
    quick=True,
    shard=_written_for_these_parameters,
    folder=_rejections_add_up,
)
"""`read_contract` examines the manifest itself, before all else."""


EXAMINED = Check(name="examined", quick=True)
"""`verify` counts, and writes the faults: it sees the processes end."""


def _same_sum(signed: SignedFile, page: Page) -> None:
    found = sha256_in(signed.file)
    page.count(files=1)
    page.expect(
        found == signed.sha256,
        f"{signed.name}: SHA-256 {found[:16]}…, the manifest lists {signed.sha256[:16]}…",
    )


CHECKSUMS = Check(name="checksums", quick=True, file=_same_sum)


LAYOUT = Check(name="layout", quick=True)
"""The walk over a shard writes the faults: opening the file and unpacking its samples is the
examination."""


def _worlds_from_files(worlds: Worlds, page: Page) -> None:
    entry, scenes = worlds.task.entry, worlds.task.contract.scenes
    if scenes is None:
        return
    listed = scenes[entry.split]
    for number in worlds.documents:
        page.expect(
            world_digest(*worlds.source(number)).hex()
            == (listed[number].sha256 if number < len(listed) else None),
            f"{entry.worlds}: {number:06d}.xml is not the world that the manifest's scenes names",
        )


def _nothing_besides(worlds: Worlds, page: Page) -> None:
    used = {name for it in worlds.documents.values() for name in referred(it, worlds.assets)}
    stray = printable(", ".join(sorted(worlds.assets.keys() - used)[:3]))
    page.expect(not stray, f"{worlds.task.entry.worlds}: no world in it refers to {stray}")


def _look_at_archive(worlds: Worlds, page: Page) -> None:
    _worlds_from_files(worlds, page)
    _nothing_besides(worlds, page)


def _worlds_of_samples(shard: Shard, page: Page) -> None:
    entry = shard.task.entry
    found = np.unique(shard.file.column("world")).tolist()
    page.expect(
        entry.first_world == found[0],
        f"{entry.file}: first_world = {entry.first_world}, its samples begin with {found[0]}",
    )
    there = found if shard.worlds is None else sorted(shard.worlds.documents)
    page.expect(
        there == found,
        f"{entry.worlds}: holds worlds {_spans(there)}, its samples are of {_spans(found)}",
    )


def _spans(numbers: Sequence[int]) -> str:
    return f"{numbers[0]} to {numbers[-1]} ({len(numbers)})" if numbers else "none"


ARCHIVES = Check(name="archives", quick=True, archive=_look_at_archive, shard=_worlds_of_samples)
"""The walk over a shard adds the faults of an archive that cannot be read."""

CHECKS = (MANIFEST, EXAMINED, CHECKSUMS, LAYOUT, ARCHIVES)
