"""A network as a row of the bench: it travels to worker processes by name, and each opens it once."""

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.errors import DatasetError
from scenegen.model.completion.completer import Completer, called, locate
from scenegen.model.completion.protocol import Prediction
from scenegen.model.runtime import examine


class Pretrained:
    """The network called `weights` (see `Completer.from_pretrained`), on one thread of the CPU.

    Workers are many, and are forked: a pool of threads of their own would neither help nor survive. Raises
    CheckpointError where there is no such network.
    """

    def __init__(self, weights: str):
        self._path = locate(weights)
        if self._path.suffix == ".onnx":  # the workers must not start processes of their own
            examine(self._path)
        self.name = called(weights, self._path)
        """How the network is called in tables."""

    def complete(self, observed: NDArray[np.bool_], free: NDArray[np.bool_], *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`. Raises DatasetError for another grid."""
        torch.set_num_threads(1)
        try:
            return _opened(str(self._path)).complete(observed, free, grid=grid)
        except ValueError as error:
            raise DatasetError(str(error)) from None


@cache
def _opened(path: str) -> Completer:
    return Completer.from_pretrained(path, threads=1)
