"""The completion network: the paper's dual-decoder U-Net with CrossFusion, and its variants.

For a map of 80 x 80 x 40 voxels and width 8 (channels x cells):

    X 1x80x80x40 ─ preprocess ─ encoder[0] ──── encoder[1] ──── encoder[2] ─ SelfAttention ─ F_s
                                8x40x40x20      16x20x20x10     32x10x10x5
                                S1 │            S2 │            S3 │
    D 1x80x80x40 ─ FinalUp h_t ─ f_t1 ─ C1 ─── f_t2 ─ C2 ───── f_t3 ─ C3 ───── F_s
    O 1x80x80x40 ─ FinalUp h_o ─ f_o1 ─ C1 ─── f_o2 ─ C2 ───── f_o3 ─ C3 ───── F_s

Equations are numbered as in docs/network.md, which compares them with this file. A user's own
network is a class like `Network`: docs/own-network.md.
"""

import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 (its usual name)
from torch import Tensor, nn

from lidarsim import GridSpec
from scenegen.base.errors import ScenegenError, own_code
from scenegen.base.executors import processor
from scenegen.model.config import (
    LEVELS,
    NETWORKS,
    SHARED,
    TASKS,
    VARIANTS,
    NetworkConfig,
    import_named,
    target_name,
)
from scenegen.model.targets import Target, targets_of

Batch = dict[str, Tensor]
"""A named batch, (B, *grid.shape) each: a network's inputs. In training, it also has the truth of
the targets, always with ``occupancy`` and ``tudf``. If maps of real places are in it, ``known``
marks voxels of known occupancy, and ``certain`` those whose true distance is certain: no unknown
voxel is nearer than the nearest voxel that is known to be occupied."""


class Output(NamedTuple):
    """Output of a network for a batch of maps."""

    logits: Tensor | None
    """(B, X, Y, Z): logits of occupancy; None if the network does not predict it."""
    tudf: Tensor | None
    """(B, X, Y, Z): distances, metres, not negative, not truncated; None if not predicted."""
    others: Mapping[str, Tensor] = {}
    """(B, X, Y, Z) or (B, channels, X, Y, Z): further targets, by `target_name`."""

    @classmethod
    def of(cls, heads: Mapping[str, Tensor], targets: Mapping[str, Target]) -> "Output":
        """Apply the targets' activations to the values of the heads.

        Args:
            heads: Values by `target_name`, (B, X, Y, Z) or (B, channels, X, Y, Z).
            targets: Targets by the same names.

        Returns:
            The output.
        """
        outputs = {name: targets[name].output(values) for name, values in heads.items()}
        return cls(outputs.pop("occupancy", None), outputs.pop("tudf", None), outputs)

    @property
    def by_target(self) -> dict[str, Tensor]:
        """The predicted tensors by `target_name`, occupancy first."""
        outputs = {"occupancy": self.logits, "tudf": self.tudf, **self.others}
        return {name: values for name, values in outputs.items() if values is not None}

    def predictions(self, targets: Mapping[str, Target], grid: GridSpec) -> dict[str, Tensor]:
        """Convert to the arrays of a `Prediction`, such as probabilities instead of logits.

        Args:
            targets: Targets by `target_name`.
            grid: Grid of the maps, whose truncation applies to distances.

        Returns:
            Tensors by the name of the prediction's array, (B, X, Y, Z) or (B, channels, X, Y, Z).
        """
        return {
            targets[name].part or name: targets[name].prediction(values.float(), grid)
            for name, values in self.by_target.items()
        }


def build_network(config: NetworkConfig) -> nn.Module:
    """Make a network with random weights.

    Args:
        config: Its settings.

    Returns:
        The network. It has `config`; `tasks`, the names of its targets; and `targets`, the targets
        by `target_name`.

    Raises:
        ScenegenError: if `config` names no network, or the user's code fails.
    """
    who = f"variant {config.variant}"
    with own_code(f"{who}: cannot be made of a NetworkConfig"):
        network = import_named(NETWORKS, config.variant)(config)
    if not isinstance(network, nn.Module):
        raise ScenegenError(f"{who}: makes {type(network).__name__}, expected a torch.nn.Module")
    network.register_forward_pre_hook(_without_truth)
    if not isinstance(tasks := getattr(network, "tasks", TASKS), list | tuple):
        raise ScenegenError(f"{who}: tasks = {tasks!r:.60}: expected a tuple, such as {TASKS}")
    # attributes are set here, so that a user's own class need not do it
    network.tasks = tuple(dict.fromkeys((*tasks, *config.targets)))
    network.config, network.targets = config, targets_of(network.tasks)
    return network


