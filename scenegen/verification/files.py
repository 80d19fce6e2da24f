"""Checks of the manifest and of whole files: whether they can be read, and match the manifest."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarsim.parameters import short_repr
from scenegen import SPLITS
from scenegen.base.errors import CorruptFileError, DatasetError, printable, reraise_as
from scenegen.base.files import list_dir
from scenegen.base.reading import sha256_in, world_digest
from scenegen.dataset import manifest
from scenegen.dataset.archive import referred
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import NAME, ShardEntry, stem_of
from scenegen.verification.check import Check, Shard, SignedFile, Worlds
from scenegen.verification.report import Ledger, Page
from scenegen.worlds.kinds import find_kind


def read_contract(folder: Path, ledger: Ledger, kind: str | None = None) -> Manifest | None:
    """Read the manifest, and record faults in the ledger's page `manifest`.

    Args:
        folder: Folder of the dataset.
        ledger: The ledger.
        kind: A user's own kind, which may be imported.

    Returns:
        The manifest; None if it is too damaged to continue.

    Raises:
        DatasetError: if the folder holds no dataset, or one of another kind.
    """
    content = manifest.read_content(folder)
    contract = None
    with ledger.checking("manifest") as page:
        page.count(files=1)
        with reraise_as(CorruptFileError, f"{NAME}: ", of=CorruptFileError):
            try:
                parsed = manifest.parse(content, folder, kind)
            except CorruptFileError:
                raise
            except DatasetError as error:  # of another version, or no manifest
                raise DatasetError(f"{folder}: {NAME} {error}") from None
            if kind is not None:
                if kind != parsed.kind:
                    raise DatasetError(
                        f"--kind {kind}: the dataset's kind is {short_repr(parsed.kind)}; leave "
                        "--kind out, or give that"
                    )
                # imports the module, which the user named
                with reraise_as(DatasetError, "--kind: "):
                    find_kind(kind)
            # computed now, so that faults in its tables are recorded here
            parsed.recipe  # noqa: B018
        _check_shards(parsed, page)
        # stays None if anything above raised CorruptFileError
        contract = parsed
    return contract


def _check_shards(contract: Manifest, page: Page) -> None:
    """Check that the listed shards have the right names, order and sizes, and that the folder has
    no others."""
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
                raise CorruptFileError(
                    f"{where}: scenes names no world for {split}, which has samples"
                )
            # an incomplete dataset may lack shards in between
            stem = stem_of(split, number) if complete else entry.file.removesuffix(".h5")
            page.expect(
                (entry.file, entry.worlds) == (f"{stem}.h5", f"{stem}.worlds.zip")
                and stem.startswith(split),
                f"{where}: shard files {entry.file}, {entry.worlds} of {split} stand where "
                f"{stem}.h5, {stem}.worlds.zip are expected",
            )
            _check_size(contract, entry, number == len(entries) - 1, page)
    files = {name for name in list_dir(contract.folder) if name.endswith((".h5", ".zip"))}
    # three names are enough for one line; they are untrusted
    stray = printable(", ".join(sorted(files - contract.files.keys())[:3]))
    page.expect(not stray, f"{stray}: in the folder, but {where} does not list it")


def _check_size(contract: Manifest, entry: ShardEntry, is_last: bool, page: Page) -> None:
    """Check the number of samples of a shard: whole flights, and equal for all shards except the
    last of a split."""
    where, viewpoints = NAME, contract.recipe.flight.viewpoints
    page.expect(
        is_last or entry.samples % viewpoints == 0,
        f"{where}: {entry.file} holds {entry.samples} samples: a flight is cut",
    )
    expected = max(contract.shard_samples // viewpoints, 1) * viewpoints
    page.expect(
        entry.samples <= expected and (is_last or entry.samples == expected),
        f"{where}: {entry.file} holds {entry.samples} samples, expected {expected} with "
        f"shard_samples = {contract.shard_samples}",
    )


def _written_for_these_parameters(shard: Shard, page: Page) -> None:
    # for `_rejections_add_up`
    page.kept.append(shard.rejected)
    page.expect(
        shard.file.attributes["parameters"] == shard.task.contract.fingerprint,
        f"{shard.task.entry.file}: was written for other parameters than the manifest's: one of "
        "the two was edited, or the shard is another dataset's",
    )


def _rejections_add_up(contract: Manifest, page: Page) -> None:
    if len(page.kept) < len(contract.shards):
        return  # a shard could not be read: a fault of another check
    for subject in ("worlds", "viewpoints"):
        total: Counter[str] = Counter()
        for rejected in page.kept:
            total.update(rejected[subject])
        listed = contract.rejected.get(subject, {})  # a manifest may leave it out
        page.expect(
            dict(total) == listed,
            f"{NAME}: rejected.{subject} = {listed}, the shards count {dict(total)}",
        )


MANIFEST = Check(
    name="manifest",
    quick=True,
    shard=_written_for_these_parameters,
    folder=_rejections_add_up,
)
"""`read_contract` examines the manifest itself."""


EXAMINED = Check(name="examined", quick=True)
"""`verify` counts shards and records those whose process ended."""


def _same_sum(signed: SignedFile, page: Page) -> None:
    digest = sha256_in(signed.file)
    page.count(files=1)
    page.expect(
        digest == signed.sha256,
        f"{signed.name}: SHA-256 {digest[:16]}…, the manifest lists {signed.sha256[:16]}…",
    )


CHECKSUMS = Check(name="checksums", quick=True, file=_same_sum)


LAYOUT = Check(name="layout", quick=True)
"""The walk over a shard records faults when it opens the file and unpacks samples."""


def _worlds_from_files(worlds: Worlds, page: Page) -> None:
    entry, scenes = worlds.task.entry, worlds.task.contract.scenes
    # drawn worlds have no digests in the manifest; the check `regenerated` draws some again
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
    used = {
        name for document in worlds.documents.values() for name in referred(document, worlds.assets)
    }
    stray = printable(", ".join(sorted(worlds.assets.keys() - used)[:3]))
    page.expect(not stray, f"{worlds.task.entry.worlds}: no world in it refers to {stray}")


def _look_at_archive(worlds: Worlds, page: Page) -> None:
    _worlds_from_files(worlds, page)
    _nothing_besides(worlds, page)


def _worlds_of_samples(shard: Shard, page: Page) -> None:
    entry = shard.task.entry
    sampled = np.unique(shard.file.column("world")).tolist()
    page.expect(
        entry.first_world == sampled[0],
        f"{entry.file}: first_world = {entry.first_world}, its samples begin with {sampled[0]}",
    )
    archived = sampled if shard.worlds is None else sorted(shard.worlds.documents)
    page.expect(
        archived == sampled,
        f"{entry.worlds}: holds worlds {_spans(archived)}, its samples are of {_spans(sampled)}",
    )


def _spans(numbers: Sequence[int]) -> str:
    return f"{numbers[0]} to {numbers[-1]} ({len(numbers)})" if numbers else "none"


ARCHIVES = Check(name="archives", quick=True, archive=_look_at_archive, shard=_worlds_of_samples)
"""The walk over a shard records archives that cannot be read."""

CHECKS = (MANIFEST, EXAMINED, CHECKSUMS, LAYOUT, ARCHIVES)
