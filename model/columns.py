"""Columns of a map as channels: a flat U-Net that sees every column whole, beside the levels of a 3-D one.

Small 3-D convolutions learn solids that lie anywhere, and see little of a column at a time; flat convolutions with z as
channels learn what stands upright from a few voxels of it (Roldão, de Charette, Verroust-Blondet 2020: LMSCNet). Here
each level of either hands the other what it has: c channels of h cells in height are c·h flat channels, and back.
"""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from scenegen.model.convolution import Conv2d


class Columns(nn.Module):
    """(B, inputs, X, Y, Z) and the 3-D skips, (B, c_l, X_l, Y_l, Z_l), finest first → features of the same shapes.

    `height` is Z, `levels` are pairs (c_l, Z_l), and `widths` are the flat net's channels, level by level. Where it is
    `alone`, there are no skips, and features of the finest level only.
    """

    def __init__(
        self,
        inputs: int,
        height: int,
        levels: Sequence[tuple[int, int]],
        widths: Sequence[int],
        *,
        alone: bool = False,
    ):
        super().__init__()
        self._levels = tuple(levels[:1] if alone else levels)
        cells = [channels * z for channels, z in self._levels]
        below = [widths[0], *widths]
        self.stem = _convolution(inputs * height, widths[0], stride=2)
        self.down = nn.ModuleList(_convolution(below[n], width, stride=2 if n else 1) for n, width in enumerate(widths))
        met = list(zip(cells, widths, strict=not alone))
        self.take = nn.ModuleList() if alone else nn.ModuleList(Conv2d(count, width, 1) for count, width in met)
        self.mix = nn.ModuleList(_convolution(width, width) for width in widths)
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(above, width, kernel_size=2, stride=2) for width, above in itertools.pairwise(widths)
        )
        self.refine = nn.ModuleList(
            nn.Sequential(_convolution(2 * width, width), _convolution(width, width)) for width in widths[:-1]
        )
        self.give = nn.ModuleList(Conv2d(width, count, 1) for count, width in met)

    def forward(self, x: Tensor, skips: Sequence[Tensor] = ()) -> list[Tensor]:
        """See the class."""
        flat, seen = self.stem(_flat(x)), []
        for down, mix, taken in itertools.zip_longest(self.down, self.mix, zip(self.take, skips, strict=True)):
            flat = down(flat)
            if taken is not None:
                take, skip = taken
                flat = flat + take(_flat(skip))
            flat = mix(flat)
            seen.append(flat)
        found = [flat]
        for up, refine, skip in reversed(list(zip(self.up, self.refine, seen, strict=False))):
            flat = refine(torch.cat((up(flat), skip), dim=1))
            found.insert(0, flat)
        return [
            give(flat).unflatten(1, level).permute(0, 1, 3, 4, 2)
            for give, flat, level in zip(self.give, found, self._levels, strict=False)
        ]


def _flat(x: Tensor) -> Tensor:
    """(B, C, X, Y, Z) → (B, C·Z, X, Y)."""
    return x.permute(0, 1, 4, 2, 3).flatten(1, 2)


def _convolution(below: int, width: int, stride: int = 1) -> nn.Sequential:
    """A 3 x 3 convolution, normalised, with its activation."""
    return nn.Sequential(
        Conv2d(below, width, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(width),
        nn.ReLU(inplace=True),
    )
