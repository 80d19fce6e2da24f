"""The walk over one shard: its archive, its file, every sample. At each stage, the checks look that declare it."""

import os
from dataclasses import dataclass, field
from typing import Any

from scenegen.dataset.layout import DIGEST, most_bytes, open_file, open_shard
from scenegen.quiet import quiet_mujoco
from scenegen.sample import SCHEMA
from scenegen.verify.archive import read_archive
from scenegen.verify.checks import CHECKS
from scenegen.verify.checks.files import ARCHIVES, LAYOUT
from scenegen.verify.report import BrokenError, Ledger
from scenegen.verify.stages import Sample, Shard, SignedFile, Task, Worlds


@dataclass(eq=False)
class Findings:
    """What one shard's examination leaves for the whole folder's."""

    number: int
    samples: int
    ledger: Ledger = field(default_factory=Ledger)


@quiet_mujoco()
def examine(task: Task) -> Findings:
    """Make every check of one shard by itself. What is wrong with its files becomes faults in the findings' ledger, and
    raises nothing."""
    found = Findings(task.number, task.entry.samples)
    walk = _Walk(task, found.ledger)
    walk.shard(walk.archive())
    return found


class _Walk:
    """One shard's stages, one after the other."""

    def __init__(self, task: Task, ledger: Ledger):
        self._task, self._ledger = task, ledger
        self._checks = [check for check in CHECKS if check.applies(task.contract, quick=task.quick)]

    def archive(self) -> Worlds | None:
        """Read the archive and show it to the checks; where it cannot be read, that is a fault of `archives`."""
        entry, worlds = self._task.entry, None
        path = self._task.contract.folder / entry.worlds
        with self._ledger.checking(ARCHIVES.name) as page, open_file(path) as file:
            page.count(files=1)
            worlds = Worlds(self._task, read_archive(file, path.name))
            self._look("file", SignedFile(file, path.name, entry.worlds_sha256))
            self._look("archive", worlds)
        return worlds

    def shard(self, worlds: Worlds | None) -> None:
        """Open the shard's file and show it to the checks; where it cannot be read, that is a fault of `layout`."""
        contract, entry = self._task.contract, self._task.entry
        path = contract.folder / entry.file
        with self._ledger.checking(LAYOUT.name) as page, open_file(path) as file:
            if os.fstat(file.fileno()).st_size <= most_bytes(contract.layout, entry.samples):
                self._look("file", SignedFile(file, path.name, entry.sha256))
            opened = open_shard(file, path, entry.samples, contract.layout)
            if opened.stray_bytes:
                raise BrokenError(f"{opened.name}: {opened.stray_bytes} of its bytes belong to no sample")
            opened.check_origin(split=entry.split, first_world=entry.first_world, worlds_sha256=entry.worlds_sha256)
            page.count(files=1)
            shard = Shard(self._task, worlds, opened, opened.rejected())
            self._look("shard", shard)
            self._samples(shard)

    def _samples(self, shard: Shard) -> None:
        """Unpack every sample once and show it to the checks; one that cannot be unpacked is a fault of `layout`."""
        quick, file = self._task.quick, shard.file
        stored = [name for name, meta in SCHEMA.items() if not meta["derived"]]
        stored += [name for name in self._task.contract.fields if SCHEMA[name]["derived"] and not quick]
        for row in range(self._task.entry.samples):
            with self._ledger.checking(LAYOUT.name) as page:
                page.count(samples=1)
                fields = {name: file.value(name, row, read_only=quick) for name in stored}
                self._look("sample", Sample(shard, row, fields, file.value(DIGEST, row).tobytes()))

    def _look(self, stage: str, at: Any) -> None:
        """Make every check that looks at this stage."""
        for check in self._checks:
            if (examine := getattr(check, stage)) is not None:
                with self._ledger.checking(check.name) as page:
                    examine(at, page)
