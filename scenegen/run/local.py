"""Processes of this machine: all of them, or one of many jobs that are told apart by their rank."""

import os
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

from scenegen.errors import DatasetError, short
from scenegen.run import Executor
from scenegen.run.workers import run


class Local(Executor):
    """See `Executor`. Raises DatasetError where an address is given."""

    def __init__(self, address: str, workers: int):
        if address:
            raise DatasetError(
                f"--on local://{address}: this machine has no address; give --on local"
            )
        self.workers = workers

    def __call__(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], on_start: Callable[[], None]
    ) -> Generator[Any, None, None]:
        """See `Executor`."""
        return run(function, tasks, self.workers, on_start)


NAMES = (
    ("SCENEGEN_RANK", "SCENEGEN_WORLD_SIZE"),
    ("JOB_COMPLETION_INDEX", "SCENEGEN_WORLD_SIZE"),
    ("RANK", "WORLD_SIZE"),
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"),
    ("SLURM_PROCID", "SLURM_NTASKS"),
)
"""Where rank and world size stand in the environment; the first pair that is there counts. What the
user set, for an indexed Job of Kubernetes the size alone, comes first. Then torchrun, which begins
several processes in one of Slurm's tasks; then Slurm's own job arrays and tasks."""
FIRST = "SLURM_ARRAY_TASK_MIN"
"""The least number of a job array, which need not be 0."""


class Rank(Executor):
    """See `Executor`: every world-size-th task, from the rank on, by processes of this machine.

    Raises DatasetError where an address is given, and where the environment tells no rank.
    """

    def __init__(self, address: str, workers: int):
        if address:
            raise DatasetError(
                f"--on rank://{address}: the environment tells the rank; give --on rank"
            )
        self.rank, self.size = rank_of(os.environ)
        self.workers = workers

    def mine(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """See `Executor`."""
        return tasks[self.rank :: self.size]

    def __call__(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], on_start: Callable[[], None]
    ) -> Generator[Any, None, None]:
        """See `Executor`."""
        return run(function, tasks, self.workers, on_start)


def rank_of(environment: Mapping[str, str]) -> tuple[int, int]:
    """Rank, from 0, and world size. Raises DatasetError where `environment` does not tell both, or
    impossible ones."""
    for names in NAMES:
        if not set(names) <= environment.keys():
            continue
        given = [environment[name] for name in names]
        if not all(value.isascii() and value.isdigit() for value in given):
            break
        rank, size = map(int, given)
        if names[0] == "SLURM_ARRAY_TASK_ID":
            rank -= int(environment.get(FIRST, "0"))
        if not 0 <= rank < size:
            break
        return rank, size
    else:
        told = ", or ".join(" and ".join(names) for names in NAMES)
        raise DatasetError(f"--on rank: the environment tells no rank; set {told}")
    raise DatasetError(
        f"--on rank: {names[0]}={short(given[0])}, {names[1]}={short(given[1])}; expected whole "
        f"numbers, the first "
        "from 0 to one less than the second"
    )
