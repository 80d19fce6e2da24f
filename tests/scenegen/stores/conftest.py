"""A bucket of a small server in this process, for it and the processes that it forks."""

import shutil

import pytest

from benchmarks.served import Served
from scenegen.base import mirrors, stores


@pytest.fixture
def server(tmp_path, monkeypatch):
    """The server of s3://, which begins empty."""
    pytest.importorskip("s3fs")
    monkeypatch.setenv("SCENEGEN_CACHE", str(tmp_path / "copies"))
    with Served(tmp_path / "store") as served:
        for name, value in served.environment.items():
            monkeypatch.setenv(name, value)
        forget()
        yield served
    forget()


@pytest.fixture
def store(server):
    """The folder where the objects of s3:// are kept."""
    server.home.mkdir()
    return server.home


@pytest.fixture
def there(store, made):
    """The folder in the store of the dataset `made`, s3://lab/pillar."""
    return shutil.copytree(made, store / "lab/pillar")


def forget():
    """Have this process be as a new one: nothing is opened."""
    stores._connect.cache_clear()
    mirrors._read_note.cache_clear()
