"""Prove a dataset folder against docs/format.md: what is checked, and how surely, is in docs/verify.md."""

from scenegen.verify.folder import verify
from scenegen.verify.report import Check, Report

__all__ = ["Check", "Report", "verify"]
