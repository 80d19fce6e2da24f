"""Commands by name, and their end: what goes wrong ends in one line on standard error, and in an
exit code. Streams never raise: what became of a command does not depend on who reads what it
says."""

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
    is_out_of_memory,
    lacking,
    printable,
    told,
)
from scenegen.cli import stops

MOST_REPEATED = 1000
"""Characters of a line about words that a user gave: it repeats them."""


class Commands(click.RichGroup):
    """A group of commands that are imported when they are given, a user's own as ``module:command``
    among them."""

    def __init__(self, *, places: Mapping[str, str], **more: Any):
        """Takes in `places` where each of the known commands stands: name to
        ``module:command``."""
        super().__init__(context_settings={"help_option_names": ["-h", "--help"]}, **more)
        needs = {"make_context": "as click's commands have it: write @click.command() above it"}
        self.registry = Registry("command", places, needs=needs)

    def list_commands(self, ctx: Any) -> list[str]:
        """The known ones."""
        return sorted(self.registry.builtin)

    def get_command(self, ctx: Any, name: str) -> Any:
        """A stand-in with the help of the command `name`, so that a list of all imports none."""
        place = self.registry.builtin.get(name)
        return None if place is None else click.RichCommand(name=name, help=_first_paragraph(place))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """The command that `args` begins with, and the rest; none while a shell completes a name
        that is not one. Raises UsageError where there is none."""
        try:
            return args[0], self.registry.find(args[0]), args[1:]
        except ValueError as error:
            if ctx.resilient_parsing:
                return None, None, []
            raise click.UsageError(str(error)) from None

    def invoke(self, ctx: Any) -> None:
        """Runs the command, which finds in its context's `obj` when it began. What it returns is
        dropped, so that `main` returns exit codes alone."""
        ctx.obj = time.perf_counter()
        super().invoke(ctx)


def _first_paragraph(place: str) -> str:
    """How the docstring of the function ``module:function`` begins, read from its source, which is
    not imported."""
    module, _, function = place.partition(":")
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    for item in ast.parse(Path(spec.origin).read_bytes()).body:
        if isinstance(item, ast.FunctionDef) and item.name == function:
            return (ast.get_docstring(item) or "").partition("\n\n")[0]
    return ""


def run_command(app: Any) -> NoReturn:
    """Runs the click group `app` on this process's arguments, and ends the process."""
    stops.answer()
    stops.answer_hanging()
    # no window is ever opened; else importing mujoco starts a process of its own, which a stop
    # would not reach
    os.environ.setdefault("MUJOCO_GL", "disable")
    # torch's threads, which read it when torch is loaded: those that wait for others sleep, and
    # leave the core to who has work; by themselves they spin, which on a busy machine costs twice
    # the processor time, and time by the clock
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # no Python that a library starts imports what lies in the working folder
    os.environ["PYTHONSAFEPATH"] = "1"
    _open_streams()
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # of libraries, about their own code and to its authors
    try:
        code, line = app.main(prog_name="scenegen", standalone_mode=False) or 0, ""
    except (Exception, KeyboardInterrupt) as error:
        code, line = _end(error)
    lost = _lost_output()
    if lost is not None and not code:
        code, line = 1, f"standard output: {lost.strerror}; what was to be printed is lost"
    if line:
        print(f"scenegen: {printable(line)}", file=sys.stderr)
    if "TORCHELASTIC_RUN_ID" in os.environ:
        # one of torchrun's: all is said and written, and torch's threads have been seen to abort a
        # process that Python takes down around them, which torchrun takes for a failed run
        os._exit(code)
    sys.exit(code)


def _end(error: BaseException) -> tuple[int, str]:
    """Exit code and line of what ended a run. Raises it again where nobody but its authors can act
    on it."""
    match error:
        case click.UsageError():
            name = error.ctx.command_path if error.ctx else "scenegen"
            return 2, f"{error.format_message()[:MOST_REPEATED]} (see {name} --help)"
        case click.ClickException():
            return 1, error.format_message()
        case click.Abort() | KeyboardInterrupt() | StoppedError():
            return stops.CODE, str(error) if isinstance(error, StoppedError) else stops.STOPPED
        case ModuleNotFoundError() if advice := lacking(error):
            return 1, f"this command {advice}"
        case MemoryError() | RuntimeError() if is_out_of_memory(error):
            return 1, "out of memory; use smaller numbers (such as --batch), or a larger machine"
        case Exception() if isinstance(error := told(error), ScenegenError):
            return error.code, str(error)
        case OSError():
            named = isinstance(error.filename, str | bytes)
            name = os.fsdecode(error.filename) if named else "the system"
            reason = error.strerror or error
            return 1, f"{name[:MOST_REPEATED]}: {reason}; nothing finished is lost"
    raise error


def _open_streams() -> None:
    """Makes both output streams forgiving, line by line, with characters that the terminal cannot
    show as escapes."""
    _Forgiving.trouble.clear()
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        # closed; else the next file that is opened would be taken for it. Writing to this one fails
        except OSError:
            os.open(os.devnull, os.O_RDONLY)
        here: TextIO | None = getattr(sys, name)
        if number and (here is None or here is getattr(sys, f"__{name}__")):
            file = io.BufferedWriter(_Forgiving(number, "w", closefd=False))
            encoding = here.encoding if here else "utf-8"
            text = io.TextIOWrapper(file, encoding, "backslashreplace", line_buffering=True)
            setattr(sys, name, text)


def _lost_output() -> OSError | None:
    """Why not all that was printed has reached standard output, if so. That nobody reads any more
    is no reason."""
    sys.stdout.flush()
    trouble = _Forgiving.trouble.get(1)
    return None if isinstance(trouble, BrokenPipeError) else trouble


class _Forgiving(io.FileIO):
    """A file descriptor that takes everything; what it cannot write is gone."""

    trouble: ClassVar[dict[int, OSError]] = {}
    """What was in the way last, by descriptor."""

    def write(self, content: Any) -> int:
        """Writes, or says that it was."""
        try:
            return super().write(content)
        except OSError as error:
            self.trouble[self.fileno()] = error
            return len(content)
