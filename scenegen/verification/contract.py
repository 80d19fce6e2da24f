"""The manifest of a dataset, relied on only after everything in it has been checked."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from scenegen import SPLITS
from scenegen.dataset import manifest, trust
from scenegen.dataset.rules import stem_of
from scenegen.dataset.trust import Manifest
from scenegen.errors import DatasetError, printable, raised_as, short
from scenegen.files import names_in
from scenegen.recipes import find_kind
from scenegen.verification.report import BrokenError, Ledger, Page


def of_scans(
    contract: Manifest, stored: Callable[[str], Any], *names: str
) -> Iterable[tuple[Any, ...]]:
    """The fields `names` of each scan of a sample whose fields are `stored`: its own, and those
    before it."""
    columns = [[stored(name)] for name in names]
    if contract.mapping.scans > 1:
        columns = [
            [*own, *stored(f"earlier_{name}")] for own, name in zip(columns, names, strict=True)
        ]
    return zip(*columns, strict=True)


def read_contract(folder: Path, ledger: Ledger, kind: str | None = None) -> Manifest | None:
    """The contract of the dataset in `folder`; faults go to the ledger's `manifest`, None where it
    cannot be read on.

    `kind` names a user's own kind whose module may be imported. Raises DatasetError where the
    folder holds no dataset at all, or one of another kind than that.
    """
    given = manifest.read(folder)
    if kind is not None:
        _check_named(kind, given.get("kind"))
    contract = None
    with ledger.checking("manifest") as page:
        page.count(files=1)
        with raised_as(BrokenError, f"{manifest.NAME}: ", of=BrokenError):
            found = trust.parse(given, folder, kind)
            for home in found.homes:
                if home.kind == "scene" and home.scenes is None:
                    raise BrokenError("recipe.scenes = None: expected the worlds of each split")
                # spelled out now, so that what is wrong with it is found here
                home.recipe  # noqa: B018
        _check_shards(found, page)
        contract = found
    return contract


def _check_named(kind: str, there: Any) -> None:
    """Raise DatasetError unless the user's own `kind` is the manifest's, and can be imported."""
    if kind != there:
        raise DatasetError(
            f"--kind {kind}: the dataset's kind is {short(there)}; leave --kind out, or give that"
        )
    with raised_as(DatasetError, "--kind: "):
        find_kind(kind)


def _check_shards(contract: Manifest, page: Page) -> None:
    """Whether the shards listed are those that the counts ask for, in order, and no other lies in
    the folder."""
    where = manifest.NAME
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
        asked = contract.counts[split]
        whole = contract.complete
        page.expect(
            total == asked if whole else total <= asked,
            f"{where}: counts.{split} = {asked}, but its shards hold {total} samples",
        )
        for number, entry in enumerate(entries):
            scenes = contract.home(entry).scenes
            if scenes is not None and not scenes.get(split):
                raise BrokenError(
                    f"{where}: recipe.scenes names no world for {split}, which has samples"
                )
            # of an incomplete dataset, shards between may be missing
            stem = stem_of(split, number) if whole else entry.file.removesuffix(".h5")
            page.expect(
                (entry.file, entry.worlds) == (f"{stem}.h5", f"{stem}.worlds.zip")
                and stem.startswith(split),
                f"{where}: shard files {entry.file}, {entry.worlds} of {split} stand where "
                f"{stem}.h5, {stem}.worlds.zip are expected",
            )
            full = (
                bool(contract.sources)
                or number == len(entries) - 1
                or entry.samples % contract.recipe.flight.viewpoints == 0
            )
            page.expect(
                full, f"{where}: {entry.file} holds {entry.samples} samples: a flight is cut"
            )
    listed = {name for entry in contract.shards for name in (entry.file, entry.worlds)}
    files = {name for name in names_in(contract.folder) if name.endswith((".h5", ".zip"))}
    others = printable(", ".join(sorted(files - listed)[:3]))
    page.expect(not others, f"{others}: in the folder, but {where} does not list it")
