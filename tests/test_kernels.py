"""Processes that run the tests share the compiling of kernels: each once, and nobody goes on before
all is done."""

import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from lidarsim import jit
from tests import kernels

WORKERS = 3


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[str, str]]]:
    """Stand-ins for the tasks, and a cold cache; every begin and end is noted, with the task's
    name."""
    noted: list[tuple[str, str]] = []

    def stand_in(name: str):
        def task() -> None:
            noted.append(("begin", name))
            time.sleep(0.01)
            noted.append(("end", name))

        task.__name__ = name
        return task

    monkeypatch.setenv("SCENEGEN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(kernels, "TASKS", [stand_in(f"task{n}") for n in range(7)])
    for cached in (jit.cache_folder, jit.cache_trouble):
        cached.cache_clear()
    (tmp_path / "meeting").mkdir()
    yield noted
    for cached in (jit.cache_folder, jit.cache_trouble):
        cached.cache_clear()


def test_every_task_is_done_once_and_before_any_worker_goes_on(
    ran: list[tuple[str, str]], tmp_path: Path
) -> None:
    """Threads stand for processes: a lock belongs to the opened file."""
    done_when_going_on: list[int] = []

    def work(worker: int) -> None:
        kernels.share(worker, WORKERS, tmp_path / "meeting")
        done_when_going_on.append(sum(what == "end" for what, _ in ran))

    threads = [threading.Thread(target=work, args=(worker,)) for worker in range(WORKERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert Counter(name for what, name in ran if what == "begin") == {
        f"task{n}": 1 for n in range(7)
    }
    assert done_when_going_on == [7] * WORKERS


def test_a_run_that_finds_all_compiled_does_nothing(
    ran: list[tuple[str, str]], tmp_path: Path
) -> None:
    kernels.share(1, 2, tmp_path / "meeting")
    assert len(ran) == 14
    assert ran[0] == ("begin", "task3"), "the second of two begins at the second half"
    (tmp_path / "next").mkdir()
    kernels.share(0, 1, tmp_path / "next")
    assert len(ran) == 14
