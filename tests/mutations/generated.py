"""`generate` on damaged wishes: what it writes, every reader takes."""

import contextlib
import io
import json
import sys
from pathlib import Path

import h5py
import numpy as np

from tests.mutations.case import Attempt, words


def generated(asked, damage, *, samples=1):
    """A dataset made by the words `asked`; where that succeeds, `verify --quick` passes it and its
    numbers can be such."""
    return Attempt(
        words=(
            "generate",
            *asked,
            "--n",
            str(samples),
            *words("--val 0 --test 0 --out out --workers 1 --quiet"),
        ),
        damage=damage,
        makes=("out", "out/*"),
        after=_examine,
        holds=_holds,
    )


def _examine():
    """What the dataset in ``out`` holds, and what `verify` says of it; in a process that may have
    crashed by it."""
    from scenegen import __main__ as cli

    finite = True
    for path in Path("out").glob("*.h5"):
        with h5py.File(path) as file:
            numbers = [file[name][()] for name in ("position", "quaternion", "origin")]
            finite = finite and all(np.isfinite(values).all() for values in numbers)
            finite = finite and not np.isnan(file["ranges"][()]).any()
    sys.argv = ["scenegen", "verify", "out", "--quick", "--quiet", "--workers", "1"]
    said, code = io.StringIO(), 0
    try:
        with contextlib.redirect_stderr(said):
            cli.main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    return {"finite": bool(finite), "code": code, "said": said.getvalue()}


def _holds(result):
    found = result.after
    if not found["finite"]:
        return "wrote numbers that are none"
    return f"wrote what verify refuses: {json.dumps(found['said'])[:300]}" if found["code"] else ""
