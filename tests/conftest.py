"""Small worlds, grids and sensors, so that a whole dataset takes a second."""

import atexit
import fcntl
import gc
import os
import pickle
import re
import shutil
import sys
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # processes share the cores, whatever they import

import numpy as np

from lidarsim.jit import cache_folder
from scenegen.base.errors import ScenegenError
from scenegen.dataset import shard
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.draw.source import DrawnWorlds
from scenegen.verification import verify
from scenegen.worlds.place import VoxelMap, encode_map
from scenegen.worlds.recipe import make_recipe
from tests import refusals
from tests.command_line import SMALL as SMALL_FILE
from tests.shell import Shell

SMALL = {
    "flight": {"viewpoints": 3, "margin_m": 2.0, "min_distance_m": 4.0, "iterations": 300},
    "lidar": {"rows": 8, "columns": 24},
    "grid": {"shape": (24, 24, 16)},
    "accept": {"min_solids": 1.0},
    "world": {"size_m": (16.0, 16.0, 8.0)},
}

MEMORY, ROOM_BYTES = Path("/dev/shm"), 4 << 30
# a file system in memory, if it has room and runs scripts: a journal takes 5 ms for each new file
if os.access(MEMORY, os.W_OK):
    RUNS_SCRIPTS = not os.statvfs(MEMORY).f_flag & os.ST_NOEXEC
    if RUNS_SCRIPTS and shutil.disk_usage(MEMORY).free > ROOM_BYTES:
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

LONG = ("test_silence.py", "test_export.py", "test_train.py")


MANY = 300
"""A run of this many tests needs most kernels."""
COUNTS, THREE = {"train": 11, "val": 2, "test": 4}, {"train": 3, "val": 0, "test": 0}


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """What is imported stays: the garbage collector looks for none in it, neither meanwhile nor in
    any test, where it comes seldom. Its bytecode is kept, whatever the environment says: pytest
    writes assertions anew for five seconds, and processes that tests start would compile all of
    scenegen."""
    unkept, sys.dont_write_bytecode = sys.dont_write_bytecode, False
    if "PYTEST_XDIST_WORKER" in os.environ:
        atexit.register(
            os._exit, 0
        )  # a worker has reported by then; taking apart what it imported takes seconds
    gc.disable()
    try:
        return (yield)
    finally:
        sys.dont_write_bytecode = unkept
        gc.freeze()
        gc.set_threshold(20_000)
        gc.enable()


