"""`verify`: examine every shard in its own process, then the dataset as a whole."""

from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from lidarsim.parameters import short_repr
from scenegen.base.errors import CorruptFileError, DatasetError, as_own_code_error, reraise_as
from scenegen.base.executors import Begun, Counted, Executor, unheard
from scenegen.base.mirrors import fetch
from scenegen.base.reading import size_of
from scenegen.base.workers import Limited, Local
from scenegen.dataset.collection import open_data
from scenegen.dataset.layout import DIGEST, max_bytes, open_file, open_shard
from scenegen.dataset.locate import locate
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import NAME
from scenegen.draw.draw import draw_unit
from scenegen.draw.sample import FIELDS
from scenegen.draw.source import DrawnWorlds
from scenegen.verification.check import (
    OWN_CHECKS,
    Check,
    RawSample,
    Shard,
    SignedFile,
    Task,
    Worlds,
)
from scenegen.verification.files import ARCHIVES, EXAMINED, LAYOUT, MANIFEST, read_contract
from scenegen.verification.files import CHECKS as OF_FILES
from scenegen.verification.repeated import CHECKS as REPEATED
from scenegen.verification.report import Ledger, Outcome, Report
from scenegen.verification.splits import CHECKS as BETWEEN_SPLITS
from scenegen.verification.splits import MAX_TWINS, world_digests
from scenegen.verification.stored import CHECKS as STORED
from scenegen.verification.viewpoints import CHECKS as OF_VIEWPOINTS
from scenegen.worlds.recipe import preset
from scenegen.worlds.world import quiet_mujoco

CHECKS = tuple(
    sorted(
        (*OF_FILES, *STORED, *OF_VIEWPOINTS, *BETWEEN_SPLITS, *REPEATED),
        key=lambda check: not check.quick,
    )
)
"""All checks in the order of the report: those of `--quick` first."""


def chosen_checks(contract: Manifest, *, quick: bool, own: Iterable[str]) -> list[Check]:
    """Select the checks of a dataset.

    Args:
        contract: Its manifest.
        quick: Whether only quick checks are made.
        own: The user's checks, as ``module:Object``; always made.

    Raises:
        ValueError: if there is no such check.
    """
    fields = {"", *contract.fields}
    applying = [
        check
        for check in CHECKS
        if (check.quick or not quick)
        and check.field in fields
        and (contract.parts or not check.part)
    ]
    return [*applying, *map(OWN_CHECKS.find, own)]


def warm_up() -> None:
    """Run the kernels for examinations before processes are forked, which then share them: a tenth
    of a second once they are compiled."""
    recipe = preset("pillar")
    draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="train", unit=0)


Findings = tuple[int, Ledger]
"""Result of one shard: its position in the manifest, and its ledger."""


# MuJoCo would append its warnings to a file in the working folder
@quiet_mujoco()
def examine(task: Task) -> Findings:
    """Make all checks of one shard. Damaged files become faults, not errors.

    Args:
        task: The shard.

    Returns:
        Its position in the manifest, and its ledger.
    """
    ledger, contract, entry = Ledger(), task.contract, task.entry
    checks = chosen_checks(contract, quick=task.quick, own=task.own)

    def _make_checks(stage: str, subject: Any) -> None:
        """Make all checks of one level."""
        for check in checks:
            if (examination := getattr(check, stage)) is not None:
                with ledger.checking(check.name) as page:
                    try:
                        examination(subject, page)
                    except Exception as error:
                        # an error in one of our checks is a bug, not a fault of the dataset
                        if check in CHECKS:
                            raise
                        page.fault(str(as_own_code_error(error)))  # the user's own code fails

    worlds, path = None, contract.folder / entry.worlds
    # the archive first, as checks of samples use its worlds
    with ledger.checking(ARCHIVES.name) as page, open_file(path) as file:
        page.count(files=1)
        worlds = Worlds.read(task, file, path.name)
        _make_checks("file", SignedFile(file, path.name, entry.worlds_sha256))
        _make_checks("archive", worlds)
    path = contract.folder / entry.file
    with ledger.checking(LAYOUT.name) as page:
        with open_file(path) as file:
            # hashing a file of unlimited size could take hours
            if size_of(file) <= max_bytes(contract.layout, entry.samples):
                _make_checks("file", SignedFile(file, path.name, entry.sha256))
        opened = open_shard(path, entry.samples, contract.layout)
        if opened.stray_bytes:
            raise CorruptFileError(
                f"{opened.name}: {opened.stray_bytes} of its bytes belong to no sample"
            )
        opened.check_origin(
            split=entry.split, first_world=entry.first_world, worlds_sha256=entry.worlds_sha256
        )
        page.count(files=1)
        shard = Shard(task, worlds, opened, opened.rejected())
        _make_checks("shard", shard)
        stored = [name for name in contract.fields if not (task.quick and FIELDS[name]["derived"])]
        for row in range(entry.samples):
            # a sample that cannot be unpacked does not end the walk
            with ledger.checking(LAYOUT.name) as page:
                page.count(samples=1)
                # read-only unless expensive checks call kernels, which take writable arrays
                fields = {name: opened.value(name, row, read_only=task.quick) for name in stored}
                _make_checks(
                    "sample", RawSample(shard, row, fields, opened.value(DIGEST, row).tobytes())
                )
    return task.number, ledger


