"""Every check, one object each. To add one, write it into the file that it belongs to."""

from scenegen.verify.check import Check
from scenegen.verify.checks import derived, files, near_twins, repeated, splits, stored

CHECKS: tuple[Check, ...] = (
    *files.CHECKS,
    *stored.CHECKS,
    *splits.CHECKS,
    *derived.CHECKS,
    *near_twins.CHECKS,
    *repeated.CHECKS,
)
"""All checks, in the order of the report: those that `--quick` makes come first."""
