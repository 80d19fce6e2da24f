"""On a real server of S3's protocol, whose environment variables are set: conditional puts.

    AWS_ENDPOINT_URL=… AWS_ACCESS_KEY_ID=… AWS_SECRET_ACCESS_KEY=… \\
    SCENEGEN_BUCKET=… python -m pytest -m slow -n0 tests/scenegen/stores/test_bucket.py

test_stores.py shows on a server in the process what follows from them.
"""

import os
import threading
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from scenegen.base.errors import StoreError
from scenegen.base.stores import Store

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("SCENEGEN_BUCKET" not in os.environ, reason="no bucket is named"),
]


@pytest.mark.parametrize("begun", [False, True])
def test_the_servers_conditional_put_is_real(begun):
    """Of eight at once exactly one wins, and what it put is there."""
    name = f"s3://{os.environ['SCENEGEN_BUCKET']}/test-{uuid.uuid4()}"
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
