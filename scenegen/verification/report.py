"""Results of verification: a ledger of faults during the run, and a final report of checks."""

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from scenegen.base.errors import CorruptFileError, plural
from scenegen.base.files import Json

MAX_LINES = 3
"""Number of faults of a check that are described; others are counted."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one check."""

    name: str
    ok: bool
    detail: str
    """What was examined; or, if the check failed, its first faults."""
    skipped: bool
    """Whether the check could not be made here, for the reason in `detail`. This is no failure."""
    faults: int
    seconds: float
    """Time of the check in all processes, seconds."""
    counts: dict[str, int]
    """Amounts examined, by kind: samples, files, rays, …"""
    differing: dict[str, int]
    """Numbers of flights or samples that differ when they are made again with other software. This
    is no fault, as bits may depend on software, and no proof either."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Result of a verification."""

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
        """Names of failed checks."""
        return tuple(check.name for check in self.checks if not check.ok)

    @property
    def differing(self) -> tuple[str, ...]:
        """Names of checks with results that differ because of other software."""
        return tuple(check.name for check in self.checks if check.differing)

    def to_json(self) -> Json:
        """The report as JSON values."""
        summary = {"ok": self.ok, "failed": list(self.failed), "differing": list(self.differing)}
        return {**vars(self), **summary, "checks": [vars(check) for check in self.checks]}


@dataclass
class Page:
    """Results of one check so far: faults, counts, time."""

    faults: int = 0
    listed: list[str] = field(default_factory=list)
    skipped: str = ""
    why: str = ""
    """Why `differing` results are no fault."""
    differing: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    notes: dict[str, float] = field(default_factory=dict)
    kept: list[Any] = field(default_factory=list)
    """Data of the check for its examination of the whole dataset, in the order of shards and
    samples."""

    def fault(self, line: str) -> None:
        """Record a fault: one line with the file, the sample and what was expected."""
        self.faults += 1
        if len(self.listed) < MAX_LINES:
            self.listed.append(line)

    def expect(self, holds: Any, line: str) -> bool:
        """Record a fault unless a condition holds.

        Args:
            holds: The condition.
            line: Description of the fault.

        Returns:
            Whether it holds.
        """
        if not holds:
            self.fault(line)
        return bool(holds)

    def differ(self, why: str, **counts: int) -> None:
        """Record results that differ for the reason `why`, which is no fault."""
        self.why = self.why or why
        self.differing.update(counts)

    def count(self, **counts: int) -> None:
        """Add to the amounts examined."""
        for noun, count in counts.items():
            self.counts[noun] += count

    def note_greatest(self, figure: str, value: float) -> None:
        """Keep the maximum of a figure for the report.

        Args:
            figure: Name of the figure.
            value: A value of it.
        """
        self.notes[figure] = max(self.notes.get(figure, 0.0), value)

    def add(self, page: "Page") -> None:
        """Add the results of the same check of another shard."""
        self.faults += page.faults
        self.listed = (self.listed + page.listed)[:MAX_LINES]
        self.skipped = self.skipped or page.skipped
        self.differ(page.why, **page.differing)
        self.seconds += page.seconds
        self.counts.update(page.counts)
        self.kept += page.kept
        for figure, value in page.notes.items():
            self.note_greatest(figure, value)

    def detail(self) -> str:
        """Text of the check's result."""
        unlisted = self.faults - len(self.listed)
        if self.faults:
            return "; ".join([*self.listed, f"and {unlisted} more"] if unlisted else self.listed)
        parts = [plural(count, noun) for noun, count in self.counts.items()]
        parts += [f"{noun} {value:.2g}" for noun, value in self.notes.items()]
        examined = ", ".join(parts)
        otherwise = " and ".join(f"{count} {noun}" for noun, count in self.differing.items())
        reason = f"{otherwise} come out otherwise here, {self.why}" if otherwise else self.skipped
        return f"{reason} ({examined})" if reason and examined else reason or examined

    def outcome(self, check: str) -> Outcome:
        """Result of the check, under its name."""
        return Outcome(
            name=check,
            ok=not self.faults,
            detail=self.detail(),
            # a fault outweighs a reason to skip
            skipped=bool(self.skipped) and not self.faults and not self.differing,
            faults=self.faults,
            seconds=self.seconds,
            counts=dict(self.counts),
            differing=dict(self.differing),
        )


class Ledger(dict[str, Page]):
    """A page for each check. It can be pickled, and added to another ledger."""

    _inner = 0.0
    """Time of the checks inside the current one, seconds."""

    def __missing__(self, check: str) -> Page:
        return self.setdefault(check, Page())

    def add(self, ledger: "Ledger") -> None:
        """Add the pages of another ledger."""
        for name, theirs in ledger.items():
            self[name].add(theirs)

    @contextmanager
    def checking(self, check: str) -> Iterator[Page]:
        """Time a check, without the checks inside the block. A CorruptFileError becomes its
        fault."""
        page, begin, outer, self._inner = self[check], time.perf_counter(), self._inner, 0.0
        try:
            yield page
        except CorruptFileError as error:
            page.fault(str(error))
        finally:
            elapsed = time.perf_counter() - begin
            page.seconds += elapsed - self._inner
            self._inner = outer + elapsed