def pytest_sessionfinish():
    """Libraries that count what is left when a process ends find it gone; a worker counts
    nothing, and is spared the seconds that pytest takes to collect what was imported."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        gc.unfreeze()


def pytest_collection_modifyitems(items):
    """Long tests come first: what is left for the end divides evenly. So do those of the shell,
    which one worker then opens."""
    items.sort(key=lambda item: item.path.name not in LONG and "shell" not in item.fixturenames)


@pytest.fixture(scope="session", autouse=True)
def compiled(request, once):
    """Kernels that most tests need, where no earlier run compiled them: one worker of a long run
    makes and verifies a dataset, and the others wait, lest each compile them."""
    stamp = cache_folder("scenegen") / "compiled-for-tests"  # a folder of its own for other kernels

    def make(folder):
        build(plan_of(folder / "d"), workers=2)  # a process more compiles those of the truth
        verify(folder / "d")
        stamp.touch()

    if len(request.session.items) >= MANY and not stamp.exists():
        once("compiled", make)


TAKEN = ("in DataLoader worker", "/x\nscenegen: ")
"""Lines within an error that no user sees as lines."""


@pytest.fixture(scope="session", autouse=True)
def every_error_of_ours_is_one_line(tmp_path_factory):
    """Whatever a test is about."""
    refusals.BASE.append(re.sub(r"/popen-gw\d+$", "", str(tmp_path_factory.getbasetemp())))
    longer = []

    def noted(self, *words):
        Exception.__init__(self, *words)
        # torch unwraps its own, and a folder's name is escaped when it is printed
        if "\n" in str(self) and not any(part in str(self) for part in TAKEN):
            longer.append(words)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ScenegenError, "__init__", noted)
        yield
    assert not longer


def plan_of(folder, recipe=None, **options):
    """What a dataset of worlds that a recipe draws will be; of three samples by default."""
    recipe, usual = recipe or small_recipe(), {"seed": 0, "counts": THREE}
    return plan_dataset(folder, recipe, DrawnWorlds(recipe), **usual | options)


def hall_in(folder, states):
    """The file of a map of voxels of 0.2 m that have these states."""
    path = folder / "hall.npz"
    path.write_bytes(encode_map(VoxelMap(states, 0.2, np.zeros(3)), "hall"))
    return path


def stop_at_val(report, fresh):
    """Stops a build at the first shard of its val split."""
    if report.entry.file.startswith("val"):
        raise KeyboardInterrupt


def dataset_in(folder, recipe=None, **options):
    """Such a dataset, made."""
    build(plan_of(folder, recipe, **options))
    return Dataset(folder)


def contents(place):
    """A file, or all files below a folder, of which there is one at least, by name."""
    files = [place] if place.is_file() else [path for path in place.rglob("*") if path.is_file()]
    assert files, f"{place} holds nothing"
    return {str(path.relative_to(place)): path.read_bytes() for path in files}


def small_recipe(kind="pillar", **tables):
    """The preset of `kind` with everything made small, and `tables` put in."""
    merged = {name: {**SMALL.get(name, {}), **tables.get(name, {})} for name in {*SMALL, *tables}}
    return make_recipe(kind, merged, where="test")


def scene_recipe():
    """The same for worlds from files."""
    tables = {name: SMALL[name] for name in ("flight", "lidar", "grid", "accept")}
    return make_recipe("scene", tables, where="test")


def picky_recipe():
    """A small recipe that rejects some worlds and some viewpoints of every shard of a few
    worlds."""
    return small_recipe(
        world={"density": (0.005, 0.06), "height_m": (3.0, 8.0)},
        accept={"min_solids": 2.0, "min_occupied_share": 0.01, "min_returned_share": 0.03},
        flight={"altitude_m": (1.5, 5.0)},
    )


def quarter(count, part=4):
    """A test of so many instances, its argument `count`: a quarter of them, or another part, by
    default, all among the slow tests."""
    return pytest.mark.parametrize(
        "count", [count // part, pytest.param(count, marks=pytest.mark.slow)]
    )


DRAWN = {}
"""Units that were drawn, by all that they depend on."""


def remembered(*given, draw=shard.draw_unit, **more):
    """`draw_unit`, but a unit is drawn once for all tests of a process; test_draw.py shows that its
    arguments alone decide what it gives."""
    key = pickle.dumps((given, more))
    if key not in DRAWN:
        DRAWN[key] = draw(*given, **more)
    return DRAWN[key]


@pytest.fixture
def drawn_once(monkeypatch):
    """Tests of what becomes of samples make datasets of units that are drawn already."""
    monkeypatch.setattr(shard, "draw_unit", remembered)


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """Makes a folder once for all processes that run tests: the first that asks fills it, and the
    others wait.

    Tests of several processes read what is in it at the same time, and must not change it.
    """
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def make(name, fill):
        folder = base / name
        with open(base / f"{name}.made", "a+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if (
                lock.seek(0, os.SEEK_END) == 0
            ):  # which may have been written while this process waited
                shutil.rmtree(folder, ignore_errors=True)  # which another process could not fill
                folder.mkdir()
                fill(folder)
                lock.write("made")
        return folder

    return make


@pytest.fixture(scope="session")
def made(once):
    """A dataset of seven shards; not to be changed."""

    def make(folder):
        dataset_in(folder / "pillar", seed=3, counts=COUNTS, shard_samples=3)

    return once("made", make) / "pillar"


@pytest.fixture(params=["pillar", "geometric"])
def drawn(request):
    """A small recipe of each kind, and its source."""
    recipe = small_recipe(request.param)
    return recipe, DrawnWorlds(recipe)


@pytest.fixture
def rng():
    """Random numbers, the same for every test."""
    return np.random.default_rng(0)


@pytest.fixture
def standing(tmp_path, monkeypatch):
    """A user's folder, to stand in; what is imported meanwhile is forgotten afterwards."""
    before = list(sys.path), set(sys.modules)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.path[:] = before[0]
    for name in set(sys.modules) - before[1]:
        if Path(getattr(sys.modules[name], "__file__", None) or "").is_relative_to(tmp_path):
            del sys.modules[name]


@pytest.fixture
def small(tmp_path):
    """A recipe file for a small dataset."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL_FILE)
    return path


@pytest.fixture(scope="session")
def shell():
    """Runs files and the installed script as a user does."""
    opened = Shell()
    yield opened
    opened.close()
