"""A warm process: it has imported and run everything once, and forks a copy of itself for every
case."""

import contextlib
import gc
import json
import os
import resource
import shutil
import signal
import tempfile
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from random import Random

from scenegen.base.errors import GuardError
from scenegen.base.workers import guarded
from scenegen.cli.stops import STOPS
from tests.command_line import code_of
from tests.mutations.case import Result
from tests.mutations.datasets import print_load
from tests.mutations.formats import FAMILIES
from tests.mutations.verdict import MEMORY_BYTES, PROCESSOR_SECONDS, SECONDS, verdict

MAX_WRITTEN_BYTES = 512 << 20
"""In one file, lest a case fill the disk."""


@dataclass(frozen=True)
class Ended:
    """A case, how it ended, and what is wrong with that."""

    name: str
    words: tuple[str, ...]
    damage: str
    result: Result
    wrong: str


def campaign(names, valid, *, seed, jobs, base):
    """Run the cases called `names`, `jobs` at a time. Each has a folder under `base`, kept where it
    went wrong or was alone."""
    gc.collect()
    gc.freeze()  # what is collected no more is copied no more
    case = partial(run_case, valid=valid, seed=seed, base=base, keep=len(names) == 1)
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork")) as pool:
        yield from pool.map(case, names)


def run_case(name, *, valid, seed, base, keep):
    """Damage a file, run the command in a copy of this process, and judge how it ended."""
    folder = Path(tempfile.mkdtemp(prefix=name.replace("/", "-") + "-", dir=base))
    here = folder / "here"
    here.mkdir()
    try:
        attempt = FAMILIES[name.partition("/")[0]](Random(f"{seed} {name}"), valid, here)
    except Exception as error:
        raise RuntimeError(f"{name} with seed {seed} cannot be made") from error
    before, begin = _look(here), time.monotonic()
    ended = {"code": -1}
    run = partial(_run, attempt)
    try:
        leader, ended = guarded(run, folder, seconds=SECONDS, memory_bytes=MEMORY_BYTES)
        ended["left_running"] = _end_group(leader)
    except GuardError as error:
        ended["failure"] = str(error)
    result = Result(
        seconds=time.monotonic() - begin,
        stdout=_read(folder / "out"),
        stderr=_read(folder / "err"),
        changed=tuple(sorted({path for path, _ in before.items() ^ _look(here).items()})),
        folder=here,
        **ended,
    )
    wrong = verdict(attempt, result)
    if not wrong and not keep:
        shutil.rmtree(folder, ignore_errors=True)
    return Ended(name, attempt.words, attempt.damage, result, wrong)


def _run(attempt, folder):
    """The case itself, in a process of its own: its number, and how the case ended."""
    os.setsid()
    os.chdir(folder / "here")
    for limit, value in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, PROCESSOR_SECONDS),
        (resource.RLIMIT_FSIZE, MAX_WRITTEN_BYTES),
    ):
        resource.setrlimit(limit, (value, value))
    before = _max_resident_kb()
    with (
        open(os.devnull) as nothing,
        open(folder / "out", "a", errors="backslashreplace") as out,
        open(folder / "err", "a") as err,
    ):
        for number, file in enumerate((nothing, out, err)):
            os.dup2(file.fileno(), number)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code, after = 70, None
            try:
                is_load = attempt.words[0] == "load"
                code = print_load(attempt.words[1]) if is_load else code_of(*attempt.words)
                if code == 0 and attempt.after is not None:
                    after = json.loads(json.dumps(attempt.after()))
            except BaseException:
                traceback.print_exc()
                code = 70
    for number in STOPS:  # the command's answers would be printed when this process is ended
        signal.signal(number, signal.SIG_DFL)
    grown_bytes = (_max_resident_kb() - before) << 10
    return os.getpid(), {"code": code, "after": after, "grown_bytes": grown_bytes}


def _max_resident_kb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _end_group(leader):
    """Kill what is left of a case; whether anything was."""
    for _ in range(15):  # guarded processes notice within 0.2 s that their parent has gone
        try:
            os.killpg(leader, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.04)
    os.killpg(leader, signal.SIGKILL)
    return True


def _read(path):
    try:
        with open(path, "rb") as file:
            return file.read(1 << 20).decode(errors="surrogateescape")
    except FileNotFoundError:
        return ""


def _look(folder):
    """Everything in `folder`: kind, and content where it is a file or a link."""
    found = {}
    for path in folder.rglob("*"):
        status, content = path.lstat(), b""
        if path.is_symlink():
            content = os.fsencode(path.readlink())
        elif path.is_file() and status.st_size < 1 << 26:
            content = path.read_bytes()
        found[str(path.relative_to(folder))] = status.st_mode, hash(content)
    return found