SECONDS, SECONDS_A_SAMPLE = 120.0, 0.5
"""Time limit of a shard's examination, seconds, and the addition for each sample."""
MEMORY_BYTES = 6 << 30
"""Address space of a shard's examination beyond that of the process, bytes."""


def verify(
    dataset: Any,
    *,
    quick: bool = False,
    seed: int = 0,
    kind: str | None = None,
    own: Sequence[str] = (),
    workers: int = 1,
    execute: Executor | None = None,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
) -> Report:
    """Check a dataset against the format, and with the user's checks.

    Args:
        dataset: As for `scenegen.load`. Of a collection or selection, every dataset is checked
            completely, and also whether they can be read together.
        quick: Whether only quick checks are made.
        seed: Seed of the samples that are cast and drawn again.
        kind: A user's own kind, which may be imported to draw worlds again; of a collection, those
            of its datasets of this kind. No module is imported because a manifest names it.
        own: The user's checks, as ``module:Object``, each a `Check`.
        workers: Number of processes, which examine a shard each. A crash of one is a fault.
        execute: Executor of the examinations, instead of `workers`. If it leaves shards to other
            processes, checks that compare all shards are skipped.
        on_start: Called with the number of samples when the workers have started.
        on_done: Called with the number of samples of each examined shard.

    Returns:
        The report. Faults never raise errors.

    Raises:
        DatasetError: if there is no dataset, none of this `kind`, or a check of `own` does not
            exist.
        GenerationError: if `execute` cannot finish a shard.
    """
    execute = execute or Local("", workers)
    walks = [
        _Walk(folder, quick=quick, seed=seed, kind=folder_kind, own=own, execute=execute)
        for folder, folder_kind in _folders_of(dataset, kind)
    ]
    samples = sum(walk.samples for walk in walks)
    for number, walk in enumerate(walks):
        # once, with the samples of all datasets: one bar shows the progress of all
        walk.run((lambda: on_start(samples)) if number == 0 else (lambda: None), on_done)
    outcomes = [outcome for walk in walks for outcome in walk.outcomes]
    if len(walks) > 1:
        outcomes = [
            replace(outcome, name=f"{walk.folder.name}: {outcome.name}")
            for walk in walks
            for outcome in walk.outcomes
        ]
        outcomes.append(_together(walks))
    return Report(
        folder=str(dataset), quick=quick, seed=seed, samples=samples, checks=tuple(outcomes)
    )


def _folders_of(name: Any, kind: str | None) -> list[tuple[Path, str | None]]:
    """Folders of the datasets of a name, each with `kind` if that may be imported for it. The
    manifest of a single dataset is not read here: damage is a fault to report."""
    folder = locate(name)
    if (folder / NAME).exists():
        return [(folder, kind)]
    # incomplete datasets, too: what they lack is a fault to report
    datasets = open_data(name, partial=True).datasets
    kinds = dict.fromkeys(dataset.manifest.kind for dataset in datasets)
    if kind is not None and kind not in kinds:
        raise DatasetError(
            f"--kind {kind}: the datasets' kinds are {', '.join(map(short_repr, kinds))}; leave "
            "--kind out, or give one of these"
        )
    return [
        (dataset.folder, kind if dataset.manifest.kind == kind else None) for dataset in datasets
    ]


