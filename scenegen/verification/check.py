"""What a check is: its name, what it proves, and where it looks."""

from collections.abc import Callable
from dataclasses import dataclass

from scenegen.verification.contract import Contract
from scenegen.verification.report import Page
from scenegen.verification.stages import Sample, Shard, SignedFile, Worlds


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check of a dataset.

    Its examinations are functions, one for each stage at which it looks. Each is handed what the
    stage is about, and the check's page of the ledger: there it writes down faults, counts what it
    examined, and keeps what it needs at the end. A BrokenError that it raises becomes a fault of
    this check.
    """

    name: str
    proves: str
    """One sentence: what holds of a dataset that passes."""
    quick: bool = False
    """Whether `--quick` makes it."""
    field: str = ""
    """The field of samples that it examines, where not every dataset stores that field."""
    file: Callable[[SignedFile, Page], None] | None = None
    """Looks at the bytes of a shard or of an archive."""
    archive: Callable[[Worlds, Page], None] | None = None
    """Looks at the worlds of a shard's archive, which are screened by then."""
    shard: Callable[[Shard, Page], None] | None = None
    """Looks at a shard, whose file is open by then, before its samples."""
    sample: Callable[[Sample, Page], None] | None = None
    """Looks at one sample, whose fields are unpacked by then."""
    folder: Callable[[Contract, Page], None] | None = None
    """Looks at the whole folder in the end; the page holds what the stages before kept."""

    def applies(self, contract: Contract, *, quick: bool) -> bool:
        """Whether this check is made of a dataset."""
        return (self.quick or not quick) and self.field in ("", *contract.fields)
