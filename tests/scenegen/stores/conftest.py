"""A bucket that is none, for this process and those that it forks."""

import pytest

from scenegen import stores
from scenegen.stores import cache
from tests.scenegen.stores.kept import HOME


@pytest.fixture
def store(tmp_path, monkeypatch):
    """The folder where the objects of s3:// are kept."""
    home = tmp_path / "store"
    home.mkdir()
    monkeypatch.setenv(HOME, str(home))
    monkeypatch.setenv("SCENEGEN_CACHE", str(tmp_path / "copies"))
    monkeypatch.setitem(stores.STORES.builtin, "s3", "tests.scenegen.stores.kept:Kept")
    forget()
    return home


def forget():
    """Have this process be as a new one: nothing is opened or seen."""
    stores._opened.cache_clear()
    stores._seen.clear()
    cache._noted.cache_clear()
