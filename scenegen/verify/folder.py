"""`verify`: a whole dataset folder against the contract."""

import hashlib
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.layout import ShardFile, open_file, open_shard
from scenegen.verify.contract import Contract, read_contract
from scenegen.verify.regenerate import why_not_comparable
from scenegen.verify.report import CHECKS, Ledger, Report
from scenegen.verify.shard import Findings, Task, examine
from scenegen.verify.twins import OBSERVED_IOU, OCCUPIED_IOU, STANDING_IOU, candidates, overlap, standing_overlap
from scenegen.verify.warm import warm_up
from scenegen.workers import Limits, run

SECONDS, SECONDS_A_SAMPLE, MOST_SECONDS = 120.0, 0.5, 24 * 3600.0
"""A shard whose examination takes longer than this and as much for every sample, or than a day, is given up."""
MEMORY_BYTES = 6 << 30
"""Address space that examining one shard may take beyond what the process has."""


def verify(
    folder: Path,
    *,
    quick: bool = False,
    seed: int = 0,
    kind: str | None = None,
    workers: int = 1,
    on_start: Callable[[int], None] = lambda samples: None,
    on_done: Callable[[int], None] = lambda samples: None,
) -> Report:
    """Check the dataset in `folder`; `quick` makes the cheap checks alone. docs/verify.md says what each proves.

    `workers` processes examine a shard each; none can take this one down. `seed` chooses the samples that are cast and
    made anew. `kind` names a user's own kind, by which worlds may be drawn again: no module is imported because a
    manifest names it. `on_start` is called with the number of samples once the processes run, `on_done` with that of
    every shard done. A fault fails a check of the report, whatever it is; only a folder that holds no dataset at all,
    or one of another `kind`, raises: DatasetError.
    """
    ledger = Ledger()
    contract = read_contract(folder, ledger, kind)
    if contract is None:
        return Report(folder=str(folder), quick=quick, seed=seed, samples=0, checks=ledger.checks(quick=quick))
    reason = why_not_comparable(contract)
    tasks = [
        Task(contract=contract, number=number, start=start, quick=quick, seed=seed, not_comparable=reason)
        for number, start in enumerate(contract.starts)
    ]
    samples = sum(entry.samples for entry in contract.shards)
    limits = Limits(_seconds, MEMORY_BYTES, _given_up)
    findings: list[Findings] = []
    if tasks and not quick:
        warm_up()
    with closing(run(examine, tasks, workers, lambda: on_start(samples), limits=limits)) as results:
        for found in results:
            findings.append(found)
            on_done(found.samples)
    findings.sort(key=lambda found: found.number)
    for found in findings:
        ledger.add(found.ledger)
        ledger.count("examined", shards=1)
    _check_digest(contract, findings, ledger)
    _check_rejected(contract, findings, ledger)
    _check_splits(contract, findings, ledger)
    if not quick:
        _check_twins(contract, findings, ledger)
    derived_later = {"tudf", "free"} - set(contract.fields)
    ledger.skip_untouched(set(CHECKS) - derived_later, "nothing that could be examined: see what failed")
    return Report(folder=str(folder), quick=quick, seed=seed, samples=samples, checks=ledger.checks(quick=quick))


def _seconds(task: Task) -> float:
    return min(SECONDS + SECONDS_A_SAMPLE * task.entry.samples, MOST_SECONDS)


def _given_up(task: Task, reason: str) -> Findings:
    """What is left of a shard whose process was ended."""
    found = Findings(task.number, task.entry.samples)
    found.ledger.fault("examined", f"{task.entry.file} or {task.entry.worlds}: examining it {reason}")
    return found


def _check_digest(contract: Contract, findings: list[Findings], ledger: Ledger) -> None:
    """The dataset's digest is that of the samples that are there."""
    with ledger.checking("digest"):
        found = hashlib.sha256(b"".join(shard.digests for shard in findings)).hexdigest()
        ledger.expect(
            "digest",
            contract.digest in (None, found),
            f"{manifest.NAME}: digest {str(contract.digest)[:16]}…, the samples' is {found[:16]}…",
        )


def _check_rejected(contract: Contract, findings: list[Findings], ledger: Ledger) -> None:
    """The manifest counts the shards' rejections."""
    if not all(shard.rejected for shard in findings):
        return
    for what in ("worlds", "viewpoints"):
        total: Counter[str] = Counter()
        for shard in findings:
            total.update(shard.rejected[what])
        ledger.expect(
            "manifest",
            dict(total) == contract.rejected[what],
            f"{manifest.NAME}: rejected.{what} = {contract.rejected[what]}, the shards count {dict(total)}",
        )


def _check_splits(contract: Contract, findings: list[Findings], ledger: Ledger) -> None:
    """No world is in two splits."""
    with ledger.checking("splits"):
        owner: dict[bytes, tuple[str, int]] = {}
        for shard in findings:
            split = contract.shards[shard.number].split
            for digest, number in shard.worlds.items():
                other, theirs = owner.setdefault(digest, (split, number))
                ledger.expect(
                    "splits",
                    other == split,
                    f"world {number} of {split} has the same solids as world {theirs} of {other}, expected another one",
                )


def _check_twins(contract: Contract, findings: list[Findings], ledger: Ledger) -> None:
    """No sample shows next to the same map, seen next to the same way, as one of another split."""
    with ledger.checking("near-twins"), _Maps(contract) as maps:
        places = [(shard.number, row) for shard in findings for row in shard.rows]
        if not places:
            return
        ledger.count("near-twins", samples=len(places))
        splits = np.array([SPLITS.index(contract.shards[number].split) for number, _ in places])
        pairs, complete = candidates(
            np.array([signature for shard in findings for signature in shard.signatures]),
            np.array([fold for shard in findings for fold in shard.folds]),
            np.array([count for shard in findings for count in shard.observed]),
            splits,
        )
        ledger.count("near-twins", compared=len(pairs))
        found = 0
        for a, b in pairs:
            one, other = places[int(a)], places[int(b)]
            observed = overlap(maps.of("observed", *one), maps.of("observed", *other))
            if observed < OBSERVED_IOU:
                continue
            truths = maps.of("occupancy", *one), maps.of("occupancy", *other)
            occupied = overlap(*truths)
            if occupied >= OCCUPIED_IOU and standing_overlap(*truths) >= STANDING_IOU:
                found += 1
                ledger.fault(
                    "near-twins",
                    f"{contract.shards[one[0]].file}: sample {one[1]} shows the map of "
                    f"{contract.shards[other[0]].file}: sample {other[1]} (occupied IoU {occupied:.3f}, observed "
                    f"{observed:.3f}), expected another world",
                )
        if not complete and not found:
            ledger.skip("near-twins", f"too many maps are alike: {len(pairs)} pairs were compared, not all")


class _Maps:
    """Grids of any samples of a folder; its files stay open."""

    def __init__(self, contract: Contract):
        self._contract = contract
        self._files = ExitStack()
        self._shards: dict[int, ShardFile] = {}

    def __enter__(self) -> "_Maps":
        return self

    def __exit__(self, *error: object) -> None:
        self._files.close()

    def of(self, field: str, number: int, row: int) -> NDArray[np.bool_]:
        """A grid of sample `row` of shard `number`. Raises BrokenError."""
        if number not in self._shards:
            if len(self._shards) >= 100:
                self._files.close()
                self._shards.clear()
            entry = self._contract.shards[number]
            path = self._contract.folder / entry.file
            file = self._files.enter_context(open_file(path))
            self._shards[number] = open_shard(file, path, entry.samples, self._contract.layout)
        return self._shards[number].value(field, row)
