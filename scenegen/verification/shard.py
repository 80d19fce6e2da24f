"""The walk over one shard: its archive, its file, every sample. At each stage, the checks look that
declare it."""

import os
from dataclasses import dataclass, field
from typing import Any

from scenegen.dataset.layout import DIGEST, most_bytes, open_file, open_shard
from scenegen.sample import FIELDS
from scenegen.verification.archive import read_archive
from scenegen.verification.checks import CHECKS
from scenegen.verification.checks.files import ARCHIVES, LAYOUT
from scenegen.verification.report import BrokenError, Ledger
from scenegen.verification.stages import Sample, Shard, SignedFile, Task, Worlds
from scenegen.worlds.quiet import quiet_mujoco


@dataclass(eq=False)
class Findings:
    """What one shard's examination leaves for the whole folder's."""

    number: int
    samples: int
    ledger: Ledger = field(default_factory=Ledger)


@quiet_mujoco()
def examine(task: Task) -> Findings:
    """Make every check of one shard by itself. What is wrong with its files becomes faults in the
    findings' ledger, and raises nothing."""
    found = Findings(task.number, task.entry.samples)
    ledger, contract, entry = found.ledger, task.contract, task.entry
    checks = [check for check in CHECKS if check.applies(contract, quick=task.quick)]

    def look(stage: str, at: Any) -> None:
        """Make every check that looks at this stage."""
        for check in checks:
            if (examination := getattr(check, stage)) is not None:
                with ledger.checking(check.name) as page:
                    examination(at, page)

    worlds, path = None, contract.folder / entry.worlds
    with ledger.checking(ARCHIVES.name) as page, open_file(path) as file:
        page.count(files=1)
        worlds = Worlds(task, read_archive(file, path.name, entry.samples))
        look("file", SignedFile(file, path.name, entry.worlds_sha256))
        look("archive", worlds)
    path = contract.folder / entry.file
    with ledger.checking(LAYOUT.name) as page, open_file(path) as file:
        if os.fstat(file.fileno()).st_size <= most_bytes(contract.layout, entry.samples):
            look("file", SignedFile(file, path.name, entry.sha256))
        opened = open_shard(file, path, entry.samples, contract.layout)
        if opened.stray_bytes:
            raise BrokenError(
                f"{opened.name}: {opened.stray_bytes} of its bytes belong to no sample"
            )
        opened.check_origin(
            split=entry.split, first_world=entry.first_world, worlds_sha256=entry.worlds_sha256
        )
        page.count(files=1)
        shard = Shard(task, worlds, opened, opened.rejected())
        look("shard", shard)
        stored = [name for name in contract.fields if not (task.quick and FIELDS[name]["derived"])]
        for row in range(entry.samples):
            with ledger.checking(
                LAYOUT.name
            ) as page:  # a sample that cannot be unpacked does not end the walk
                page.count(samples=1)
                fields = {name: opened.value(name, row, read_only=task.quick) for name in stored}
                look("sample", Sample(shard, row, fields, opened.value(DIGEST, row).tobytes()))
    return found
