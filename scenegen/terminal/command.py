"""Run the command line: what goes wrong ends in one line on standard error, and in an exit code."""

import os
import sys
import warnings
from typing import Any, NoReturn

import rich_click as click

from scenegen.errors import ScenegenError, StoppedError, needs, printable
from scenegen.terminal import stops
from scenegen.terminal.streams import lost_output, open_streams

EXTRAS = {"torch": "train", "safetensors": "train"}
"""Packages that commands need beyond the core, and the extra that brings each."""


def run_command(app: Any) -> NoReturn:
    """Run the click group `app` on this process's arguments, and end."""
    stops.answer()
    stops.answer_hanging()
    # no window is ever opened; else importing mujoco starts a process of its own, which a stop would not reach
    os.environ.setdefault("MUJOCO_GL", "disable")
    open_streams()
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # those of libraries, about their own code and to its authors
    code, line = _outcome(app)
    lost = lost_output()
    if lost is not None and not code:
        code, line = 1, f"standard output: {lost.strerror}; what was to be printed is lost"
    if line:
        print(f"scenegen: {printable(line)}", file=sys.stderr)
    sys.exit(code)


def _outcome(app: Any) -> tuple[int, str]:
    """Exit code and line of a run."""
    try:
        app.main(prog_name="scenegen", standalone_mode=False)
        return 0, ""
    except click.UsageError as error:
        name = error.ctx.command_path if error.ctx else "scenegen"
        return 2, f"{error.format_message()} (see {name} --help)"
    except click.ClickException as error:
        return 1, error.format_message()
    except ScenegenError as error:
        return stops.CODE if isinstance(error, StoppedError) else 1, str(error)
    except (click.Abort, KeyboardInterrupt):
        return stops.CODE, stops.STOPPED
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        return 1, f"this command {needs(error.name, EXTRAS[error.name])}"
    except OSError as error:
        name = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else "the system"
        return 1, f"{name}: {error.strerror or error}; nothing finished is lost"
    except (MemoryError, RuntimeError) as error:
        memory = ("out of memory", "not enough memory", "can't allocate memory")  # as torch says it
        if isinstance(error, RuntimeError) and not any(text in str(error) for text in memory):
            raise
        return 1, "out of memory; use smaller numbers (such as --batch), or a larger machine"
