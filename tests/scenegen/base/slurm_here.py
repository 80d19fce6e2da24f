"""A real Slurm on this machine, of several nodes. Needs Debian's slurm-wlm and munge, and to be
root."""

import os
import shutil
import signal
import socket
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.command_line import beside

NEEDED = pytest.mark.skipif(
    shutil.which("slurmctld") is None or os.getuid() != 0, reason="needs slurm-wlm, and to be root"
)
"""For tests."""
CONFIG = beside(__file__, "slurm.conf")
NODE = (
    "NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs={cpus} State=UNKNOWN\n"
)
WAIT_S = 60
IDLE = "sinfo -h -N -o %T"


def free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@contextmanager
def slurm(folder, nodes=1):
    """A cluster of this machine's cores, `nodes` times; files lie in `folder`. The process number
    of every node's daemon, by the node's name."""
    # munge refuses sockets in folders that others cannot reach
    for above in (folder, *folder.parents):
        if above.stat().st_uid == 0 and above != Path("/"):
            above.chmod(above.stat().st_mode | 0o755)
    (folder / "state").mkdir()
    host = socket.gethostname().split(".")[0]
    names = [f"node{number}" for number in range(nodes)]
    text = CONFIG.format(host=host, folder=folder, port=free_port())
    for name in names:
        text += NODE.format(name=name, host=host, port=free_port(), cpus=os.cpu_count())
        (folder / f"spool-{name}").mkdir()
    (folder / "slurm.conf").write_text(text)
    (folder / "key").write_bytes(os.urandom(1024))
    (folder / "key").chmod(0o400)
    patch = pytest.MonkeyPatch()
    patch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
    files = [f"--{name}-file={folder}/{name}" for name in ("key", "log", "pid", "seed")]
    files.append(f"--socket={folder}/munge.socket")
    daemons = [subprocess.Popen(["munged", "-F", "-f", *files])]
    try:
        time.sleep(1)
        for command in ("slurmctld -D", *(f"slurmd -D -N {name}" for name in names)):
            daemons.append(subprocess.Popen(command.split()))
        _wait(folder, nodes)
        yield {name: daemon.pid for name, daemon in zip(names, daemons[2:], strict=True)}
    finally:
        for daemon in reversed(daemons):
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(20)
        patch.undo()


def _wait(folder, nodes):
    for _ in range(WAIT_S):
        told = subprocess.run(IDLE.split(), capture_output=True, text=True, check=False)
        if told.stdout.split() == ["idle"] * nodes:
            return
        time.sleep(1)
    log = (folder / "slurmctld.log").read_text()[-2000:]
    raise RuntimeError(f"not all nodes are up: {told.stdout}{told.stderr}\n{log}")
