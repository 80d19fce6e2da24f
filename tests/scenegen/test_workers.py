"""Tasks whose worker dies, hangs, raises or eats memory cost themselves, and nothing else."""

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
