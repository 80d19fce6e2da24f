"""What verification finds: a ledger of faults while it runs, and a report of checks in the end."""

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from scenegen.base.errors import BrokenError as BrokenError
from scenegen.base.errors import plural
from scenegen.base.files import Json

TOLD = 3
"""This many faults of one check are written out; the others are counted."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What one check found."""

    name: str
    ok: bool
    detail: str
    """What was examined; or, where the check failed, its first faults: file, sample, what was
    expected."""
    skipped: bool
    """Whether it could not be made here, for the reason in `detail`; a skipped check does not
    fail."""
    faults: int
    seconds: float
    """Time that the check took, in all processes together."""
    counts: dict[str, int]
    """How much was examined, by kind: samples, files, rays, …"""
    differing: dict[str, int]
    """How many flights or samples come out otherwise here, of a dataset that other software made:
    no fault, for the bits may depend on it, and no proof either."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """The outcome of a verification."""

    folder: str
    quick: bool
    seed: int
    samples: int
    checks: tuple[Outcome, ...]

    @property
    def ok(self) -> bool:
        """Whether no check failed."""
        return not self.failed

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the checks that failed."""
        return tuple(check.name for check in self.checks if not check.ok)

    @property
    def differing(self) -> tuple[str, ...]:
        """Names of the checks in which something comes out otherwise than other software made
        it."""
        return tuple(check.name for check in self.checks if check.differing)

    def to_json(self) -> Json:
        """The report as plain values."""
        found = {"ok": self.ok, "failed": list(self.failed), "differing": list(self.differing)}
        return {**vars(self), **found, "checks": [vars(check) for check in self.checks]}


@dataclass
class Page:
    """What one check has found so far: faults, counts, time."""

    faults: int = 0
    told: list[str] = field(default_factory=list)
    skipped: str = ""
    why: str = ""
    """Why what is `differing` need not have the dataset's bits."""
    differing: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    notes: dict[str, float] = field(default_factory=dict)
    kept: list[Any] = field(default_factory=list)
    """What the check leaves for its examination of the whole folder, in the order of shards and
    samples."""

    def fault(self, line: str) -> None:
        """Write down a fault: one line, which names the file, the sample and what was expected."""
        self.faults += 1
        if len(self.told) < TOLD:
            self.told.append(line)

    def expect(self, holds: Any, line: str) -> bool:
        """Write down a fault unless `holds`."""
        if not holds:
            self.fault(line)
        return bool(holds)

    def differ(self, why: str, **counts: int) -> None:
        """Write down how much comes out otherwise, which is no fault for the reason `why`."""
        self.why = self.why or why
        self.differing.update(counts)

    def count(self, **counts: int) -> None:
        """Add to what was examined."""
        for what, count in counts.items():
            self.counts[what] += count

    def note_greatest(self, what: str, value: float) -> None:
        """Keep the greatest `value` of a figure that the report shall name."""
        self.notes[what] = max(self.notes.get(what, 0.0), value)

    def add(self, other: "Page") -> None:
        """Take in what the same check found elsewhere."""
        self.faults += other.faults
        self.told = (self.told + other.told)[:TOLD]
        self.skipped = self.skipped or other.skipped
        self.differ(other.why, **other.differing)
        self.seconds += other.seconds
        self.counts.update(other.counts)
        self.kept += other.kept
        for what, value in other.notes.items():
            self.note_greatest(what, value)

    def detail(self) -> str:
        """What the report says of it."""
        more = self.faults - len(self.told)
        if self.faults:
            return "; ".join([*self.told, f"and {more} more"] if more else self.told)
        parts = [plural(count, what) for what, count in self.counts.items()]
        parts += [f"{what} {value:.2g}" for what, value in self.notes.items()]
        examined = ", ".join(parts)
        otherwise = " and ".join(f"{count} {what}" for what, count in self.differing.items())
        reason = f"{otherwise} come out otherwise here, {self.why}" if otherwise else self.skipped
        return f"{reason} ({examined})" if reason and examined else reason or examined

    def outcome(self, check: str) -> Outcome:
        """What the report says of the check of that name."""
        return Outcome(
            name=check,
            ok=not self.faults,
            detail=self.detail(),
            skipped=bool(self.skipped) and not self.faults and not self.differing,
            faults=self.faults,
            seconds=self.seconds,
            counts=dict(self.counts),
            differing=dict(self.differing),
        )


class Ledger(dict[str, Page]):
    """A page for each check, by its name, while checks are being made. It can be pickled, and added
    to another."""

    _inner = 0.0
    """Seconds of the checks within the one being made."""

    def __missing__(self, check: str) -> Page:
        return self.setdefault(check, Page())

    def add(self, other: "Ledger") -> None:
        """Take in another ledger's pages."""
        for name, theirs in other.items():
            self[name].add(theirs)

    @contextmanager
    def checking(self, check: str) -> Iterator[Page]:
        """Time what belongs to a check, less the checks within; what cannot be examined becomes its
        fault."""
        page, begin, before, self._inner = self[check], time.perf_counter(), self._inner, 0.0
        try:
            yield page
        except BrokenError as error:
            page.fault(str(error))
        finally:
            whole = time.perf_counter() - begin
            page.seconds += whole - self._inner
            self._inner = before + whole
