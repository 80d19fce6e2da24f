"""The completion network, whole: the paper's dual-decoder U-Net with CrossFusion, and its variants.

For a map of 80 x 80 x 40 voxels and width 8 (channels x cells):

    X 1x80x80x40 ─ preprocess ─ encoder[0] ──── encoder[1] ──── encoder[2] ─ SelfAttention ─ F_s
                                8x40x40x20      16x20x20x10     32x10x10x5
                                S1 │            S2 │            S3 │
    D 1x80x80x40 ─ FinalUp h_t ─ f_t1 ─ C1 ─── f_t2 ─ C2 ───── f_t3 ─ C3 ───── F_s
    O 1x80x80x40 ─ FinalUp h_o ─ f_o1 ─ C1 ─── f_o2 ─ C2 ───── f_o3 ─ C3 ───── F_s

Equations are numbered as in docs/network.md, which holds them against this file. A network of
one's own is a class like `Network`: docs/own-network.md.
"""

import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 (its usual name)
from torch import Tensor, nn

from lidarsim import GridSpec
from scenegen.base.errors import ScenegenError
from scenegen.base.executors import processor
from scenegen.model.config import (
    LEVELS,
    NETWORKS,
    SHARED,
    TASKS,
    VARIANTS,
    NetworkConfig,
    named,
    target_name,
)
from scenegen.model.targets import Target, targets_of

Batch = dict[str, Tensor]
"""A named batch, (B, *grid.shape) each: a network's inputs. In training, the truth of its targets,
too, and always the true ``occupancy`` and ``tudf``; and where maps of real places are among them,
what is ``known``, and which distances are ``certain``: nothing unknown is nearer than what is known
to be occupied."""


class Output(NamedTuple):
    """What a network says about a batch of maps; None for what it does not predict."""

    logits: Tensor | None
    """(B, X, Y, Z): the probability of occupancy before its sigmoid."""
    tudf: Tensor | None
    """(B, X, Y, Z): metres, not negative, not truncated."""
    others: Mapping[str, Tensor] = {}
    """(B, X, Y, Z) or (B, channels, X, Y, Z): its other targets, by `target_name`."""

    @classmethod
    def of(cls, heads: Mapping[str, Tensor], targets: Mapping[str, Target]) -> "Output":
        """From what the heads give, by target."""
        outputs = {name: targets[name].output(values) for name, values in heads.items()}
        return cls(outputs.pop("occupancy", None), outputs.pop("tudf", None), outputs)

    @property
    def by_target(self) -> dict[str, Tensor]:
        """What it says, by target."""
        outputs = {"occupancy": self.logits, "tudf": self.tudf, **self.others}
        return {name: values for name, values in outputs.items() if values is not None}

    def predictions(self, targets: Mapping[str, Target], grid: GridSpec) -> dict[str, Tensor]:
        """What a `Prediction` keeps of it, by the name of its array."""
        return {
            targets[name].part or name: targets[name].prediction(values.float(), grid)
            for name, values in self.by_target.items()
        }


def build(config: NetworkConfig) -> nn.Module:
    """The network that `config` names, with random weights; it keeps `config`, and has `tasks`,
    names of all that it predicts, and these `targets` themselves by `target_name`.

    Raises ScenegenError for a name that leads to none.
    """
    network = named(NETWORKS, config.variant)(config)
    if not isinstance(network, nn.Module):
        raise ScenegenError(
            f"variant {config.variant}: makes {type(network).__name__}, expected a torch.nn.Module"
        )
    network.register_forward_pre_hook(_inputs_alone)
    network.tasks = tuple(dict.fromkeys((*getattr(network, "tasks", TASKS), *config.targets)))
    network.config, network.targets = config, targets_of(network.tasks)
    return network


def _inputs_alone(network: Any, given: tuple[Any, ...]) -> tuple[Any, ...]:
    """What a network is given, without the truth that is in a batch."""
    return given and ({name: given[0][name] for name in network.config.inputs}, *given[1:])


def placed(network: nn.Module, device: torch.device | str) -> nn.Module:
    """`network` itself on `device`, its filters in memory with channels last, which is faster."""
    network.to(device)
    for parameter in network.parameters():
        if layout := {4: torch.channels_last, 5: torch.channels_last_3d}.get(parameter.ndim):
            parameter.data = parameter.data.contiguous(memory_format=layout)
    return network


def prefers_bfloat16() -> bool:
    """Whether this machine's processor is faster in bfloat16 than in float32: with AMX, and one of
    AMD's with AVX-512. Intel's with AVX-512 alone take 1.4 times as long (docs/log)."""
    has: Any = getattr(torch.cpu, "get_capabilities", dict)()  # not in torch 2.10
    return bool(has.get("amx_bf16" if "Intel" in processor() else "avx512_bf16"))


