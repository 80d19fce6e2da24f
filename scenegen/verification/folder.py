"""`verify` holds a dataset folder against the contract: every shard is walked in a process of its
own, then the whole is."""

from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from scenegen.base.errors import DatasetError, raised_as, told
from scenegen.base.executors import Begun, Counted, Executor, unheard
from scenegen.base.files import size_of
from scenegen.base.mirrors import fetch
from scenegen.base.workers import Limited, Local
from scenegen.dataset.collection import open_data
from scenegen.dataset.layout import DIGEST, most_bytes, open_file, open_shard
from scenegen.dataset.locate import locate
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import NAME
from scenegen.draw.draw import draw_unit
from scenegen.draw.sample import FIELDS
from scenegen.draw.source import DrawnWorlds
from scenegen.verification.check import (
    OWN_CHECKS,
    Check,
    Sample,
    Shard,
    SignedFile,
    Task,
    Worlds,
)
from scenegen.verification.files import ARCHIVES, EXAMINED, LAYOUT, MANIFEST, read_contract
from scenegen.verification.files import CHECKS as OF_FILES
from scenegen.verification.repeated import CHECKS as REPEATED
from scenegen.verification.report import BrokenError, Ledger, Outcome, Report
from scenegen.verification.splits import CHECKS as BETWEEN_SPLITS
from scenegen.verification.splits import MOST_TWINS, world_digests
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
"""All checks in the order of the report: those that `--quick` makes come first."""


def chosen_checks(contract: Manifest, *, quick: bool, own: Iterable[str]) -> list[Check]:
    """The checks that are made of a dataset: those of ours that apply, then a user's `own`, always.
    Raises ValueError for a name that leads to no check."""
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
    """Run the kernels that examining a shard needs, which its processes then have: a tenth of a
    second once they are compiled."""
    recipe = preset("pillar")
    draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="train", unit=0)


Findings = tuple[int, Ledger]
"""What one shard's examination leaves for the whole folder's: its position in the manifest, and
what was found."""


@quiet_mujoco()
def examine(task: Task) -> Findings:
    """Make every check of one shard by itself. What is wrong with its files becomes faults in the
    ledger, and raises nothing."""
    ledger, contract, entry = Ledger(), task.contract, task.entry
    checks = chosen_checks(contract, quick=task.quick, own=task.own)

    def look(stage: str, at: Any) -> None:
        """Make every check that looks at this stage."""
        for check in checks:
            if (examination := getattr(check, stage)) is not None:
                with ledger.checking(check.name) as page:
                    try:
                        examination(at, page)
                    except Exception as error:
                        if check in CHECKS:
                            raise
                        page.fault(str(told(error)))  # the user's own code fails

    worlds, path = None, contract.folder / entry.worlds
    with ledger.checking(ARCHIVES.name) as page, open_file(path) as file:
        page.count(files=1)
        worlds = Worlds.read(task, file, path.name)
        look("file", SignedFile(file, path.name, entry.worlds_sha256))
        look("archive", worlds)
    path = contract.folder / entry.file
    with ledger.checking(LAYOUT.name) as page:
        with open_file(path) as file:
            if size_of(file) <= most_bytes(contract.layout, entry.samples):
                look("file", SignedFile(file, path.name, entry.sha256))
        opened = open_shard(path, entry.samples, contract.layout)
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
            # a sample that cannot be unpacked does not end the walk
            with ledger.checking(LAYOUT.name) as page:
                page.count(samples=1)
                fields = {name: opened.value(name, row, read_only=task.quick) for name in stored}
                look("sample", Sample(shard, row, fields, opened.value(DIGEST, row).tobytes()))
    return task.number, ledger


SECONDS, SECONDS_A_SAMPLE = 120.0, 0.5
"""A shard whose examination takes longer than this, and as much for every sample, is given up."""
MEMORY_BYTES = 6 << 30
"""Address space that examining one shard may take beyond what the process has."""


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
    """Check a dataset against the format, and by checks of your own.

    Args:
        dataset: What `scenegen.load` takes: of a collection or a selection, every dataset is
            checked whole, and that they go together.
        quick: Make the cheap checks alone.
        seed: Chooses the samples that are cast and made anew.
        kind: A user's own kind, by which worlds may be drawn again: no module is imported because a
            manifest names it.
        own: Checks of your own, ``module:Object``, each a `Check`.
        workers: Processes of this machine that examine a shard each; none can take this one down.
        execute: What has the shards examined, instead. Where others see to a part of them, what
            compares all of them is skipped.
        on_start: Called with the number of samples once the processes run.
        on_done: Called with the number of samples of every shard done.

    Returns:
        The report. A fault fails a check of it, whatever it is.

    Raises:
        DatasetError: The folder holds no dataset at all, or one of another `kind`; or a name of
            `own` leads to no check.
        GenerationError: `execute` lost a shard for good.
    """
    execute = execute or Local("", workers)
    walks = [
        _Walk(folder, quick=quick, seed=seed, kind=kind, own=own, execute=execute)
        for folder in _folders_of(dataset)
    ]
    samples = sum(walk.samples for walk in walks)
    for number, walk in enumerate(walks):
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