class _Walk:
    """Examination of one dataset."""

    def __init__(
        self,
        folder: Path,
        *,
        quick: bool,
        seed: int,
        kind: str | None,
        own: Sequence[str],
        execute: Executor,
    ):
        self.folder, self.ledger, self._execute = folder, Ledger(), execute
        self._quick = quick
        self.contract = read_contract(folder, self.ledger, kind)
        self.outcomes: list[Outcome] = []
        self._checks: list[Check] = []
        self._all_tasks: list[Task] = []
        if self.contract is not None:
            with reraise_as(DatasetError, "--check: "):
                self._checks = chosen_checks(self.contract, quick=quick, own=own)
            self._all_tasks = _tasks(self.contract, quick=quick, seed=seed, own=own)
        self._tasks = execute.mine(self._all_tasks)
        self.samples = sum(task.entry.samples for task in self._tasks)

    @property
    def sees_all(self) -> bool:
        """Whether this process examines all shards."""
        return len(self._tasks) == len(self._all_tasks)

    def run(self, on_start: Begun, on_done: Counted) -> None:
        """Examine all shards, then the dataset.

        Args:
            on_start: Called when the workers have started.
            on_done: Called with the number of samples of each examined shard.
        """
        # nothing else can be examined
        if self.contract is None:
            self.outcomes.append(self.ledger[MANIFEST.name].outcome(MANIFEST.name))
            return
        order, early = deque(task.number for task in self._tasks), dict[int, Ledger]()
        if self._tasks and not self._quick:
            warm_up()
        examination = _Examination(examine, _seconds, MEMORY_BYTES, _given_up)
        with closing(self._execute(examination, self._tasks, on_start)) as results:
            for number, findings in results:
                early[number] = findings
                # ledgers are added in the order of shards; only early ones wait in memory
                while order and order[0] in early:
                    self.ledger.add(early.pop(order.popleft()))
                    self.ledger[EXAMINED.name].count(shards=1)
                on_done(self._all_tasks[number].entry.samples)
        for check in self._checks:
            with self.ledger.checking(check.name) as page:
                if check.folder is not None and self.sees_all:
                    check.folder(self.contract, page)
                elif check.folder is not None:
                    page.skipped = (
                        f"compares all {len(self._all_tasks)} shards, and {len(self._tasks)} are "
                        f"examined here"
                    )
                # a check that examined nothing must not count as passed
                if not (page.faults or page.skipped or page.counts):
                    page.skipped = "counted nothing that it examined: see what failed"
            self.outcomes.append(page.outcome(check.name))


def _together(walks: Sequence[_Walk]) -> Outcome:
    """Check that datasets that are read as one share no world between splits, and no sample."""
    ledger, name = Ledger(), "together"
    with ledger.checking(name) as page:
        if not all(walk.sees_all for walk in walks):
            page.skipped = "compares all shards, and a part of them is examined here"
            return page.outcome(name)
        split_of, owner = dict[bytes, str](), dict[bytes, str]()
        for walk in walks:
            if walk.contract is None:
                continue
            page.count(datasets=1)
            for split, digest in world_digests(walk.contract, walk.ledger["splits"]):
                location = f"{walk.folder.name}, {split}"
                first_split = split_of.setdefault(digest, split)
                first_owner = owner.setdefault(digest, location)
                page.expect(
                    first_split == split,
                    f"{location}: a world has the same solids as one of {first_owner}; no world "
                    "may be in two splits",
                )
            digests = b"".join(walk.ledger["digest"].kept)
            page.count(samples=len(digests) // 32, shards=len(walk.contract.shards))
            for n in range(0, len(digests), 32):
                # prefixed, as worlds and samples share one table
                key = b"sample" + digests[n : n + 32]
                first_owner = owner.setdefault(key, walk.folder.name)
                page.expect(
                    first_owner == walk.folder.name,
                    f"{walk.folder.name}: holds a sample of {first_owner}; leave one of the two "
                    "out",
                )
    return page.outcome(name)


class _Examination(Limited):
    """Fetches the task's files from a store before limits apply: a slow store is no fault of the
    dataset."""

    def __call__(self, task: Task) -> Findings:
        for name in (task.entry.file, task.entry.worlds):
            fetch(task.contract.folder / name)
        return super().__call__(task)


def _tasks(contract: Manifest, *, quick: bool, seed: int, own: Iterable[str]) -> list[Task]:
    """Tasks of all shards. The list of shards is left out of their manifests: pickling it with each
    task would take quadratic time."""
    bare = msgspec.structs.replace(contract, shards=())
    # rounded up, so that no more than MAX_TWINS are compared
    twins_of = -(-sum(entry.samples for entry in contract.shards) // MAX_TWINS) or 1
    return [
        Task(
            contract=bare,
            entry=entry,
            number=number,
            quick=quick,
            seed=seed,
            twins_of=twins_of,
            own=tuple(own),
        )
        for number, entry in enumerate(contract.shards)
    ]


def _seconds(task: Task) -> float:
    return SECONDS + SECONDS_A_SAMPLE * task.entry.samples


def _given_up(task: Task, reason: str) -> Findings:
    """Findings of a shard whose process was ended."""
    ledger = Ledger()
    fault = f"{task.entry.file} or {task.entry.worlds}: examining it {reason}"
    ledger[EXAMINED.name].fault(fault)
    return task.number, ledger
