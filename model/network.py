"""The completion network, whole: the paper's dual-decoder U-Net with CrossFusion, and the variants that isolate it.

For a map of 80 x 80 x 40 voxels and width 8 (channels x cells):

    X 1x80x80x40 ─ Preprocess ─ Encode ──────── Encode ──────── Encode ─ SelfAttention ─ F_s
                                8x40x40x20      16x20x20x10     32x10x10x5
                                S1 │            S2 │            S3 │
    D 1x80x80x40 ─ FinalUp h_t ─ f_t1 ─ C1 ─── f_t2 ─ C2 ───── f_t3 ─ C3 ───── F_s
    O 1x80x80x40 ─ FinalUp h_o ─ f_o1 ─ C1 ─── f_o2 ─ C2 ───── f_o3 ─ C3 ───── F_s

Equations are numbered as in docs/network.md, which holds them against this file.
"""

from collections.abc import Mapping
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 (its usual name)
from torch import Tensor, nn

from scenegen.model.columns import Columns
from scenegen.model.config import LEVELS, TASKS, VARIANTS, NetworkConfig
from scenegen.model.convolution import Conv3d


class Output(NamedTuple):
    """What a network says about a batch of maps; None for what its variant does not predict."""

    logits: Tensor | None
    """(B, X, Y, Z): the probability of occupancy before its sigmoid."""
    tudf: Tensor | None
    """(B, X, Y, Z): metres, not negative, not truncated."""

    @classmethod
    def of(cls, found: Mapping[str, Tensor]) -> "Output":
        """From what the heads give, by task."""
        return cls(found.get("occupancy"), F.softplus(found["tudf"]) if "tudf" in found else None)


class Network(nn.Module):
    """Maps a named batch, (B, X, Y, Z) for each of the network's inputs, to an `Output` (the paper, section "Coupled
    TUDF-Occupancy Learning"). Other names in the batch are not looked at."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        variant = VARIANTS[config.variant]
        widths = [config.width * 2**level for level in range(LEVELS)]
        if variant.decoders:
            self.preprocess = Preprocess(len(config.inputs), widths[0], config.stem_stride)
            self.encoder = nn.ModuleList(
                Encode(below, width, stride=1 if level == 0 else 2)
                for level, (below, width) in enumerate(zip([widths[0], *widths], widths, strict=False))
            )
            self.attention = SelfAttention(widths[-1], config.heads)
        self.decoder = nn.ModuleDict({branch: Decoder(widths) for branch in variant.decoders})
        self.fusion = nn.ModuleList(CrossFusion(width) for width in widths) if variant.coupled else None
        levels = [(width, config.height // 2 ** (level + 1)) for level, width in enumerate(widths)]
        flat = len(config.inputs), config.height, levels, variant.columns
        self.columns = Columns(*flat, alone=not variant.decoders) if variant.columns else None
        features = 2 * widths[0] if variant.columns and variant.decoders else widths[0]
        self.head = nn.ModuleDict({task: FinalUp(features, widths[0]) for task in config.tasks})

    def placed(self, device: torch.device | str) -> "Network":
        """The network itself, on `device`, its filters laid out in memory with channels last, which is faster."""
        self.to(device)
        for parameter in self.parameters():
            if layout := {4: torch.channels_last, 5: torch.channels_last_3d}.get(parameter.ndim):
                parameter.data = parameter.data.contiguous(memory_format=layout)
        return self

    def forward(self, batch: Mapping[str, Tensor]) -> Output:
        """See the class."""
        features = self.features(batch)
        found = {task: head(features.get(task, features.get("shared"))) for task, head in self.head.items()}  # eq. 6
        return Output.of(found)

    def features(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """What the heads read, by decoder or under ``shared``: (B, width or twice that, X/2, Y/2, Z/2)."""
        given = torch.stack([batch[name].float() for name in self.config.inputs], dim=1)
        if self.columns is not None and not self.decoder:
            return {"shared": self.columns(given)[0]}
        x, skips = self.preprocess(given), []
        for encode in self.encoder:
            x = encode(x)
            skips.append(x)
        columns = None if self.columns is None else self.columns(given, skips)
        shared = self.attention(x)  # F_s
        features = dict.fromkeys(self.decoder, shared)
        for level in reversed(range(LEVELS)):
            features = {
                branch: decoder.stages[level](features[branch], skips[level])  # eq. 3 and 4
                for branch, decoder in self.decoder.items()
            }
            if self.fusion is not None:
                t, o = self.fusion[level](features["tudf"], features["occupancy"])  # eq. 5
                features = {"tudf": t, "occupancy": o}
            if columns is not None:
                features = {
                    branch: torch.cat((values, columns[0]), dim=1) if level == 0 else values + columns[level]
                    for branch, values in features.items()
                }
        return features


class Preprocess(nn.Sequential):
    """(B, inputs, X, Y, Z) → (B, width, X/2, Y/2, Z/2)."""

    def __init__(self, inputs: int, width: int, stride: int):
        super().__init__(
            *_convolution(inputs, width, stride=stride),
            *_convolution(width, width, stride=2 // stride),
        )


class Encode(nn.Sequential):
    """(B, below, ...) → (B, width, .../stride): a level of the encoder; what it gives is the level's skip S."""

    def __init__(self, below: int, width: int, stride: int):
        super().__init__(*_convolution(below, width, stride=stride), *_convolution(width, width))


