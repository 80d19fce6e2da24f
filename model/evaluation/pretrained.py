"""A network as a row of the bench: it travels to worker processes by name, and each opens it
once."""

from typing import Any

import torch

from scenegen.dataset.read import Split
from scenegen.errors import DatasetError, printable
from scenegen.model.completion.completer import called, locate, open_network, opened_once, unlike
from scenegen.model.completion.protocol import Prediction
from scenegen.model.inputs import channels
from scenegen.model.runtime import examine
from scenegen.sample import Sample


class Pretrained:
    """The network called `weights` (see `Completer.from_pretrained`), on one thread of the CPU.

    Workers are many, and are forked: a pool of threads of their own would neither help nor survive.
    Raises CheckpointError where there is no such network.
    """

    learned = True

    def __init__(self, weights: str):
        self._weights, path = str(weights), locate(weights)
        if path.suffix == ".onnx":  # the workers must not start processes of their own
            self.about = examine(path)[1].about
        else:
            self.about = open_network(weights)[2]
        """What is known of its training."""
        self.name = printable(called(weights, path))
        """How the network is called in tables, in one line."""

    def unlike(self, *met: Any) -> str:
        """See `scenegen.model.completion.completer.unlike`."""
        return unlike(self.name, self.about, *met)

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`. Raises DatasetError for another grid."""
        torch.set_num_threads(1)
        completer = opened_once(self._weights, "cpu", 1)
        try:
            completer.check_grid(split.dataset.grid)
            return completer(
                channels(completer.inputs, sample, split.dataset.grid, split.dataset.lidar)
            )
        except ValueError as error:
            raise DatasetError(str(error)) from None
