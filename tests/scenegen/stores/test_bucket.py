"""On a real server of S3's protocol, whose environment variables are set: the same bytes as in a
folder, and no credentials in them.

    AWS_ENDPOINT_URL=… AWS_ACCESS_KEY_ID=… AWS_SECRET_ACCESS_KEY=… \\
    SCENEGEN_BUCKET=… python -m pytest -m slow -n0 tests/scenegen/stores/test_bucket.py
"""

import os
import threading
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from scenegen.base.errors import StoreError
from scenegen.base.stores import Store
from scenegen.dataset.build import build
from scenegen.dataset.locate import locate
from scenegen.dataset.placed import SUFFIX
from scenegen.verification import verify
from tests.conftest import contents, plan_of

SECRETS = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("SCENEGEN_BUCKET" not in os.environ, reason="no bucket is named"),
]


@pytest.fixture
def name():
    """The name of a new folder in the bucket."""
    return f"s3://{os.environ['SCENEGEN_BUCKET']}/test-{uuid.uuid4()}"


@pytest.mark.parametrize("begun", [False, True])
def test_the_servers_conditional_put_is_real(begun, name):
    """Of eight at once exactly one wins, and what it put is there."""
    racing = [Store(name) for _ in range(8)]

    def put(task):
        start, store, file, content = task
        start.wait()
        # a conflict, or what Ceph answers to some that lose a race, 500
        with suppress(StoreError):
            store.replace(file, content)
            return content

    with ThreadPoolExecutor(8) as pool:
        for turn in range(20):
            file, start = f"race-{turn}", threading.Barrier(8)
            if begun:
                racing[0].put(file, b"first")
                assert {store.read(file, 5) for store in racing} == {b"first"}
            tasks = [(start, store, file, f"{n}".encode()) for n, store in enumerate(racing)]
            (winner,) = filter(None, pool.map(put, tasks))
            assert racing[0].read(file, 1) == winner


def test_a_bucket_holds_the_bytes_of_a_folder(name, tmp_path):
    options = {"counts": {"train": 40, "val": 6, "test": 6}, "shard_samples": 3}
    for place in (Store(name), tmp_path / "d"):
        build(plan_of(place, **options), workers=2)
    stored = {file: Store(name).read(file, size) for file, size in Store(name).list().items()}
    for content in stored.values():
        assert not [secret for secret in SECRETS if os.environ[secret].encode() in content]
    objects = {file: stored[file] for file in stored if not file.endswith(SUFFIX)}
    assert objects == contents(tmp_path / "d")
    assert verify(locate(name, whole=True), quick=True).ok
