"""Tasks whose worker dies, hangs, raises or eats memory cost themselves, and nothing else."""

import gc
import multiprocessing
import os
import time

import pytest

from scenegen.workers import Limited, run


def work(task: str) -> str:
    if task == "die":
        os.kill(os.getpid(), 9)
    if task == "sleep":
        time.sleep(60)
    if task == "raise":
        raise ValueError("two\nlines")
    if task == "eat":
        return str(len(bytearray(8 << 30)))
    return task


LIMITED: Limited[str, str] = Limited(
    work, lambda task: 2.0 if task == "sleep" else 60.0, 1 << 30, lambda task, why: f"{task}: {why}"
)


@pytest.mark.parametrize("workers", [1, 3])
def test_bad_tasks_are_given_up_and_good_ones_done(workers: int) -> None:
    others = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    others.start()
    tasks = ["a", "die", "raise", "sleep", "eat", "b"]
    begin = time.monotonic()
    results = list(run(LIMITED, tasks, workers))
    assert time.monotonic() - begin < 30
    assert sorted(results)[:2] == ["a", "b"]
    assert sorted(result.partition(":")[0] for result in results) == sorted(tasks)
    said = {result.partition(":")[0]: result for result in results}
    assert "crashed" in said["die"]
    assert "took too long" in said["sleep"]
    assert said["raise"] == "raise: ended in ValueError: two lines"
    assert "MemoryError" in said["eat"]
    assert multiprocessing.active_children() == [others]  # somebody else's process is left alone
    others.kill()
    others.join()


def test_too_many_deaths_end_the_run_but_not_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scenegen.workers.MOST_REPLACED", 1)
    results = list(run(LIMITED, ["die"] * 5, 1))
    assert len(results) == 5
    assert "crashed" in results[1]
    assert "was not examined" in results[-1]


def process(task: str) -> int:
    if task == "die":
        os.kill(os.getpid(), 9)
    return os.getpid()


def test_called_by_itself_a_limited_function_keeps_its_process_while_it_lives() -> None:
    """As executors on other machines call it."""
    limited: Limited[str, int] = Limited(process, lambda task: 60.0, 1 << 30, lambda task, why: -1)
    first = limited("a")
    assert first != os.getpid()
    assert limited("b") == first
    assert limited("die") == -1
    again = limited("c")
    assert again not in (first, os.getpid())
    del limited
    gc.collect()
    assert ended_soon(again), "it ends with the function"


def ended_soon(pid: int) -> bool:
    """Whether a process of this one's ends within seconds."""
    for _ in range(100):
        if all(child.pid != pid for child in multiprocessing.active_children()):
            return True
        time.sleep(0.05)
    return False
