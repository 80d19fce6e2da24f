"""Tasks whose worker dies, hangs, raises or eats memory cost themselves, and nothing else."""

import multiprocessing
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from scenegen.base.ray import pack, sent
from scenegen.base.workers import Limited, run


def work(task):
    if task == "pid":
        return os.getpid()
    if task == "die":
        os.kill(os.getpid(), 9)
    if task == "sleep":
        time.sleep(60)
    if task == "raise":
        raise ValueError("two\nlines")
    if task == "eat":
        return str(len(bytearray(8 << 30)))
    return task


LIMITED = Limited(
    work, lambda task: 0.2 if task == "sleep" else 60.0, 1 << 30, lambda task, why: f"{task}: {why}"
)


@pytest.fixture(autouse=True)
def begun():
    """Tells the processes that a test began and that run; they end with it."""
    before = set(multiprocessing.active_children())
    yield lambda: set(multiprocessing.active_children()) - before
    for child in set(multiprocessing.active_children()) - before:
        child.kill()
        child.join()


def test_bad_tasks_are_given_up_and_good_ones_done(begun):
    others = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    others.start()
    tasks = ["a", "die", "raise", "sleep", "eat", "b"]
    begin = time.monotonic()
    said = {result.partition(":")[0]: result for result in run(LIMITED, tasks, 3)}
    assert time.monotonic() - begin < 30
    assert sorted(said) == sorted(tasks)
    assert said["a"] == "a"
    assert said["b"] == "b"
    for task, told in (("die", "crashed"), ("sleep", "took too long"), ("eat", "MemoryError")):
        assert told in said[task]
    assert said["raise"].startswith("raise: ended in ")
    # its line too, once tests were named as one's own
    assert said["raise"].endswith("ValueError: two lines")
    # somebody else's process is left alone
    assert begun() == {others}


def test_too_many_deaths_end_the_run_but_not_the_caller(monkeypatch):
    monkeypatch.setattr("scenegen.base.workers.MAX_REPLACED", 1)
    results = list(run(LIMITED, ["die"] * 5, 1))
    assert len(results) == 5
    assert "crashed" in results[1]
    assert "was not examined" in results[-1]


def test_called_by_itself_a_limited_function_runs_in_a_process_that_it_keeps(begun):
    """As executors on other machines call it, task by task; one that died is begun again, and
    another function, thread or process has its own."""
    limited, other = (replace(LIMITED, given_up=lambda task, why: -1) for _ in range(2))
    first = limited("pid")
    assert limited("pid") == first != os.getpid()
    with ThreadPoolExecutor(1) as thread:  # with which its process ends
        assert thread.submit(limited, "pid").result() not in (-1, first)
    forked = multiprocessing.get_context("fork").Process(target=limited, args=("pid",), daemon=True)
    forked.start()
    forked.join()
    assert forked.exitcode == 0
    assert limited("pid") == first
    assert limited("die") == -1
    second = limited("pid")
    (kept,) = (child for child in begun() if child.pid == second)
    kept.kill()
    kept.join()
    third, last = limited("pid"), other("pid")
    assert len({-1, first, second, third, last}) == 5
    assert third not in {child.pid for child in begun()}


@pytest.fixture
def hostile(tmp_path, monkeypatch):
    """The working folder, which holds modules of well-known names, and gets a file `ran` if any is
    imported."""
    trap = f"open({str(tmp_path / 'ran')!r}, 'a')"
    for name in ("multiprocessing", "numpy", "scenegen", "lidarsim", "signal", "threading"):
        (tmp_path / f"{name}.py").write_text(trap)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)  # as a command may have left it
    return tmp_path


def test_a_spawned_process_imports_nothing_from_the_working_folder(hostile):
    assert list(run(LIMITED, ["die", "a", "b"], 1))[1:] == ["a", "b"]
    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(replace(LIMITED), "abcd")) == list("abcd")
    assert not (hostile / "ran").exists()
    assert "PYTHONSAFEPATH" not in os.environ  # the caller's own processes are left alone


def test_a_task_elsewhere_imports_from_the_working_folder_only_what_was_named(hostile, monkeypatch):
    """As of the registry, which appends the folder where a user names a module of his own."""
    bare, before = sent(len), list(sys.path)
    monkeypatch.setattr(sys, "path", [*before, str(hostile)])
    named = sent(len)
    monkeypatch.setattr(sys, "path", list(before))
    assert tuple(bare(pack("ab"))) == (2, "")
    assert sys.path == before
    assert tuple(named(pack("ab"))) == (2, "")
    assert sys.path == [*before, str(hostile)]