def _without_truth(network: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Remove the truth from the batch, so that no network can see it in a forward pass."""
    if not arguments:
        return arguments
    batch, *further = arguments
    return ({name: batch[name] for name in network.config.inputs}, *further)


def placed(network: nn.Module, device: torch.device | str) -> nn.Module:
    """Move a network to a device, with the filters of convolutions in channels-last memory.

    Args:
        network: The network, changed in place.
        device: The device.

    Returns:
        `network`.
    """
    network.to(device)
    # convolutions are faster in this layout; 4 axes are 2-D filters, 5 are 3-D ones
    for parameter in network.parameters():
        if layout := {4: torch.channels_last, 5: torch.channels_last_3d}.get(parameter.ndim):
            parameter.data = parameter.data.contiguous(memory_format=layout)
    return network


def prefers_bfloat16() -> bool:
    """Whether this processor is faster in bfloat16 than in float32: with AMX, or AMD with AVX-512.

    On an Intel Xeon with AVX-512 but without AMX, bfloat16 takes 1.4 times as long (docs/log).
    """
    has: Any = getattr(torch.cpu, "get_capabilities", dict)()  # not in torch 2.10
    return bool(has.get("amx_bf16" if "Intel" in processor() else "avx512_bf16"))


def _module_name(target: str) -> str:
    """Name of a target's modules, which torch allows no dot."""
    return target_name(target).replace(".", "_")


class Network(nn.Module):
    """The paper's network and its variants: a named batch, (B, X, Y, Z) for each input, to an
    `Output` (the paper, section "Coupled TUDF-Occupancy Learning")."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        variant = VARIANTS[config.variant]
        self.tasks = (*variant.tasks, *config.targets)
        self.targets = targets_of(self.tasks)
        branches = variant.decoders
        # with separate decoders, further targets have their own, too; these are never coupled
        if branches != SHARED:
            branches = (*branches, *map(_module_name, config.targets))
        inputs, widths = len(config.inputs), [config.width * 2**level for level in range(LEVELS)]
        features = finest = widths[0]
        self.preprocess = nn.Sequential(
            *_convolution(inputs, finest, stride=2), *_convolution(finest, finest)
        )
        self.encoder = nn.ModuleList(
            nn.Sequential(*_convolution(below, width, stride), *_convolution(width, width))
            for below, width, stride in zip([finest, *widths], widths, (1, 2, 2), strict=False)
        )
        # global context is computed at the coarsest level only, where it is cheap: 500 cells
        self.attention = SelfAttention(widths[-1], config.heads)
        self.decoder = nn.ModuleDict({branch: Decoder(widths) for branch in branches})
        self.fusion = nn.ModuleList(map(CrossFusion, widths)) if variant.coupled else None
        self.columns = None
        if variant.columns:
            levels = [(c, config.height // 2 ** (level + 1)) for level, c in enumerate(widths)]
            self.columns = Columns(inputs, config.height, levels, variant.columns)
            features = 2 * finest  # `features` concatenates both nets at the finest level
        self.head = nn.ModuleDict(
            {
                _module_name(name): FinalUp(features, finest, config.channels_of(name))
                for name in map(target_name, self.tasks)
            }
        )

    def forward(self, batch: Batch) -> Output:
        """Apply the heads to the features (eq. 6)."""
        features = self.features(batch)
        heads = {
            name: head(features.get(module, features.get("shared")))
            for name, (module, head) in zip(
                map(target_name, self.tasks), self.head.items(), strict=True
            )
        }
        return Output.of(heads, self.targets)

    def features(self, batch: Batch) -> dict[str, Tensor]:
        """Compute the input of the heads.

        Args:
            batch: The inputs, (B, X, Y, Z) each.

        Returns:
            (B, channels, X/2, Y/2, Z/2) by decoder; under ``shared`` if there is only one.
        """
        voxels = torch.stack([batch[name].float() for name in self.config.inputs], dim=1)
        x, skips = self.preprocess(voxels), []
        for encode in self.encoder:
            x = encode(x)
            skips.append(x)
        columns = None if self.columns is None else self.columns(voxels, skips)
        features = dict.fromkeys(self.decoder, self.attention(x))  # every decoder begins with F_s
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
                # concatenated at the end, where the heads mix both; else added, which keeps widths
                features = {
                    branch: torch.cat((x, flat), dim=1) if level == 0 else x + flat
                    for branch, x in features.items()
                }
        return features


class SelfAttention(nn.Module):
    """Residual self-attention over all cells: (B, C, x, y, z) → the same shape.

    It has no position encoding, since padded convolutions before it know the border.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.to_qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        cells = x.flatten(2).transpose(1, 2)  # (B, cells, C)
        qkv = self.to_qkv(self.norm(cells)).unflatten(-1, (3, self.heads, -1))
        q, k, v = qkv.permute(2, 0, 3, 1, 4)  # (B, heads, cells, C / heads) each
        result = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        return x + self.out(result).transpose(1, 2).unflatten(2, x.shape[2:])


class Decoder(nn.Module):
    """The stages of one decoder, f^(1), f^(2), f^(3), finest first."""

    def __init__(self, widths: Sequence[int]):
        super().__init__()
        self.stages = nn.ModuleList(map(Decode, widths, [*widths[1:], None]))


class Decode(nn.Module):
    """A decoder stage f^(l), eq. 3 and 4: doubles the resolution and joins a skip connection.

    Features (B, above, x, y, z) and skip (B, width, 2x, 2y, 2z) → (B, width, 2x, 2y, 2z). `above`
    is None for the coarsest stage, which keeps the resolution: both its inputs have `width`
    channels.
    """

    def __init__(self, width: int, above: int | None):
        super().__init__()
        self.up = nn.Identity() if above is None else nn.ConvTranspose3d(above, width, 2, stride=2)
        self.refine = nn.Sequential(*_convolution(2 * width, width), *_convolution(width, width))

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """See the class.

        Args:
            x: Features of the coarser stage.
            skip: Output of the encoder at this level.

        Returns:
            Features at this level.
        """
        return self.refine(torch.cat((self.up(x), skip), dim=1))


class CrossFusion(nn.Module):
    """Exchange between the two decoders (eq. 5): each adds a function of both to its features."""

    def __init__(self, width: int):
        super().__init__()
        self.to_tudf, self.to_occupancy = (
            nn.Sequential(
                Conv3d(2 * width, width, 1), nn.ReLU(inplace=True), Conv3d(width, width, 1)
            )
            for _ in TASKS
        )

    def forward(self, t: Tensor, o: Tensor) -> tuple[Tensor, Tensor]:
        """Fuse the features of one level.

        Args:
            t: Features of distance, (B, width, x, y, z).
            o: Features of occupancy, of the same shape.

        Returns:
            Both, refined.
        """
        t = t + self.to_tudf(torch.cat((t, o), dim=1))
        # with the refined t, as eq. 5 is written
        o = o + self.to_occupancy(torch.cat((o, t), dim=1))
        return t, o


class FinalUp(nn.Module):
    """A head: (B, below, X/2, Y/2, Z/2) → (B, X, Y, Z), or (B, channels, X, Y, Z) for several.

    Each cell gives eight values per channel, one for each voxel in it.
    """

    def __init__(self, below: int, width: int, channels: int = 1):
        super().__init__()
        # No plain ReLU: its channels can die. The bias alone then bounds the logit from above, and
        # no probability passes the threshold.
        self.refine = nn.Sequential(
            *_convolution(below, width)[:-1], nn.LeakyReLU(0.1, inplace=True)
        )
        self.split = Conv3d(width, 8 * channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        x = self.refine(x)
        # bfloat16 resolves distances near 2 m to 8 mm, too coarse for slopes between voxels
        with torch.autocast(x.device.type, enabled=False):
            cells = self.split(x.float()).unflatten(1, (-1, 2, 2, 2))
        # (B, c, i, j, k, x, y, z) → (B, c, x, i, y, j, z, k) → (B, c, X, Y, Z)
        voxels = cells.permute(0, 1, 5, 2, 6, 3, 7, 4).flatten(6, 7).flatten(4, 5).flatten(2, 3)
        return voxels.squeeze(1)


class Columns(nn.Module):
    """A flat U-Net beside the 3-D one: 2-D convolutions, with the layers of the map as channels.

    A 3-D convolution sees a small part of a column. A flat one sees the whole column, so it can
    infer an upright solid from a few of its voxels (Roldão, de Charette, Verroust-Blondet 2020:
    LMSCNet). The nets exchange features at each level: c channels in h layers become c·h flat
    channels, and back.

    Args:
        inputs: Input channels.
        height: Z, voxels.
        levels: Channels c_l and layers Z_l of the 3-D net, finest level first.
        widths: Channels of the flat net, finest level first.
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
        # flat channels of the 3-D net, and channels of this one, where the two meet
        meetings = [(c * z, width) for (c, z), width in zip(self._levels, widths, strict=True)]
        convolution = partial(_convolution, flat=True)
        self.stem = convolution(inputs * height, widths[0], stride=2)
        self.down = nn.ModuleList(
            convolution(below, width, stride=2 if level else 1)
            for level, (below, width) in enumerate(zip([widths[0], *widths], widths, strict=False))
        )
        self.take = nn.ModuleList(Conv2d(*edge, 1) for edge in meetings)
        self.mix = nn.ModuleList(convolution(width, width) for width in widths)
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(above, width, 2, stride=2)
            for width, above in itertools.pairwise(widths)
        )
        self.refine = nn.ModuleList(
            nn.Sequential(convolution(2 * width, width), convolution(width, width))
            for width in widths[:-1]
        )
        self.give = nn.ModuleList(Conv2d(width, cells, 1) for cells, width in meetings)

    def forward(self, x: Tensor, skips: Sequence[Tensor]) -> list[Tensor]:
        """Compute features for the 3-D net's decoder.

        Args:
            x: Input voxels, (B, inputs, X, Y, Z).
            skips: Outputs of the 3-D encoder, (B, c_l, X_l, Y_l, Z_l), finest first.

        Returns:
            Features of the shapes of `skips`, finest first.
        """
        flat, flat_skips = self.stem(_flat(x)), []
        for level, (down, mix) in enumerate(zip(self.down, self.mix, strict=True)):
            flat = mix(down(flat) + self.take[level](_flat(skips[level])))
            flat_skips.append(flat)
        result = [flat]
        for level in reversed(range(len(self.up))):
            flat = self.refine[level](torch.cat((self.up[level](flat), flat_skips[level]), dim=1))
            result.insert(0, flat)
        return [
            give(flat).unflatten(1, level).permute(0, 1, 3, 4, 2)
            for give, flat, level in zip(self.give, result, self._levels, strict=True)
        ]


def _flat(x: Tensor) -> Tensor:
    """(B, C, X, Y, Z) → (B, C·Z, X, Y)."""
    return x.permute(0, 1, 4, 2, 3).flatten(1, 2)


class _Direct:
    """A convolution that always uses oneDNN for inference on a CPU.

    Without it, torch computes a batch of one small map by another path, which takes four times as
    long as oneDNN and rounds differently. A map alone would then have other bits than in a batch
    (docs/log).
    """

    def forward(self: Any, x: Tensor) -> Tensor:
        """See `torch.nn.Conv3d`."""
        # autocast and the compiler choose their own kernels
        plain = x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")
        plain = plain and not torch.compiler.is_compiling()
        # training leaves the choice to torch: its batches are larger
        if plain and torch.is_inference_mode_enabled() and torch.backends.mkldnn.is_available():
            geometry = self.padding, self.stride, self.dilation, self.groups
            return torch.mkldnn_convolution(x, self.weight, self.bias, *geometry)
        result: Tensor = super().forward(x)  # type: ignore[misc]
        return result


class Conv2d(_Direct, nn.Conv2d):
    """See `_Direct`. Padding must be numbers, not a name such as "same"."""


class Conv3d(_Direct, nn.Conv3d):
    """See `_Direct`. Padding must be numbers, not a name such as "same"."""


def _convolution(below: int, width: int, stride: int = 1, flat: bool = False) -> nn.Sequential:
    """Return a 3×3×3 convolution (3×3 if `flat`) with batch norm and ReLU."""
    conv, norm = (Conv2d, nn.BatchNorm2d) if flat else (Conv3d, nn.BatchNorm3d)
    # the batch norm has a bias, so the convolution needs none
    return nn.Sequential(
        conv(below, width, 3, stride=stride, padding=1, bias=False),
        norm(width),
        nn.ReLU(inplace=True),
    )
