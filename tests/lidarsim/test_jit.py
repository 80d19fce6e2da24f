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
    cache_folder.cache_clear()
    jit.cache_trouble.cache_clear()
    yield folder
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


def test_the_folder_changes_with_files_that_hold_kernels_and_with_no_others(package):
    before = folder_now()
    assert before == folder_now()
    assert before.name.startswith("kernelled-")
    (package / "plain.py").write_text(PLAIN.replace("one", "two"))
    (package / "more.py").write_text("import numba\n")
    (package / "notes.txt").write_text("from lidarsim.jit import kernel")
    assert folder_now() == before
    seen = {before}
    for name, text in {"callee": CALLEE, "caller": CALLER}.items():
        (package / f"{name}.py").write_text(text + "\n# a word\n")
        assert folder_now() not in seen
        seen.add(folder_now())
    (package / "deeper").mkdir()
    (package / "deeper" / "extra.py").write_text(CALLEE)
    assert folder_now() not in seen
    (package / "deeper" / "extra.py").unlink()
    for name, text in {"callee": CALLEE, "caller": CALLER}.items():
        (package / f"{name}.py").write_text(text)
    assert folder_now() == before


def test_the_folder_follows_lidarsims_kernels_too(package, monkeypatch):
    """Those of any package may call them."""
    copy = shutil.copytree(Path(jit.__file__).parent, package.parent / "lidarsim")
    monkeypatch.setattr(jit, "__file__", str(copy / "jit.py"))
    before = folder_now()
    with open(copy / "lidar.py", "a") as file:
        file.write("# a word\n")
    assert folder_now() == before
    with open(copy / "voxelize.py", "a") as file:
        file.write("# a word\n")
    assert folder_now() != before


def test_the_folder_follows_numba(package, monkeypatch):
    before = folder_now()
    monkeypatch.setattr(numba, "__version__", "0.0")
    assert folder_now() != before


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_changes(package):
    """Numba's own cache would go on with the old one: the calling file is the same, to its date."""
    values = np.arange(4.0)
    assert fresh("caller").summed(values) == 12.0
    kept = sorted((package.parent / "cache").rglob("*.nbc"))
    assert {path.name.split("-")[0] for path in kept} == {"callee.scaled", "caller.summed"}
    again = fresh("caller")
    assert again.summed(values) == 12.0
    assert sum(again.summed.stats.cache_hits.values()) == 1, "what was compiled is not kept"
    assert sum(again.summed.stats.cache_misses.values()) == 0
    (package / "callee.py").write_text(CALLEE.replace("2.0", "5.0"))
    assert fresh("caller").summed(values) == 30.0


def test_the_cache_lies_where_the_environment_says(package, monkeypatch):
    at = package.parent
    places = {"SCENEGEN_CACHE": at / "own", "XDG_CACHE_HOME": at / "xdg"}
    for name, place in places.items():
        monkeypatch.setenv(name, str(place))
    assert folder_now().is_relative_to(places["SCENEGEN_CACHE"])
    monkeypatch.delenv("SCENEGEN_CACHE")
    assert folder_now().is_relative_to(places["XDG_CACHE_HOME"])
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(at))
    assert folder_now().is_relative_to(at / ".cache")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # as its specification says, void
    assert folder_now().is_relative_to(at / ".cache")


@pytest.mark.parametrize("level", ["", "scenegen", "scenegen/kernels", "scenegen/kernels/{name}"])
@pytest.mark.parametrize("what", ["open to others", "another user's", "a link"])
def test_kernels_are_not_taken_from_where_others_may_write(level, what, package, monkeypatch):
    assert fresh("callee").scaled(6.0) == 12.0
    root = package.parent / "cache"
    place = root / level.format(name=folder_now().name)
    if what == "open to others":
        place.chmod(0o777)
    elif what == "a link":
        place.rename(package.parent / "moved")
        place.symlink_to(package.parent / "moved")
    else:
        monkeypatch.setattr(jit.os, "geteuid", lambda: 54321)
        monkeypatch.setattr(jit, "ROOT", 54322)
    again = fresh("callee")
    assert again.scaled(6.0) == 12.0
    trouble = jit.cache_trouble("kernelled")
    if level == "" and what == "a link":  # the root's own name may be one
        assert trouble == ""
        return
    assert str(place if what != "another user's" else root) in trouble
    assert sum(again.scaled.stats.cache_hits.values()) == 0
    if what == "open to others":
        place.chmod(0o755)
        again = fresh("callee")
        assert (again.scaled(6.0), jit.cache_trouble("kernelled")) == (12.0, "")
        assert sum(again.scaled.stats.cache_hits.values()) == 1


def test_the_cache_is_made_for_its_user_alone(package):
    before = os.umask(0)
    try:
        assert fresh("callee").scaled(3.0) == 6.0
    finally:
        os.umask(before)
    folder = folder_now()
    levels = [
        folder,
        *(level for level in folder.parents if level.is_relative_to(package.parent / "cache")),
    ]
    assert len(levels) == 4
    assert {level.stat().st_mode & 0o777 for level in levels} == {0o700}


def test_a_root_that_all_may_write_to_but_nobody_may_move_in_serves(package):
    (package.parent / "cache").mkdir()
    (package.parent / "cache").chmod(0o1777)  # like /tmp
    folder_now()
    assert jit.cache_trouble("kernelled") == ""


def test_kernels_work_where_nothing_can_be_kept(package, monkeypatch):
    (package.parent / "file").write_text("in the way")
    monkeypatch.setenv("SCENEGEN_CACHE", str(package.parent / "file" / "cache"))
    assert fresh("callee").scaled(3.0) == 6.0


def test_making_a_kernel_leaves_numbas_settings_alone(package):
    before = numba.config.CACHE_DIR
    fresh("callee")
    assert before == numba.config.CACHE_DIR
    assert str(os.environ["SCENEGEN_CACHE"]) not in str(before)


def test_dividing_by_zero_in_a_kernel_is_numpys_infinity(package):
    (package / "divided.py").write_text(
        "from lidarsim.jit import kernel\n\n@kernel\ndef inverse(x):\n    return 1.0 / x\n"
    )
    assert fresh("divided").inverse(0.0) == np.inf
