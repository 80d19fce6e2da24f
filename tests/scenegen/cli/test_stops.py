"""A stop at any moment is one line, and leaves whole files; what hangs still dies."""

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from scenegen.cli.stops import STOPPED
from tests.command_line import ROOT
from tests.scenegen.conftest import wait_for

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
LINE = f"scenegen: {STOPPED}\n"
CALLBACK = """
import ctypes, sys
from scenegen.cli import stops
stops.answer()
kind = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
compare = kind(lambda a, b: sum(range(200)) * 0)  # where nearly all the time is spent
numbers = (ctypes.c_long * 100_000)()
print("ready", flush=True)
while True:
    ctypes.CDLL(None).qsort(numbers, 100_000, 8, compare)
"""
HANGING = """
import ctypes
from scenegen.cli import stops
stops.answer()
stops.answer_hanging()
library = ctypes.PyDLL(None)  # keeps Python's lock, as h5py does
# of which any two strings take long to compare
letters = ctypes.create_string_buffer(b"a" * (1 << 22))
print("ready", flush=True)
while True:
    library.qsort(letters, 1 << 19, 8, ctypes.cast(library.strcmp, ctypes.c_void_p))
"""
NOTED = """
import os, time
from scenegen.base.executors import undone_if_stopped
from scenegen.cli import stops
stops.answer()
def undo():
    os.write(1, b"undone\\n")  # takes no lock, as `print` does, in which the stop may come
with stops.noted() as asked, undone_if_stopped(undo):
    print("ready", flush=True)
    while not asked():
        time.sleep(0.01)
    print("asked", flush=True)
    time.sleep(60)
"""


def begin(*command):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, start_new_session=True, **pipes)


def ready(code):
    running = begin(sys.executable, "-c", code)
    assert running.stdout.readline() == "ready\n"
    time.sleep(0.05)
    return running


def test_within_a_librarys_callback():
    running = ready(CALLBACK)
    running.send_signal(signal.SIGHUP)
    assert running.communicate(timeout=60) == ("", LINE)
    assert running.returncode == 130


@LINUX
def test_a_second_stop_ends_what_hangs_in_a_library():
    running = ready(HANGING)
    running.send_signal(signal.SIGTERM)
    time.sleep(0.5)
    running.send_signal(signal.SIGTERM)
    assert running.wait(timeout=20) == -signal.SIGTERM
    running.communicate()


def test_a_loop_notes_the_first_stop_and_the_second_ends_all():
    running = ready(NOTED)
    running.send_signal(signal.SIGINT)
    assert running.stdout.readline() == "asked\n"
    running.send_signal(signal.SIGTERM)
    assert running.communicate(timeout=20) == ("undone\n", LINE)
    assert running.returncode == 130


def test_a_viewer_that_is_closed_ends_well(made):
    running = begin(sys.executable, "cli.py", "view", made, "--port", "0")
    assert running.stdout.readline().endswith("; Ctrl-C ends it\n")
    running.send_signal(signal.SIGINT)
    assert running.communicate(timeout=20)[1] == ""
    assert running.returncode == 0


def answers(process):
    """Whether our handlers stand; before, Python has one for Ctrl-C alone."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(status.partition("SigCgt:\t")[2].split()[0], 16) & 0x4003 == 0x4003


@LINUX
def test_while_a_command_begins(tmp_path):
    """Imports and the loading of kernels, at moments spread over them."""
    asked = f"{sys.executable} cli.py generate --kind pillar --n 20000 --quiet --workers 1"
    for delay in (0.0, 0.8):
        running = begin(*f"{asked} --out {tmp_path}/{delay}".split())
        wait_for(functools.partial(answers, running))
        time.sleep(delay)
        running.send_signal(signal.SIGINT)
        try:
            assert running.communicate(timeout=60) == ("", LINE), delay
        finally:
            running.kill()
        assert running.returncode == 130
    assert not list(tmp_path.rglob(".*.tmp"))


def start(small, out):
    """A run with workers that lasts until it is stopped, well under way."""
    options = f"--recipe {small} --n 200000 --out {out} --workers 2 --shard-samples 30"
    process = begin(sys.executable, "-m", "cli", "generate", *options.split())
    # with nothing cached, kernels compile first
    wait_for(lambda: process.poll() is not None or len(list(out.glob("*.h5"))) > 2, 150)
    assert process.poll() is None, process.stderr.read()
    return process


def descendants(pid):
    """Processes of the session that `pid` leads, itself left out."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == pid and int(entry.name) != pid and fields[0] != "Z":
            found.append(int(entry.name))
    return found


@LINUX
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_leaves_no_process_and_whole_files(number, small, tmp_path):
    out = tmp_path / "d"
    process = start(small, out)
    assert len(descendants(process.pid)) >= 2
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    _, error = process.communicate(timeout=20)
    wait_for(lambda: descendants(process.pid) == [], 10)
    if number != signal.SIGKILL:
        assert process.returncode == 130
        assert "finished files are kept" in error
        assert "Traceback" not in error
        assert not list(out.glob(".*.tmp"))
    for path in out.glob("*.h5"):
        assert path.with_suffix(".worlds.zip").exists()
