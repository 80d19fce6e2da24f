"""A real server of S3's protocol on this machine: Ceph's, as Debian packages it, in a folder and on
ports of its own.

A monitor and a store of objects in memory keep what the gateway, `radosgw`, takes; the gateway may
be killed and begun again, and what it had confirmed is there. About 150 MB of memory, and fifteen
seconds to begin.
"""

import os
import shutil
import signal
import socket
import subprocess
import time
import uuid
from contextlib import suppress

from tests.scenegen.run.slurm_here import free_port

NEEDED = ("ceph", "ceph-mon", "ceph-osd", "radosgw", "radosgw-admin", "monmaptool", "ceph-authtool")
GET = "apt-get install --no-install-recommends ceph-mon ceph-osd radosgw"
STORE_BYTES = 1 << 30
USER, KEY, SECRET = "ada", "AKIAADASKEYOFTESTS", "the-Secret+of/Adas-tests"
CONF = """
[global]
fsid = {fsid}
keyring = {home}/keyring
run dir = {home}
admin socket = {home}/$name.asok
pid file = {home}/$name.pid
log file = {home}/$name.log
mon cluster log file = {home}/cluster.log
mon host = v2:127.0.0.1:{mon}
mon data = {home}/mon
public addr = 127.0.0.1
cluster addr = 127.0.0.1
osd data = {home}/osd
osd objectstore = memstore
memstore device bytes = {bytes}
osd class load list = *
osd class default list = *
osd crush chooseleaf type = 0
osd pool default size = 1
osd pool default min size = 1
osd pool default pg num = 1
osd pool default pgp num = 1
osd pool default pg autoscale mode = off
mon allow pool size one = true
mon data avail crit = 1
rgw frontends = beast endpoint=127.0.0.1:{gateway}
rgw thread pool size = 16
rgw bucket quota ttl = 0
rgw user quota bucket sync interval = 1
"""


def missing():
    """What to install, where something is not there; empty otherwise."""
    absent = [name for name in NEEDED if shutil.which(name) is None]
    return f"needs {absent[0]}: {GET}" if absent else ""


class Ceph:
    """The server, while the block lasts."""

    def __init__(self, home):
        self.home = home
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._running = {}

    @property
    def environment(self):
        """What a client's environment has to say."""
        return {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ACCESS_KEY_ID": KEY,
            "AWS_SECRET_ACCESS_KEY": SECRET,
        }

    def __enter__(self):
        try:
            self._begin()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error):
        for one in reversed(self._running.values()):
            with suppress(ProcessLookupError):
                os.killpg(one.pid, signal.SIGKILL)
            one.wait()

    def _begin(self):
        fsid, mon = str(uuid.uuid4()), free_port()
        told = CONF.format(home=self.home, fsid=fsid, mon=mon, gateway=self.port, bytes=STORE_BYTES)
        (self.home / "ceph.conf").write_text(told)
        ring, monmap = self.home / "keyring", self.home / "monmap"
        rights = {"mon.": ("mon",), "client.admin": ("mon", "osd"), "osd.0": ("mon", "osd")}
        for name, what in rights.items():
            create = () if ring.exists() else ("--create-keyring",)
            words = [word for one in what for word in ("--cap", one, "allow *")]
            self._run("ceph-authtool", *create, str(ring), "--gen-key", "-n", name, *words)
        address = ("--addv", "a", f"[v2:127.0.0.1:{mon}]")
        self._run("monmaptool", "--create", "--fsid", fsid, *address, str(monmap))
        self._run("ceph-mon", "--mkfs", "-i", "a", "--monmap", str(monmap), "--keyring", str(ring))
        self._start("ceph-mon", "-i", "a")
        self._ceph("auth", "import", "-i", str(ring))
        disk = str(uuid.uuid4())
        self._ceph("osd", "new", disk)
        (self.home / "osd").mkdir()
        self._run("ceph-osd", "-i", "0", "--mkfs", "--osd-uuid", disk)
        self._ceph("osd", "crush", "add", "osd.0", "1", "root=default", "host=here")
        self._start("ceph-osd", "-i", "0")
        keys = f"--access-key {KEY} --secret-key {SECRET}"
        self._run("radosgw-admin", *f"user create --uid {USER} --display-name Ada {keys}".split())
        self.begin()

    def begin(self):
        """Begin the gateway, and wait until it answers."""
        self._start("radosgw", "-n", "client.admin")
        for _ in range(300):
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=1):
                return
            time.sleep(0.1)
        raise TimeoutError(f"no gateway at {self.url}")

    def kill(self):
        """Kill the gateway, as a crash would."""
        one = self._running.pop("radosgw")
        os.killpg(one.pid, signal.SIGKILL)
        one.wait()

    def _ceph(self, *words):
        return self._run("ceph", "--connect-timeout", "20", *words)

    def _run(self, *words):
        """Run one of Ceph's commands to its end."""
        command = [words[0], *self._conf(words[0]), *words[1:]]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, f"{' '.join(words[:3])}: {done.stderr[-500:]}"
        return done.stdout

    def _start(self, *words):
        out = (self.home / f"{words[0]}.out").open("ab")
        command = [words[0], *self._conf(words[0]), *words[1:], "-f"]
        self._running[words[0]] = subprocess.Popen(
            command, stdout=out, stderr=out, start_new_session=True
        )
        out.close()

    def _conf(self, program):
        if program in ("ceph-authtool", "monmaptool"):
            return ()
        return "-c", str(self.home / "ceph.conf")
