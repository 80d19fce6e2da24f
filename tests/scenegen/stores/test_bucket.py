"""On a real server of S3's protocol, killed and begun again in mid-write: the same bytes, or one
clear line.

python -m pytest -m slow -n0 tests/scenegen/stores/test_bucket.py      as root, with Debian's
ceph-mon ceph-osd radosgw
"""

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from scenegen import load
from scenegen.base.errors import StoreError
from scenegen.base.stores import Store, _connect
from scenegen.dataset.locate import locate
from scenegen.dataset.placed import SUFFIX
from scenegen.verification import verify
from tests.command_line import SMALL
from tests.conftest import contents
from tests.scenegen.stores.ceph import KEY, SECRET, Ceph, missing
from tests.scenegen.stores.conftest import forget

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=missing())]
pytest.importorskip("s3fs")
ASKED = "-n 240 --val 6 --test 6 --shard-samples 3 --seed 5 --workers 2"
SHARDS = 84


@pytest.fixture(scope="module")
def ceph(tmp_path_factory):
    with Ceph(tmp_path_factory.mktemp("ceph")) as server:
        yield server


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Where copies go, and kernels, which are compiled once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SCENEGEN_CACHE", str(found := tmp_path_factory.mktemp("cache")))
        yield found


@pytest.fixture(scope="module")
def here(tmp_path_factory, cache):
    """The same dataset in a folder."""
    home = tmp_path_factory.mktemp("here")
    (home / "small.toml").write_text(SMALL)
    Run(home, "d").ends(0)
    return home / "d"


@pytest.fixture
def bucket(ceph, here, tmp_path, monkeypatch):
    """A new bucket, and this process and its children may use it."""
    for name, value in ceph.environment.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "small.toml").write_text(SMALL)
    forget()
    name = f"lab-{time.monotonic_ns()}"
    _connect(f"s3://{name}", os.getpid())[0].mkdir(name)
    return name


class Run:
    """`scenegen generate`, begun in the folder `home`."""

    def __init__(self, home, out, *more):
        asked = f"-m scenegen generate --recipe small.toml {ASKED} --out {out}"
        words = [sys.executable, *asked.split(), *more]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        self.process = subprocess.Popen([*words, "--quiet"], cwd=home, **pipes)

    def ends(self, code):
        """What it said, with its exit code as it should be, and no credential in it."""
        said, _ = self.process.communicate(timeout=240)
        assert self.process.returncode == code, said
        assert not [word for word in (SECRET, KEY, "Traceback") if word in said]
        assert sum("scenegen: " in line for line in said.splitlines()) == (1 if code else 0), said
        return said


def objects(bucket):
    """What the bucket holds of the dataset, less what is there for resuming alone."""
    store = Store(f"s3://{bucket}/d")
    found = {name: store.read(name, size) for name, size in store.list().items()}
    for name, content in found.items():
        assert SECRET.encode() not in content, name
        assert KEY.encode() not in content, name
    return {name: content for name, content in found.items() if not name.endswith(SUFFIX)}


def wait_for(bucket, shards):
    """Wait until so many shards are there; how many are."""
    store = Store(f"s3://{bucket}/d")
    for _ in range(600):
        there = sum(name.endswith(".h5") for name in store.list())
        if there >= shards:
            return there
        time.sleep(0.05)
    raise TimeoutError(f"{there} shards")


@pytest.mark.parametrize("begun", [False, True])
def test_the_servers_conditional_put_is_real(begun, bucket):
    """Of eight at once exactly one wins, and what it put is there."""
    racing = [Store(f"s3://{bucket}/d") for _ in range(8)]

    def put(task):
        start, store, name, mine = task
        start.wait()
        # a conflict, or what Ceph answers to some that lose a race, 500
        with suppress(StoreError):
            store.replace(name, mine)
            return mine

    with ThreadPoolExecutor(8) as pool:
        for turn in range(20):
            name, start = f"race-{turn}", threading.Barrier(8)
            if begun:
                racing[0].put(name, b"first")
                assert {store.read(name, 5) for store in racing} == {b"first"}
            tasks = [(start, store, name, f"{n}".encode()) for n, store in enumerate(racing)]
            (won,) = filter(None, pool.map(put, tasks))
            assert racing[0].read(name, 1) == won


def test_the_server_is_killed_and_begun_again_in_mid_write(ceph, bucket, here, tmp_path):
    run = Run(tmp_path, f"s3://{bucket}/d")
    for share in (0.1, 0.4, 0.7):
        assert wait_for(bucket, int(share * SHARDS)) < SHARDS
        ceph.kill()
        time.sleep(1.0)
        ceph.begin()
    run.ends(0)
    assert objects(bucket) == contents(here)
    one, other = (load(place, split="test")[5] for place in (f"s3://{bucket}/d", here))
    assert one.sha256() == other.sha256()
    assert verify(locate(f"s3://{bucket}/d", whole=True), quick=True).ok