def _folders_of(name: Any) -> list[Path]:
    """The folders of the datasets that a name stands for. Of one dataset no manifest is read: that
    it is damaged is a fault to report."""
    folder = locate(name)
    if (folder / NAME).exists():
        return [folder]
    return [dataset.folder for dataset in open_data(name, partial=True).datasets]


class _Walk:
    """The examination of one dataset."""

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
            with raised_as(DatasetError, "--check: "):
                self._checks = chosen_checks(self.contract, quick=quick, own=own)
            self._all_tasks = _tasks(self.contract, quick=quick, seed=seed, own=own)
        self._tasks = execute.mine(self._all_tasks)
        self.samples = sum(task.entry.samples for task in self._tasks)

    @property
    def sees_all(self) -> bool:
        """Whether all shards are examined here, and none elsewhere."""
        return len(self._tasks) == len(self._all_tasks)

    def run(self, on_start: Begun, on_done: Counted) -> None:
        """Examine every shard, and then the whole."""
        if self.contract is None:
            self.outcomes.append(self.ledger[MANIFEST.name].outcome(MANIFEST.name))
            return
        order, waiting = deque(task.number for task in self._tasks), dict[int, Ledger]()
        if self._tasks and not self._quick:
            warm_up()
        guarded = _Examination(examine, _seconds, MEMORY_BYTES, _given_up)
        with closing(self._execute(guarded, self._tasks, on_start)) as results:
            for number, findings in results:
                waiting[number] = findings
                # in the order of shards, and no more of them kept than are early
                while order and order[0] in waiting:
                    self.ledger.add(waiting.pop(order.popleft()))
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
                if not (page.faults or page.skipped or page.counts):
                    page.skipped = "counted nothing that it examined: see what failed"
            self.outcomes.append(page.outcome(check.name))


def _together(walks: Sequence[_Walk]) -> Outcome:
    """Whether datasets that are read as one share no world between splits, and no sample."""
    ledger, name = Ledger(), "together"
    with ledger.checking(name) as page:
        if not all(walk.sees_all for walk in walks):
            page.skipped = "compares all shards, and a part of them is examined here"
            return page.outcome(name)
        split_of, where = dict[bytes, str](), dict[bytes, str]()
        for walk in walks:
            if walk.contract is None:
                continue
            page.count(datasets=1)
            shards = walk.contract.shards
            for split, digest in world_digests(walk.contract, walk.ledger["splits"]):
                place = f"{walk.folder.name}, {split}"
                before = split_of.setdefault(digest, split)
                other = where.setdefault(digest, place)
                page.expect(
                    before == split,
                    f"{place}: a world has the same solids as one of {other}; no world may be in "
                    "two splits",
                )
            digests = b"".join(walk.ledger["digest"].kept)
            first = sum(len(own) // 32 for own in walk.ledger["digest"].kept)
            page.count(samples=first, shards=len(shards))
            for n in range(0, len(digests), 32):
                own = b"sample" + digests[n : n + 32]
                other = where.setdefault(own, walk.folder.name)
                page.expect(
                    other == walk.folder.name,
                    f"{walk.folder.name}: holds a sample of {other}; leave one of the two out",
                )
    return page.outcome(name)


class _Examination(Limited):
    """Fetches on another machine what a task reads of a store, before limits are set: that a store
    is slow or refuses is no fault of the dataset."""

    def __call__(self, task: Task) -> Findings:
        for name in (task.entry.file, task.entry.worlds):
            fetch(task.contract.folder / name)
        return super().__call__(task)


def _tasks(contract: Manifest, *, quick: bool, seed: int, own: Iterable[str]) -> list[Task]:
    """One a shard; none carries the list of all shards, which would make their sum grow as its
    square."""
    bare = msgspec.structs.replace(contract, shards=())
    every = -(-sum(entry.samples for entry in contract.shards) // MOST_TWINS) or 1
    return [
        Task(
            contract=bare,
            entry=entry,
            number=number,
            quick=quick,
            seed=seed,
            twins_of=every,
            own=tuple(own),
        )
        for number, entry in enumerate(contract.shards)
    ]


def _seconds(task: Task) -> float:
    return SECONDS + SECONDS_A_SAMPLE * task.entry.samples


def _given_up(task: Task, reason: str) -> Findings:
    """What is left of a shard whose process was ended."""
    ledger = Ledger()
    fault = f"{task.entry.file} or {task.entry.worlds}: examining it {reason}"
    ledger[EXAMINED.name].fault(fault)
    return task.number, ledger
