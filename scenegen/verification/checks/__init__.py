"""Every check, one object each. A new one is written into the file of its like, and nowhere
else."""

from scenegen.verification.check import Check
from scenegen.verification.checks import between_splits, files, repeated, stored

GROUPS = (files, stored, between_splits, repeated)

CHECKS: tuple[Check, ...] = tuple(
    sorted((check for group in GROUPS for check in group.CHECKS), key=lambda check: not check.quick)
)
"""All checks in the order of the report: those that `--quick` makes come first."""
