"""A network as a row of the bench: it travels to worker processes by name, and each opens it once."""

from functools import cache
from typing import Any

import torch

from scenegen.dataset.read import Split
from scenegen.errors import DatasetError, printable
from scenegen.mapping import Mapper
from scenegen.model.checkpoint import load_network
from scenegen.model.completion.completer import Completer, called, locate, unlike
from scenegen.model.completion.protocol import Prediction
from scenegen.model.inputs import of_sample
from scenegen.model.runtime import examine
from scenegen.sample import Sample


class Pretrained:
    """The network called `weights` (see `Completer.from_pretrained`), on one thread of the CPU.

    Workers are many, and are forked: a pool of threads of their own would neither help nor survive. Raises
    CheckpointError where there is no such network.
    """

    learned = True

    def __init__(self, weights: str):
        self._path = locate(weights)
        if self._path.suffix == ".onnx":  # the workers must not start processes of their own
            self.about = examine(self._path)[1].about
        else:
            self.about = load_network(self._path)[2]
        """What is known of its training."""
        self.name = printable(called(weights, self._path))
        """How the network is called in tables, in one line."""

    def unlike(self, lidar: Any, mapping: Mapper | None = None, noise: str = "") -> str:
        """See `Completer.unlike`."""
        return unlike(self.name, self.about, lidar, mapping, noise)

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`. Raises DatasetError for another grid."""
        torch.set_num_threads(1)
        completer = _opened(str(self._path))
        try:
            completer.check_grid(split.dataset.grid)
            return completer(of_sample(completer.inputs, sample, split.dataset.grid, split.dataset.lidar))
        except ValueError as error:
            raise DatasetError(str(error)) from None


@cache
def _opened(path: str) -> Completer:
    return Completer.from_pretrained(path, threads=1)
