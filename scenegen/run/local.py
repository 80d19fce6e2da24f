"""Processes of this machine."""

from collections.abc import Callable, Generator, Sequence
from typing import Any

from scenegen.errors import DatasetError
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
