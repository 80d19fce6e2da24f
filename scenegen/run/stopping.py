"""What is undone should this process be ended at once: drafts are removed, workers ended."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

_begun: list[Callable[[], object]] = []


@contextmanager
def undone_if_stopped(undo: Callable[[], object]) -> Iterator[None]:
    """While the block runs, `undo_all` calls `undo`, which must be quick and wait for nobody."""
    _begun.append(undo)
    try:
        yield
    finally:
        _begun.remove(undo)


def undo_all() -> None:
    """Undo what is begun and not finished, the latest first."""
    for undo in reversed(_begun):
        with suppress(Exception):  # what cannot be undone must not keep the rest
            undo()
