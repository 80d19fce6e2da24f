"""Runs commands by name. Errors end in one line on standard error and an exit code. Output streams
never raise, so that the result of a command does not depend on who reads its output."""

import ast
import importlib.util
import io
import os
import sys
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NoReturn, TextIO

import rich_click as click

from lidarsim.registry import Registry
from scenegen.base.errors import (
    ScenegenError,
    StoppedError,
    as_own_code_error,
    is_out_of_memory,
    lacking,
    printable,
)
from scenegen.cli import stops

MAX_REPEATED = 1000
"""Maximum characters of an error that repeats a user's words."""


class Commands(click.RichGroup):
    """A group of commands, each imported when it is given; also a user's own ``module:command``."""

    def __init__(self, *, places: Mapping[str, str], **options: Any):
        """Make the group.

        Args:
            places: ``module:command`` of each built-in command, by its name.
            options: Further arguments of `click.Group`.
        """
        super().__init__(context_settings={"help_option_names": ["-h", "--help"]}, **options)
        needs = {"make_context": "as click's commands have it: write @click.command() above it"}
        self.registry = Registry("command", places, needs=needs)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of built-in commands."""
        return sorted(self.registry.builtin)

    def get_command(self, ctx: Any, name: str) -> Any:
        """Return a stand-in for a command with its help, so that the list of commands imports none.

        Args:
            ctx: The context, unused.
            name: Name of the command.
        """
        place = self.registry.builtin.get(name)
        return None if place is None else click.RichCommand(name=name, help=_first_paragraph(place))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Import the command that a command line names.

        Args:
            ctx: The context.
            args: Words of the command line.

        Returns:
            Name, command, and remaining words; None for an unknown name that a shell completes.

        Raises:
            click.UsageError: There is no such command.
        """
        try:
            return args[0], self.registry.find(args[0]), args[1:]
        except ValueError as error:
            if ctx.resilient_parsing:  # a shell completes: an error would print into its line
                return None, None, []
            raise click.UsageError(str(error)) from None

    def invoke(self, ctx: Any) -> None:
        """Run the command, with its start time as `ctx.obj`. Its return value is dropped, since
        click would take it for an exit code."""
        ctx.obj = time.perf_counter()
        super().invoke(ctx)


def _first_paragraph(place: str) -> str:
    """Return the first paragraph of the docstring of ``module:function``, without importing it."""
    module, _, function = place.partition(":")
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    for item in ast.parse(Path(spec.origin).read_bytes()).body:
        if isinstance(item, ast.FunctionDef) and item.name == function:
            return (ast.get_docstring(item) or "").partition("\n\n")[0]
    return ""


def run_command(app: Any) -> NoReturn:
    """Run the click group `app` on this process's arguments, and end the process."""
    stops.answer()
    stops.answer_hanging()
    # no window is ever opened; otherwise importing mujoco starts another process, which a stop
    # would not reach
    os.environ.setdefault("MUJOCO_GL", "disable")
    # torch's waiting threads sleep instead of spinning, which on a busy machine costs twice the
    # processor time and also wall-clock time; torch reads this when it is loaded
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # no Python that a library starts imports files of the working folder
    os.environ["PYTHONSAFEPATH"] = "1"
    _open_streams()
    if not sys.warnoptions:  # a user's own -W counts
        warnings.simplefilter("ignore")  # libraries warn their own authors
    try:
        # not standalone, in which click prints errors and ends the process itself
        code, line = app.main(prog_name="scenegen", standalone_mode=False) or 0, ""
    except (Exception, KeyboardInterrupt) as error:
        code, line = _end(error)
    # a full disk must not look like success to a script
    lost = _lost_output()
    if lost is not None and not code:
        code, line = 1, f"standard output: {lost.strerror}; what was to be printed is lost"
    if line:
        print(f"scenegen: {printable(line)}", file=sys.stderr)
    if "TORCHELASTIC_RUN_ID" in os.environ:
        # started by torchrun: torch's threads can abort a process while Python shuts down, and
        # torchrun would count the run as failed; all output is written by now
        os._exit(code)
    sys.exit(code)


def _end(error: BaseException) -> tuple[int, str]:
    """Return exit code and line for the error that ended a run. Raise it again if it is a defect of
    scenegen, whose authors need the traceback."""
    match error:
        case click.UsageError():
            name = error.ctx.command_path if error.ctx else "scenegen"
            return 2, f"{error.format_message()[:MAX_REPEATED]} (see {name} --help)"
        case click.ClickException():
            return 1, error.format_message()
        case click.Abort() | KeyboardInterrupt() | StoppedError():
            return stops.CODE, str(error) if isinstance(error, StoppedError) else stops.STOPPED
        case ModuleNotFoundError() if advice := lacking(error):
            return 1, f"this command {advice}"
        case MemoryError() | RuntimeError() if is_out_of_memory(error):
            return 1, "out of memory; use smaller numbers (such as --batch), or a larger machine"
        case Exception() if isinstance(error := as_own_code_error(error), ScenegenError):
            return error.code, str(error)
        # a file that cannot be read or written: not a defect, so no traceback
        case OSError():
            named = isinstance(error.filename, str | bytes)
            name = os.fsdecode(error.filename) if named else "the system"
            reason = error.strerror or error
            return 1, f"{name[:MAX_REPEATED]}: {reason}; nothing finished is lost"
    raise error


def _open_streams() -> None:
    """Replace both output streams by ones that never raise, flush each line, and escape characters
    that the terminal cannot show."""
    _Forgiving.trouble.clear()
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        # a closed stream: the next file that is opened would get its number, and our output
        except OSError:
            os.open(os.devnull, os.O_RDONLY)  # to write to it fails, so that lost output is noticed
        stream: TextIO | None = getattr(sys, name)
        # a stream that somebody has put in its place stays
        if number and (stream is None or stream is getattr(sys, f"__{name}__")):
            file = io.BufferedWriter(_Forgiving(number, "w", closefd=False))
            encoding = stream.encoding if stream else "utf-8"
            text = io.TextIOWrapper(file, encoding, "backslashreplace", line_buffering=True)
            setattr(sys, name, text)


def _lost_output() -> OSError | None:
    """Return the error for which output was lost, or None. A reader that has closed the pipe, such
    as `head`, is no error."""
    sys.stdout.flush()  # what is still buffered may be lost, too
    trouble = _Forgiving.trouble.get(1)
    return None if isinstance(trouble, BrokenPipeError) else trouble


class _Forgiving(io.FileIO):
    """A file descriptor that drops what it cannot write."""

    trouble: ClassVar[dict[int, OSError]] = {}
    """Last error of each descriptor."""

    def write(self, content: Any) -> int:
        """Write, or drop the content and keep the error."""
        try:
            return super().write(content)
        except OSError as error:
            self.trouble[self.fileno()] = error
            return len(content)