class SelfAttention(nn.Module):
    """(B, C, x, y, z) → the same: every cell looks at every other, and adds what it found."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.to_qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        cells = x.flatten(2).transpose(1, 2)  # (B, cells, C)
        q, k, v = self.to_qkv(self.norm(cells)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        found = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        return x + self.out(found).transpose(1, 2).unflatten(2, x.shape[2:])


class Decoder(nn.Module):
    """One branch: f^(1), f^(2), f^(3), finest first."""

    def __init__(self, widths: list[int]):
        super().__init__()
        coarser = [*widths[1:], None]
        self.stages = nn.ModuleList(Decode(width, above) for width, above in zip(widths, coarser, strict=True))


class Decode(nn.Module):
    """f^(l): (B, above, ...) and the skip (B, width, 2 ...) → (B, width, 2 ...); the coarsest has nothing to double."""

    def __init__(self, width: int, above: int | None):
        super().__init__()
        self.up = nn.Identity() if above is None else nn.ConvTranspose3d(above, width, kernel_size=2, stride=2)
        self.refine = nn.Sequential(*_convolution(2 * width, width), *_convolution(width, width))

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """See the class."""
        return self.refine(torch.cat((self.up(x), skip), dim=1))


class CrossFusion(nn.Module):
    """Each branch adds what it learns from both; occupancy sees distances already refined, as eq. 5 is written."""

    def __init__(self, width: int):
        super().__init__()
        self.to_tudf, self.to_occupancy = (
            nn.Sequential(Conv3d(2 * width, width, 1), nn.ReLU(inplace=True), Conv3d(width, width, 1)) for _ in TASKS
        )

    def forward(self, t: Tensor, o: Tensor) -> tuple[Tensor, Tensor]:
        """(B, width, ...) each → the same."""
        t = t + self.to_tudf(torch.cat((t, o), dim=1))
        o = o + self.to_occupancy(torch.cat((o, t), dim=1))
        return t, o


class FinalUp(nn.Module):
    """(B, below, X/2, Y/2, Z/2) → (B, X, Y, Z): eight values a cell, one for each voxel in it.

    The slope below zero is not flat: with a ReLU here, channels that die leave the bias alone as an upper bound of the
    logit, and no probability ever passes the threshold.
    """

    def __init__(self, below: int, width: int, fields: int = 1):
        super().__init__()
        self.refine = nn.Sequential(*_convolution(below, fields * width)[:-1], nn.LeakyReLU(0.1, inplace=True))
        self.split = Conv3d(fields * width, fields * 8, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        return self.each(x)[0]

    def each(self, x: Tensor) -> list[Tensor]:
        """The same for every field that this head gives."""
        x = self.refine(x)
        with torch.autocast(x.device.type, enabled=False):  # bf16 keeps distances to a centimetre: slopes need better
            found = self.split(x.float())
        cells = (parts.unflatten(1, (2, 2, 2)) for parts in found.split(8, dim=1))  # (B, i, j, k, x, y, z)
        return [c.permute(0, 4, 1, 5, 2, 6, 3).flatten(5, 6).flatten(3, 4).flatten(1, 2) for c in cells]


def _convolution(below: int, width: int, stride: int = 1) -> list[nn.Module]:
    """A 3 x 3 x 3 convolution, normalised, with its activation."""
    return [
        Conv3d(below, width, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm3d(width),
        nn.ReLU(inplace=True),
    ]
