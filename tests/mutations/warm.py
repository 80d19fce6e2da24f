"""The warm process: it has imported and run everything once, and forks a copy of itself for every
case."""

import contextlib
import gc
import json
import os
import resource
import shutil
import signal
import stat
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any
from zlib import crc32

from tests.command_line import code_of
from tests.mutations.case import Attempt, Result
from tests.mutations.datasets import print_load
from tests.mutations.verdict import MEMORY_BYTES, PROCESSOR_SECONDS, SECONDS, verdict

MAX_WRITTEN_BYTES = 512 << 20
"""In one file, lest a case fill the disk."""


@dataclass
class _Running:
    name: str
    attempt: Attempt
    folder: Path
    before: dict[str, Any]
    process: int
    begin: float


@dataclass(frozen=True)
class Ended:
    """A case, how it ended, and what is wrong with that."""

    name: str
    attempt: Attempt
    result: Result
    wrong: str


def campaign(names, families, valid, *, seed, jobs, base):
    """Run the cases called `names`, `jobs` at a time. Each has a folder under `base`, kept where it
    went wrong or was alone."""
    gc.collect()
    gc.freeze()  # what is collected no more is copied no more
    waiting = iter(names)
    running = []
    while True:
        while len(running) < jobs and (name := next(waiting, None)):
            running.append(_start(name, families, valid, seed, base))
        if not running:
            return
        for case in [*running]:
            ended = _ended(case, keep=len(names) == 1)
            if ended is not None:
                running.remove(case)
                yield ended
        time.sleep(0.001)


def _start(name, families, valid, seed, base):
    folder = Path(tempfile.mkdtemp(prefix=name.replace("/", "-") + "-", dir=base))
    here = folder / "here"
    here.mkdir()
    try:
        attempt = families[name.partition("/")[0]](Random(f"{seed} {name}"), valid, here)
    except Exception as error:
        raise RuntimeError(f"{name} with seed {seed} cannot be made") from error
    before = _look(here)
    begin = time.monotonic()
    process = os.fork()
    if process == 0:
        _run(attempt, folder)
    return _Running(name, attempt, folder, before, process, begin)


def _run(attempt, folder):
    """The case itself, in a process of its own; does not return."""
    code = 70
    try:
        os.setsid()
        os.chdir(folder / "here")
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number, name in ((1, "out"), (2, "err")):
            flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
            os.dup2(os.open(folder / name, flags, 0o644), number)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY_BYTES
        (folder / "resident").write_text(str(_resident()))
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_SECONDS, PROCESSOR_SECONDS + 5))
        resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_WRITTEN_BYTES, MAX_WRITTEN_BYTES))
        code = _command(attempt.words)
        if code == 0 and attempt.after is not None:
            (folder / "after").write_text(json.dumps(attempt.after()))
        sys.stdout.flush()
    except BaseException:
        traceback.print_exc()
        code = 70
    finally:
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(code)


def _command(words):
    return print_load(words[1]) if words[0] == "load" else code_of(*words)


def _ended(case, *, keep):
    seconds = time.monotonic() - case.begin
    process, status, usage = os.wait4(case.process, os.WNOHANG)
    timed_out = process == 0 and seconds > SECONDS
    if process == 0 and not timed_out:
        return None
    left = _end_group(case.process)
    if timed_out:
        _, status, usage = os.wait4(case.process, 0)
    here = case.folder / "here"
    after = case.folder / "after"
    result = Result(
        code=os.waitstatus_to_exitcode(status),
        seconds=seconds,
        timed_out=timed_out,
        left_running=left and not timed_out,
        stdout=_read(case.folder / "out"),
        stderr=_read(case.folder / "err"),
        after=json.loads(after.read_text()) if after.exists() else None,
        grown_bytes=(usage.ru_maxrss << 10) - int(_read(case.folder / "resident") or 1 << 62),
        folder=here,
    )
    now = _look(here)
    names = sorted(name for name in {*case.before, *now} if case.before.get(name) != now.get(name))
    result = replace(result, changed=tuple(names))
    wrong = verdict(case.attempt, result)
    if not wrong and not keep:
        shutil.rmtree(case.folder, ignore_errors=True)
    return Ended(case.name, case.attempt, result, wrong)


def _end_group(leader):
    """Kill what is left of a case; whether anything besides its leader was."""
    for attempt in range(20):  # guarded processes notice within 0.2 s that their parent has gone
        try:
            os.killpg(leader, 0 if attempt < 15 else signal.SIGKILL)
        except (ProcessLookupError, PermissionError):
            return False
        if attempt == 0 and _is_running(leader):
            os.killpg(leader, signal.SIGKILL)
            return True
        time.sleep(0.04)
    return True


def _is_running(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def _resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _read(path):
    try:
        with open(path, "rb") as file:
            return file.read(1 << 20).decode(errors="surrogateescape")
    except FileNotFoundError:
        return ""


def _look(folder):
    """Everything in `folder`: kind, and content where it is a file."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            path = Path(root) / name
            status = path.lstat()
            kind = stat.S_IFMT(status.st_mode)
            content = path.read_bytes() if stat.S_ISREG(kind) and status.st_size < 1 << 26 else b""
            target = str(path.readlink()) if stat.S_ISLNK(kind) else ""
            found[str(path.relative_to(folder))] = (kind, crc32(content), target, status.st_rdev)
    return found
