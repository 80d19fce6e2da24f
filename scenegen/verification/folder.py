"""`verify` holds a dataset folder against the contract: every shard in a process of its own, then
all together."""

from collections import deque
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from scenegen.dataset.sensor import files_of
from scenegen.run import Executor
from scenegen.run.local import Local
from scenegen.run.workers import Limited
from scenegen.stores.cache import fetch_all, note_of
from scenegen.verification.checks import CHECKS
from scenegen.verification.checks.files import EXAMINED
from scenegen.verification.contract import Contract, read_contract
from scenegen.verification.regenerate import why_not_comparable, why_not_scanned
from scenegen.verification.report import Ledger, Report
from scenegen.verification.shard import Findings, examine
from scenegen.verification.stages import Task
from scenegen.verification.twins import MOST_TWINS
from scenegen.verification.warm import warm_up

SECONDS, SECONDS_A_SAMPLE, MOST_SECONDS = 120.0, 0.5, 24 * 3600.0
"""A shard whose examination takes longer than this and as much for every sample, or than a day, is
given up."""
MEMORY_BYTES = 6 << 30
"""Address space that examining one shard may take beyond what the process has."""


def verify(
    folder: Path,
    *,
    quick: bool = False,
    seed: int = 0,
    kind: str | None = None,
    workers: int = 1,
    execute: Executor | None = None,
    on_start: Callable[[int], None] = lambda samples: None,
    on_done: Callable[[int], None] = lambda samples: None,
) -> Report:
    """Check the dataset in `folder`; `quick` makes the cheap checks alone. `scenegen.verification.checks`
    has them all.

    `workers` processes of this machine examine a shard each, or whatever `execute` has do it, in
    processes of their own; none can take this one down. Where others see to a part of the shards,
    what compares all of them is skipped. `seed` chooses the samples that are cast and made anew.
    `kind` names a user's own kind, by which worlds may be drawn again: no module is imported
    because a manifest names it. `on_start` is called with the number of samples once the processes
    run, `on_done` with that of every shard done. A fault fails a check of the report, whatever it
    is; only a folder that holds no dataset at all, or one of another `kind`, raises: DatasetError;
    and a shard that `execute` loses for good: GenerationError.
    """
    execute = execute or Local("", workers)
    ledger = Ledger()
    contract = read_contract(folder, ledger, kind)
    if contract is None:
        outcomes = ledger.outcomes(check.name for check in CHECKS)
        return Report(folder=str(folder), quick=quick, seed=seed, samples=0, checks=outcomes)
    checks = [check for check in CHECKS if check.applies(contract, quick=quick)]
    whole = _tasks(contract, quick=quick, seed=seed)
    tasks = execute.mine(whole)
    samples = sum(task.entry.samples for task in tasks)
    order, waiting = deque(task.number for task in tasks), dict[int, Findings]()
    if tasks and not quick:
        warm_up()
    guarded = _Examination(examine, _seconds, MEMORY_BYTES, _given_up)
    with closing(execute(guarded, tasks, lambda: on_start(samples))) as results:
        for found in results:
            waiting[found.number] = found
            while (
                order and order[0] in waiting
            ):  # in the order of shards, and no more of them kept than are early
                ledger.add(waiting.pop(order.popleft()).ledger)
                ledger.page(EXAMINED.name).count(shards=1)
            on_done(found.samples)
    for check in checks:
        with ledger.checking(check.name) as page:
            if check.folder is not None and len(tasks) == len(whole):
                check.folder(contract, page)
            elif check.folder is not None:
                page.skipped = (
                    f"compares all {len(whole)} shards, and {len(tasks)} are examined here"
                )
            if not page.touched:
                page.skipped = "nothing that could be examined: see what failed"
    outcomes = ledger.outcomes(check.name for check in checks)
    return Report(folder=str(folder), quick=quick, seed=seed, samples=samples, checks=outcomes)


class _Examination(Limited[Task, Findings]):
    """Copies on another machine what a task reads of a place, before limits are set: that a store
    is slow or refuses is no fault of the dataset."""

    def __call__(self, task: Task) -> Findings:
        contract, entry = task.contract, task.entry
        if note_of(contract.folder) is not None:
            fetch_all(
                contract.folder, [entry.file, entry.worlds, *files_of(contract.parameters["lidar"])]
            )
        return super().__call__(task)


def _tasks(contract: Contract, *, quick: bool, seed: int) -> list[Task]:
    """One a shard; none carries the list of all shards, which would make their sum grow as its
    square."""
    homes: list[dict[str, Any]] = []
    every = -(-sum(entry.samples for entry in contract.shards) // MOST_TWINS) or 1
    for home in contract.homes:
        lean = replace(home, shards=())
        lean.recipe, lean.fingerprint  # noqa: B018 (worked out once, and carried along)
        reasons = {"not_comparable": why_not_comparable(home), "not_scanned": why_not_scanned(home)}
        homes.append({"contract": lean, **reasons})
    return [
        Task(
            entry=entry,
            number=number,
            start=start,
            quick=quick,
            seed=seed,
            twins_of=every,
            **homes[getattr(entry, "source", 0)],
        )
        for number, (entry, start) in enumerate(zip(contract.shards, contract.starts, strict=True))
    ]


def _seconds(task: Task) -> float:
    return min(SECONDS + SECONDS_A_SAMPLE * task.entry.samples, MOST_SECONDS)


def _given_up(task: Task, reason: str) -> Findings:
    """What is left of a shard whose process was ended."""
    found = Findings(task.number, task.entry.samples)
    found.ledger.page(EXAMINED.name).fault(
        f"{task.entry.file} or {task.entry.worlds}: examining it {reason}"
    )
    return found
