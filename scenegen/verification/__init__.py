"""Check a dataset folder against docs/format.md. docs/verify.md describes what each check proves,
and what it cannot detect."""

from scenegen.verification.check import Check
from scenegen.verification.folder import verify
from scenegen.verification.report import Outcome, Page, Report

__all__ = ["Check", "Outcome", "Page", "Report", "verify"]
