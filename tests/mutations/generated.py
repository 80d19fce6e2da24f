"""`generate` on damaged wishes: what it writes, every reader takes."""

from pathlib import Path

import h5py
import numpy as np

from tests.mutations.case import Attempt, words


def generated(asked, damage):
    """A dataset made by the words `asked`; where that succeeds, `verify --quick` passes it and its
    numbers can be such."""
    return Attempt(
        words=words(f"generate {asked} --n 1 --val 0 --test 0 --out out --workers 1 --quiet"),
        damage=damage,
        makes=("out", "out/*"),
        after=_examine,
        holds=_holds,
    )


def _examine():
    """What the dataset in ``out`` holds, and what `verify` says of it; in a process that may have
    crashed by it."""
    from scenegen.verification import verify

    finite = True
    for path in Path("out").glob("*.h5"):
        with h5py.File(path) as file:
            numbers = [file[name][()] for name in ("position", "quaternion", "origin")]
            finite = finite and all(np.isfinite(values).all() for values in numbers)
            finite = finite and not np.isnan(file["ranges"][()]).any()
    checks = verify(Path("out"), quick=True).checks
    return {"finite": bool(finite), "faults": [one.detail for one in checks if not one.ok]}


def _holds(result):
    found = result.after
    if not found["finite"]:
        return "wrote numbers that are none"
    return f"wrote what verify refuses: {found['faults'][:3]}" if found["faults"] else ""
