"""A run of `scenegen generate` that is stopped leaves nothing behind but whole files."""

import os
import signal
import sys
from pathlib import Path

import pytest

from tests.scenegen.cli.test_stops import begin
from tests.scenegen.conftest import wait_for


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


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
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
        assert "nothing finished is lost" in error
        assert "Traceback" not in error
        assert not list(out.glob(".*.tmp"))
    for path in out.glob("*.h5"):
        assert path.with_suffix(".worlds.zip").exists()
