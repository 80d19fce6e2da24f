"""Kernels give what their Python functions give, and no kernel outlives a change of what it was
compiled from."""

import importlib
import os
import shutil
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from lidarsim import jit
from lidarsim.jit import cache_folder

CALLEE = """
from lidarsim.jit import kernel

FACTOR = 2.0

@kernel
def scaled(x):
    return FACTOR * x
"""
CALLER = """
from lidarsim.jit import kernel
from kernelled.callee import scaled

@kernel
def summed(values):
    total = 0.0
    for value in values:
        total += scaled(value)
    return total
"""
PLAIN = '"""No kernels here."""\nWORDS = ("one",)\n'


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with a kernel that calls one in another file, a cache of its own, and nothing left
    of it afterwards."""
    folder = tmp_path / "kernelled"
    folder.mkdir()
    for name, text in {"__init__": "", "callee": CALLEE, "caller": CALLER, "plain": PLAIN}.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("SCENEGEN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    forget()
    numbas = numba.config.CACHE_DIR
    yield folder
    assert numbas == numba.config.CACHE_DIR  # no kernel changed numba's settings
    forget()


def forget():
    """As a new process would begin."""
    for name in [name for name in sys.modules if name.split(".")[0] == "kernelled"]:
        del sys.modules[name]
    cache_folder.cache_clear()
    jit.cache_trouble.cache_clear()
    importlib.invalidate_caches()


def fresh(module):
    forget()
    return importlib.import_module(f"kernelled.{module}")


def folder_now():
    fresh("plain")
    return cache_folder("kernelled")


def trouble_now():
    fresh("plain")
    return jit.cache_trouble("kernelled")


def test_the_folder_changes_with_files_that_hold_kernels_and_with_no_others(package, monkeypatch):
    """With lidarsim's too, which those of any package may call; and with numba's version."""
    lidarsim = shutil.copytree(Path(jit.__file__).parent, package.parent / "lidarsim")
    monkeypatch.setattr(jit, "__file__", str(lidarsim / "jit.py"))
    before = folder_now()
    assert before.name.startswith("kernelled-")
    (package / "plain.py").write_text(PLAIN.replace("one", "two"))
    (package / "more.py").write_text("import numba\n")
    (package / "notes.txt").write_text("from lidarsim.jit import kernel")
    (lidarsim / "lidar.py").write_text("# a word\n")
    assert folder_now() == before
    (package / "deeper").mkdir()
    (package / "deeper" / "extra.py").write_text(CALLEE)
    seen = {before, folder_now()}
    for file in (package / "callee.py", package / "caller.py", lidarsim / "voxelization.py"):
        file.write_text(file.read_text() + "\n# a word\n")
        seen.add(folder_now())
    monkeypatch.setattr(numba, "__version__", "0.0")
    assert len({*seen, folder_now()}) == 6


def test_a_kernel_follows_those_that_it_calls(package):
    """Numba's own cache would go on with the old one: the calling file is the same, to its date."""
    values = np.arange(4.0)
    first = fresh("caller")
    assert first.summed(values) == 12.0
    assert "compiled" not in vars(first.scaled)  # what is only called needs no wrapper for Python
    names = {path.name.split("-")[0] for path in (package.parent / "cache").rglob("*.nbc")}
    assert names == {"callee.scaled", "caller.summed"}
    again = fresh("caller").summed
    assert again(values) == 12.0
    stats = again.compiled.stats  # what was compiled is kept
    assert sum(stats.cache_hits.values()) == 1
    assert sum(stats.cache_misses.values()) == 0
    (package / "callee.py").write_text(CALLEE.replace("2.0", "5.0"))
    assert fresh("caller").summed(values) == 30.0


def test_the_cache_lies_where_the_environment_says(package, monkeypatch):
    at = package.parent
    monkeypatch.setenv("HOME", str(at))
    for own, users, place in (
        (at / "own", at / "xdg", "own"),
        ("", at / "xdg", "xdg"),
        ("", "", ".cache"),
        ("", "relative", ".cache"),  # as its specification says, void
    ):
        monkeypatch.setenv("SCENEGEN_CACHE", str(own))
        monkeypatch.setenv("XDG_CACHE_HOME", str(users))
        assert folder_now().is_relative_to(at / place)


@pytest.mark.parametrize("level", ["", "scenegen", "scenegen/kernels", "scenegen/kernels/{name}"])
def test_a_folder_that_others_may_change_is_reported(level, package):
    assert trouble_now() == ""
    place = package.parent / "cache" / level.format(name=folder_now().name)
    place.chmod(0o777)
    assert str(place) in trouble_now()
    place.chmod(0o755)
    assert trouble_now() == ""
    place.rename(package.parent / "moved")
    place.symlink_to(package.parent / "moved")
    assert (str(place) in trouble_now()) == bool(level)  # the root's own name may be a link


def test_kernels_are_not_taken_from_another_users_folder(package, monkeypatch):
    assert fresh("callee").scaled(6.0) == 12.0
    monkeypatch.setattr(jit.os, "geteuid", lambda: 54321)
    monkeypatch.setattr(jit, "ROOT", 54322)
    again = fresh("callee").scaled
    assert again(6.0) == 12.0
    assert str(package.parent / "cache") in jit.cache_trouble("kernelled")
    assert not again.compiled.stats.cache_hits


def test_the_cache_is_made_for_its_user_alone(package):
    before = os.umask(0)
    try:
        assert trouble_now() == ""
    finally:
        os.umask(before)
    folder, root = folder_now(), package.parent / "cache"
    levels = [folder, *(one for one in folder.parents if one.is_relative_to(root))]
    assert [level.stat().st_mode & 0o777 for level in levels] == [0o700] * 4
    root.chmod(0o1777)  # like /tmp, where nobody may move what is another's
    assert trouble_now() == ""


def test_kernels_work_where_nothing_can_be_kept(package, monkeypatch):
    (package.parent / "file").write_text("in the way")
    monkeypatch.setenv("SCENEGEN_CACHE", str(package.parent / "file" / "cache"))
    assert fresh("callee").scaled(3.0) == 6.0
