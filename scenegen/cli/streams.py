"""Standard output and error that never raise: what became of a command does not depend on who reads
what it says."""

import io
import os
import sys
from typing import Any, TextIO


def open_streams() -> None:
    """Make both streams forgiving, with characters that the terminal cannot show as escapes.

    Trouble with standard output is kept for `lost_output`; with standard error there is nobody left
    to tell.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        # closed; else the next file that is opened would be taken for it. Writing to this one fails
        except OSError:
            os.open(os.devnull, os.O_RDONLY)
        here: TextIO | None = getattr(sys, name)
        if number and (here is None or here is getattr(sys, f"__{name}__")):
            setattr(sys, name, _Stream(_Forgiving(number), here.encoding if here else "utf-8"))


def lost_output() -> OSError | None:
    """Why not all that was printed has reached standard output, if so. That nobody reads any more
    is no reason."""
    sys.stdout.flush()
    trouble = sys.stdout.file.trouble if isinstance(sys.stdout, _Stream) else None
    return None if isinstance(trouble, BrokenPipeError) else trouble


class _Forgiving(io.FileIO):
    """A file descriptor that takes everything; what it cannot write is gone."""

    trouble: OSError | None = None

    def __init__(self, number: int):
        super().__init__(number, "w", closefd=False)

    def write(self, content: Any) -> int:
        """Write, or say that it was."""
        try:
            return super().write(content)
        except OSError as error:
            self.trouble = error
            return len(content)


class _Stream(io.TextIOWrapper):
    """Text on a forgiving file descriptor, line by line."""

    def __init__(self, file: _Forgiving, encoding: str):
        super().__init__(
            io.BufferedWriter(file), encoding, errors="backslashreplace", line_buffering=True
        )
        self.file = file
