"""Convolutions that complete a map alone as fast as in a batch.

On a CPU, torch leaves a batch of one small map to a path that takes four times as long, and rounds otherwise, than that
of larger batches: oneDNN, which is asked for all of them here (docs/log.md).
"""

from typing import Any

import torch
from torch import Tensor, nn


class _Direct:
    def forward(self: Any, x: Tensor) -> Tensor:
        """See torch's own."""
        plain = x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")
        if plain and torch.is_inference_mode_enabled() and torch.backends.mkldnn.is_available():
            given = self.padding, self.stride, self.dilation, self.groups
            return torch.mkldnn_convolution(x, self.weight, self.bias, *given)
        found: Tensor = super().forward(x)  # type: ignore[misc]
        return found


class Conv2d(_Direct, nn.Conv2d):
    """torch's, with numbers for its padding."""


class Conv3d(_Direct, nn.Conv3d):
    """torch's, with numbers for its padding."""
