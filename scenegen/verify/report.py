"""What verification finds: a ledger of faults while it runs, and a report of checks in the end."""

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from scenegen.errors import BrokenError as BrokenError

CHECKS = {
    "manifest": True,
    "examined": True,
    "checksums": True,
    "layout": True,
    "archives": True,
    "digest": True,
    "names": True,
    "centred": True,
    "laws": True,
    "splits": True,
    "tudf": False,
    "voxels": False,
    "free": False,
    "occupancy": False,
    "near-twins": False,
    "rays": False,
    "regenerated": False,
}
"""Every check, in the order of the report, and whether `quick` makes it. docs/verify.md says what each proves."""

TOLD = 3
"""Faults of one check that are written out; the others are counted."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """What one check found."""

    name: str
    ok: bool
    detail: str
    """What was examined; of a failed check, its first faults: file, sample, what was expected."""
    skipped: bool
    """Whether it could not be made here, for the reason in `detail`; a skipped check does not fail."""
    faults: int
    seconds: float
    """Of all processes together."""
    counts: dict[str, int]
    """How much was examined, by kind: samples, files, rays, …"""


@dataclass(frozen=True, kw_only=True)
class Report:
    """The outcome of a verification."""

    folder: str
    quick: bool
    seed: int
    samples: int
    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """Whether no check failed."""
        return all(check.ok for check in self.checks)

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the checks that failed."""
        return tuple(check.name for check in self.checks if not check.ok)

    def to_json(self) -> dict[str, Any]:
        """The report as plain values."""
        whole = {"folder": self.folder, "quick": self.quick, "seed": self.seed, "samples": self.samples}
        return {**whole, "ok": self.ok, "failed": list(self.failed), "checks": [vars(check) for check in self.checks]}


@dataclass
class _Entry:
    faults: int = 0
    told: list[str] = field(default_factory=list)
    skipped: str = ""
    seconds: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    notes: dict[str, float] = field(default_factory=dict)


class Ledger:
    """Faults, times and counts by check, while they are being found. It can be pickled, and added to another."""

    def __init__(self) -> None:
        self._entries = {name: _Entry() for name in CHECKS}
        self._inner = 0.0  # seconds of the checks within the one being made

    def fault(self, check: str, line: str) -> None:
        """Write down a fault: one line, which names the file, the sample and what was expected."""
        entry = self._entries[check]
        entry.faults += 1
        if len(entry.told) < TOLD:
            entry.told.append(line)

    def expect(self, check: str, holds: bool, line: str) -> bool:
        """Write down a fault unless `holds`."""
        if not holds:
            self.fault(check, line)
        return holds

    def skip(self, check: str, why: str) -> None:
        """Say that a check cannot be made, and why."""
        self._entries[check].skipped = why

    def excuse(self, check: str, why: str) -> None:
        """Make the faults of a check reasons to skip it: it stays told how many there are, and what was examined."""
        entry = self._entries[check]
        if entry.faults:
            entry.skipped = why
            entry.counts["come out otherwise"] += entry.faults
            entry.faults, entry.told = 0, []

    def skip_untouched(self, checks: Iterable[str], why: str) -> None:
        """Say of those `checks` that examined nothing why that is."""
        for name in checks:
            entry = self._entries[name]
            if not (entry.faults or entry.skipped or entry.counts):
                entry.skipped = why

    def count(self, check: str, **counts: int) -> None:
        """Add to what a check examined."""
        entry = self._entries[check].counts
        for what, count in counts.items():
            entry[what] += count

    def note_greatest(self, check: str, what: str, value: float) -> None:
        """Keep the greatest `value` of a figure that the report shall name."""
        notes = self._entries[check].notes
        notes[what] = max(notes.get(what, 0.0), value)

    def add(self, other: "Ledger") -> None:
        """Take in another ledger's entries."""
        for name, theirs in other._entries.items():
            ours = self._entries[name]
            ours.faults += theirs.faults
            ours.told = (ours.told + theirs.told)[:TOLD]
            ours.skipped = ours.skipped or theirs.skipped
            ours.seconds += theirs.seconds
            ours.counts.update(theirs.counts)
            for what, value in theirs.notes.items():
                self.note_greatest(name, what, value)

    @contextmanager
    def checking(self, check: str) -> Iterator[None]:
        """Time what belongs to a check, less the checks within; what cannot be examined becomes its fault."""
        begin, before, self._inner = time.perf_counter(), self._inner, 0.0
        try:
            yield
        except BrokenError as error:
            self.fault(check, str(error))
        finally:
            whole = time.perf_counter() - begin
            self._entries[check].seconds += whole - self._inner
            self._inner = before + whole

    def checks(self, *, quick: bool) -> tuple[Check, ...]:
        """The report's checks: those that `quick` leaves out, or that had nothing to examine, are not there."""
        found = []
        for name, in_quick in CHECKS.items():
            entry = self._entries[name]
            if (quick and not in_quick) or not (entry.faults or entry.skipped or entry.counts):
                continue
            found.append(
                Check(
                    name=name,
                    ok=not entry.faults,
                    detail=_detail(entry),
                    skipped=bool(entry.skipped) and not entry.faults,
                    faults=entry.faults,
                    seconds=entry.seconds,
                    counts=dict(entry.counts),
                )
            )
        return tuple(found)


def _detail(entry: _Entry) -> str:
    if entry.faults:
        more = entry.faults - len(entry.told)
        return "; ".join(entry.told) + (f"; and {more} more" if more else "")
    parts = [f"{count} {what}" for what, count in entry.counts.items()]
    examined = ", ".join(parts + [f"{what} {value:.2g}" for what, value in entry.notes.items()])
    if entry.skipped:
        return f"{entry.skipped} ({examined})" if examined else entry.skipped
    return examined
