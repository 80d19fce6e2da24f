"""Check a dataset folder against docs/format.md: docs/verify.md says what each check proves, and
what it cannot see."""

from scenegen.verify.folder import verify
from scenegen.verify.report import Outcome, Report

__all__ = ["Outcome", "Report", "verify"]
