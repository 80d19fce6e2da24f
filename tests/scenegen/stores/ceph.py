"""A real server of S3's protocol on this machine: Ceph's, as Debian packages it, in a folder and on
ports of its own.

A monitor and a store of objects in memory keep what the gateway, `radosgw`, takes; the gateway may
be killed and begun again, and what it had confirmed is there. About 150 MB of memory, and fifteen
seconds to begin.
"""

import os
import shlex
import shutil
import signal
import socket
import subprocess
import time
import uuid
from contextlib import suppress

from tests.scenegen.base.slurm_here import free_port

NEEDED = ("ceph", "ceph-mon", "ceph-osd", "radosgw", "radosgw-admin", "monmaptool", "ceph-authtool")
GET = "apt-get install --no-install-recommends ceph-mon ceph-osd radosgw"
STORE_BYTES = 1 << 30
RIGHTS = {
    "mon.": "--cap mon 'allow *'",
    "client.admin": "--cap mon 'allow *' --cap osd 'allow *'",
    "osd.0": "--cap mon 'allow *' --cap osd 'allow *'",
}
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
        self._own = os.environ | {"CEPH_CONF": str(home / "ceph.conf")}
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
        fsid, disk, mon = uuid.uuid4(), uuid.uuid4(), free_port()
        told = CONF.format(home=self.home, fsid=fsid, mon=mon, gateway=self.port, bytes=STORE_BYTES)
        (self.home / "ceph.conf").write_text(told)
        ring, monmap, create = self.home / "keyring", self.home / "monmap", "--create-keyring"
        for name, rights in RIGHTS.items():
            self._run(f"ceph-authtool {create} {ring} --gen-key -n {name} {rights}")
            create = ""
        self._run(f"monmaptool --create --fsid {fsid} --addv a [v2:127.0.0.1:{mon}] {monmap}")
        self._run(f"ceph-mon --mkfs -i a --monmap {monmap} --keyring {ring}")
        self._start("ceph-mon -i a")
        self._run(f"ceph --connect-timeout 20 auth import -i {ring}")
        self._run(f"ceph --connect-timeout 20 osd new {disk}")
        (self.home / "osd").mkdir()
        self._run(f"ceph-osd -i 0 --mkfs --osd-uuid {disk}")
        self._run("ceph --connect-timeout 20 osd crush add osd.0 1 root=default host=here")
        self._start("ceph-osd -i 0")
        user = f"--uid {USER} --display-name Ada --access-key {KEY} --secret-key {SECRET}"
        self._run(f"radosgw-admin user create {user}")
        self.begin()

    def begin(self):
        """Begin the gateway, and wait until it answers."""
        self._start("radosgw -n client.admin")
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

    def _run(self, command):
        """Run one of Ceph's commands to its end."""
        done = subprocess.run(
            shlex.split(command), env=self._own, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, f"{command[:40]}: {done.stderr[-500:]}"

    def _start(self, command):
        program = command.split()[0]
        with (self.home / f"{program}.out").open("ab") as out:
            self._running[program] = subprocess.Popen(
                [*command.split(), "-f"],
                env=self._own,
                stdout=out,
                stderr=out,
                start_new_session=True,
            )