class Network(nn.Module):
    """Maps a named batch, (B, X, Y, Z) for each of its inputs, to an `Output` (the paper, section
    "Coupled TUDF-Occupancy Learning"). Other names in the batch are not looked at."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        variant = VARIANTS[config.variant]
        self.tasks = (*variant.tasks, *config.targets)
        self.targets = targets_of(self.tasks)
        branches = variant.decoders
        if branches != SHARED:  # what is not of the variant has a decoder, and is not coupled
            branches = (*branches, *map(target_name, config.targets))
        inputs, widths = len(config.inputs), [config.width * 2**level for level in range(LEVELS)]
        features = finest = widths[0]
        self.preprocess = nn.Sequential(
            *_convolution(inputs, finest, stride=2), *_convolution(finest, finest)
        )
        self.encoder = nn.ModuleList(
            nn.Sequential(*_convolution(below, width, stride), *_convolution(width, width))
            for below, width, stride in zip([finest, *widths], widths, (1, 2, 2), strict=False)
        )
        self.attention = SelfAttention(widths[-1], config.heads)
        self.decoder = nn.ModuleDict({branch: Decoder(widths) for branch in branches})
        self.fusion = nn.ModuleList(map(CrossFusion, widths)) if variant.coupled else None
        self.columns = None
        if variant.columns:
            levels = [(c, config.height // 2 ** (level + 1)) for level, c in enumerate(widths)]
            self.columns = Columns(inputs, config.height, levels, variant.columns)
            features = 2 * finest
        self.head = nn.ModuleDict(
            {
                name: FinalUp(features, finest, config.channels_of(name))
                for name in map(target_name, self.tasks)
            }
        )

    def forward(self, batch: Batch) -> Output:
        """What the heads make of the features (eq. 6)."""
        features = self.features(batch)
        heads = {
            name: head(features.get(name, features.get("shared")))
            for name, head in self.head.items()
        }
        return Output.of(heads, self.targets)

    def features(self, batch: Batch) -> dict[str, Tensor]:
        """What the heads read, by decoder or under ``shared``: (B, features, X/2, Y/2, Z/2)."""
        voxels = torch.stack([batch[name].float() for name in self.config.inputs], dim=1)
        x, skips = self.preprocess(voxels), []
        for encode in self.encoder:
            x = encode(x)
            skips.append(x)
        columns = None if self.columns is None else self.columns(voxels, skips)
        features = dict.fromkeys(self.decoder, self.attention(x))  # F_s
        for level in reversed(range(LEVELS)):
            features = {
                branch: decoder.stages[level](features[branch], skips[level])  # eq. 3 and 4
                for branch, decoder in self.decoder.items()
            }
            if self.fusion is not None:
                t, o = self.fusion[level](features["tudf"], features["occupancy"])  # eq. 5
                features |= {"tudf": t, "occupancy": o}
            if columns is not None:
                flat = columns[level]
                features = {
                    branch: torch.cat((x, flat), dim=1) if level == 0 else x + flat
                    for branch, x in features.items()
                }
        return features


class SelfAttention(nn.Module):
    """(B, C, x, y, z) → the same: every cell looks at every other, and adds what it found."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.to_qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """As the class says."""
        cells = x.flatten(2).transpose(1, 2)  # (B, cells, C)
        qkv = self.to_qkv(self.norm(cells)).unflatten(-1, (3, self.heads, -1))
        q, k, v = qkv.permute(2, 0, 3, 1, 4)  # (B, heads, cells, C / heads) each
        result = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        return x + self.out(result).transpose(1, 2).unflatten(2, x.shape[2:])


class Decoder(nn.Module):
    """One branch: f^(1), f^(2), f^(3), finest first."""

    def __init__(self, widths: Sequence[int]):
        super().__init__()
        self.stages = nn.ModuleList(map(Decode, widths, [*widths[1:], None]))


class Decode(nn.Module):
    """f^(l): (B, above, ...) and the skip (B, width, 2 ...) → (B, width, 2 ...); the coarsest has
    nothing to double."""

    def __init__(self, width: int, above: int | None):
        super().__init__()
        self.up = nn.Identity() if above is None else nn.ConvTranspose3d(above, width, 2, stride=2)
        self.refine = nn.Sequential(*_convolution(2 * width, width), *_convolution(width, width))

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """As the class says."""
        return self.refine(torch.cat((self.up(x), skip), dim=1))


class CrossFusion(nn.Module):
    """Each branch adds what it learns from both; occupancy sees distances already refined, as
    eq. 5 is written."""

    def __init__(self, width: int):
        super().__init__()
        self.to_tudf, self.to_occupancy = (
            nn.Sequential(
                Conv3d(2 * width, width, 1), nn.ReLU(inplace=True), Conv3d(width, width, 1)
            )
            for _ in TASKS
        )

    def forward(self, t: Tensor, o: Tensor) -> tuple[Tensor, Tensor]:
        """(B, width, ...) each → the same."""
        t = t + self.to_tudf(torch.cat((t, o), dim=1))
        o = o + self.to_occupancy(torch.cat((o, t), dim=1))
        return t, o


class FinalUp(nn.Module):
    """(B, below, X/2, Y/2, Z/2) → (B, X, Y, Z), or (B, channels, X, Y, Z) for several: eight values
    a cell, one for each voxel in it.

    The slope below zero is not flat: with a ReLU here, channels that die leave the bias alone as an
    upper bound of the logit, and no probability ever passes the threshold.
    """

    def __init__(self, below: int, width: int, channels: int = 1):
        super().__init__()
        self.refine = nn.Sequential(
            *_convolution(below, width)[:-1], nn.LeakyReLU(0.1, inplace=True)
        )
        self.split = Conv3d(width, 8 * channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """As the class says."""
        x = self.refine(x)
        # bfloat16 keeps distances to a centimetre, and slopes, their differences, need better
        with torch.autocast(x.device.type, enabled=False):
            cells = self.split(x.float()).unflatten(1, (-1, 2, 2, 2))
        # (B, c, i, j, k, x, y, z) → (B, c, x, i, y, j, z, k) → (B, c, X, Y, Z)
        voxels = cells.permute(0, 1, 5, 2, 6, 3, 7, 4).flatten(6, 7).flatten(4, 5).flatten(2, 3)
        return voxels.squeeze(1)


class Columns(nn.Module):
    """Columns of a map as channels: a flat U-Net that sees every column whole, beside the 3-D one.

    (B, inputs, X, Y, Z) and the 3-D skips, (B, c_l, X_l, Y_l, Z_l), finest first → features of the
    same shapes. Small 3-D convolutions learn solids that lie anywhere, and see little of a column
    at a time; flat convolutions with z as channels learn what stands upright from a few voxels of
    it (Roldão, de Charette, Verroust-Blondet 2020: LMSCNet). At each level either hands the other
    what it has: c channels of h cells in height are c·h flat channels, and back.

    `height` is Z, `levels` are pairs (c_l, Z_l), and `widths` are the flat net's channels, level by
    level.
    """

    def __init__(
        self,
        inputs: int,
        height: int,
        levels: Sequence[tuple[int, int]],
        widths: Sequence[int],
    ):
        super().__init__()
        self._levels = tuple(levels)
        met = [(c * z, width) for (c, z), width in zip(self._levels, widths, strict=True)]
        convolution = partial(_convolution, flat=True)
        self.stem = convolution(inputs * height, widths[0], stride=2)
        self.down = nn.ModuleList(
            convolution(below, width, stride=2 if level else 1)
            for level, (below, width) in enumerate(zip([widths[0], *widths], widths, strict=False))
        )
        self.take = nn.ModuleList(Conv2d(*edge, 1) for edge in met)
        self.mix = nn.ModuleList(convolution(width, width) for width in widths)
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(above, width, 2, stride=2)
            for width, above in itertools.pairwise(widths)
        )
        self.refine = nn.ModuleList(
            nn.Sequential(convolution(2 * width, width), convolution(width, width))
            for width in widths[:-1]
        )
        self.give = nn.ModuleList(Conv2d(width, cells, 1) for cells, width in met)

    def forward(self, x: Tensor, skips: Sequence[Tensor]) -> list[Tensor]:
        """As the class says."""
        flat, seen = self.stem(_flat(x)), []
        for level, (down, mix) in enumerate(zip(self.down, self.mix, strict=True)):
            flat = mix(down(flat) + self.take[level](_flat(skips[level])))
            seen.append(flat)
        result = [flat]
        for level in reversed(range(len(self.up))):
            flat = self.refine[level](torch.cat((self.up[level](flat), seen[level]), dim=1))
            result.insert(0, flat)
        return [
            give(flat).unflatten(1, level).permute(0, 1, 3, 4, 2)
            for give, flat, level in zip(self.give, result, self._levels, strict=True)
        ]


def _flat(x: Tensor) -> Tensor:
    """(B, C, X, Y, Z) → (B, C·Z, X, Y)."""
    return x.permute(0, 1, 4, 2, 3).flatten(1, 2)


class _Direct:
    """A convolution that completes a map alone as fast as in a batch.

    On a CPU, torch leaves a batch of one small map to a path that takes four times as long, and
    rounds otherwise, than that of larger batches: oneDNN, which is asked for all of them here
    (docs/log).
    """

    def forward(self: Any, x: Tensor) -> Tensor:
        """As torch's own."""
        plain = x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")
        plain = plain and not torch.compiler.is_compiling()  # which chooses for itself
        if plain and torch.is_inference_mode_enabled() and torch.backends.mkldnn.is_available():
            given = self.padding, self.stride, self.dilation, self.groups
            return torch.mkldnn_convolution(x, self.weight, self.bias, *given)
        result: Tensor = super().forward(x)  # type: ignore[misc]
        return result


class Conv2d(_Direct, nn.Conv2d):
    """torch's, with numbers for its padding."""


class Conv3d(_Direct, nn.Conv3d):
    """torch's, with numbers for its padding."""


def _convolution(below: int, width: int, stride: int = 1, flat: bool = False) -> nn.Sequential:
    """A convolution three wide, over x and y alone if `flat`, normalised, with its activation."""
    conv, norm = (Conv2d, nn.BatchNorm2d) if flat else (Conv3d, nn.BatchNorm3d)
    return nn.Sequential(
        conv(below, width, 3, stride=stride, padding=1, bias=False),
        norm(width),
        nn.ReLU(inplace=True),
    )
