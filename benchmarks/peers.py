"""Published completion networks, written again from their papers, trained on the maps of ours.

    python benchmarks/peers.py MAPS --runs /tmp/peers     # docs/results/networks.md

`LMSCNet`, `SSCNet` and our `columns` begin with random weights, and learn from the same maps of
`anywhere.toml`, in the same order, by the same loss. A run that is there goes on to so many maps.
MAPS is the folder that `real.py` takes. Beside them stands the bundled `anywhere`, which has
learned for far longer.
"""

import os
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import measuring
import scoring
import torch
from inference import measure
from real import maps_to_complete
from scoring import CAREFUL, Results, ahead, by_map, maps_of, measured, publish, tables, titled
from torch import Tensor, nn
from tyro.conf import Positional

from scenegen import Output
from scenegen.model.bench.methods import rows_of
from scenegen.model.completion.completer import open_network
from scenegen.model.network import placed

HERE = Path(__file__).parent
OURS = "columns"
PAPERS = {"LMSCNet": (32, 20, "0.35 M"), "SSCNet": (36, 12, "0.93 M")}
"""Voxels in height and classes in the paper, and how many parameters it counts."""
TRAINING = (
    "--input observed --input free --points-share 0.35 --batch 4 --precision float32 "
    "--lambda-occupancy 1 --lovasz 1 --eikonal 0 --choose last --interval 2000 --quiet"
)
TABLES = {
    "iou": "## IoU",
    "near_rmse": "## Near-RMSE, m",
    "success": "## Success of the careful planner",
}
REAL = "real places, less `extrude`"


class Options(scoring.Options):
    """Those of `scoring`, and how networks are trained."""

    real: Positional[Path | None] = None
    """folder of the maps"""
    maps: int = 40
    trials: int = 120
    runs: Path | None = None
    """folder of the runs"""
    source: str = f"--stream {HERE / 'anywhere.toml'} --val-maps 100"
    """what `train` is told to learn from: datasets, or a stream"""
    learned: int = 4000
    """maps that each learns from"""
    rounds: int = 5
    """of timing"""


def main() -> None:
    """Train what is missing, measure, and write the tables."""
    quick = "--stream pillar --val-maps 2"
    given = measuring.parse(Options, source=quick, learned=2, maps=2, trials=2, rounds=1)
    with tempfile.TemporaryDirectory() as spare:
        folder, runs = Path(spare), given.runs or Path(spare, "runs")
        names = {OURS: str(runs / OURS)}
        for one in ("SSCNet",) if given.smoke else PAPERS:
            names[one] = f"peers:{one}@{runs / one}"
        for name in names:
            train(runs / name, name, given)
        methods = rows_of(["extrude"], [*names.values(), "anywhere"])
        results = measured(maps_to_complete(given, folder), methods, given.trials, CAREFUL)
        lines = scored(results) + sizes(names, given.rounds)
    publish(given, lines)


def train(out: Path, name: str, given: Options) -> None:
    """Train a network on so many maps, where its run has not seen them."""
    variant = name if name == OURS else f"peers:{name}"
    os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    words = f"train {given.source} --variant {variant} --maps {given.learned} {TRAINING} --out"
    measuring.command(words, out)


def scored(results: Results) -> list[str]:
    """A table for each of `TABLES`: a row a place, and one of all real places together."""
    names = list(next(iter(results.values())).methods)
    lines = tables(TABLES, results, names, groups=by_map, form=".2f")
    real = [(one, maps_of(one, place)) for place, one in results.items() if place[0] != "`"]
    if real:  # success is the last table
        lines.append(f"| {REAL} | {' | '.join(ahead(real, 'extrude', 'gain').values())} |")
    return lines


def sizes(names: dict[str, str], rounds: int) -> list[str]:
    """How large the networks are, here and in their papers, and how long each takes for a map."""
    torch.set_num_threads(1)
    opened = {name: placed(open_network(one)[0], "cpu") for name, one in names.items()}
    times = measure(opened, ("observed", "free"), rounds)
    rows = []
    for name, network in opened.items():
        paper = ["–", "–"]
        if name in PAPERS:
            height, classes, said = PAPERS[name]
            as_there = SimpleNamespace(inputs=("observed",), height=height)
            paper = [counted(globals()[name](as_there, classes)), said]
        ms = times[name].wall
        rows.append(
            (
                f"`{name}`",
                [counted(network), *paper, f"{ms:.0f}", f"{ms / times[OURS].wall:.2f}"],
            )
        )
    heads = ("parameters", "at the paper's size", "in the paper", "ms a map", "ratio")
    return titled("## Size and time", heads, rows)


def counted(network: nn.Module) -> str:
    """Its parameters, millions."""
    return f"{sum(one.numel() for one in network.parameters()) / 1e6:.2f} M"


class LMSCNet(nn.Module):
    """A flat U-Net with height as channels, then a small 3-D head (Roldão, de Charette and
    Verroust-Blondet, "LMSCNet: Lightweight Multiscale 3D Semantic Completion", 3DV 2020, arXiv
    2008.10559), at full scale alone.

    With Z voxels in height, levels at scales 1, 2, 4 and 8 have Z, 1.5 Z, 2 Z and 2.5 Z channels.
    On the way up, scale s leaves through Z/s channels, which reach every finer scale. Nothing is
    normalised but in the head, as in the paper.
    """

    tasks = ("occupancy",)

    def __init__(self, config: Any, classes: int = 1):
        super().__init__()
        self.inputs, z = config.inputs, config.height
        widths = {1: z, 2: 3 * z // 2, 4: 2 * z, 8: 5 * z // 2}
        below = [len(self.inputs) * z, *widths.values()]
        self.down = nn.ModuleList(
            nn.Sequential(*flat(given, width), *flat(width, width))
            for given, width in zip(below, widths.values(), strict=False)
        )
        self.mix, self.leave, self.up = (nn.ModuleDict() for _ in range(3))
        for scale, width in widths.items():
            coarser = [one for one in widths if one > scale]
            if coarser:
                self.mix[str(scale)] = flat(width + sum(z // one for one in coarser), width)
            if scale > 1:
                self.leave[str(scale)] = nn.Conv2d(width, z // scale, 3, padding=1)
            for one in coarser:
                stride = one // scale
                kernel, padding = (6, 2) if stride == 2 else (stride, 0)
                self.up[f"{one} to {scale}"] = nn.ConvTranspose2d(
                    z // one, z // one, kernel, stride=stride, padding=padding
                )
        self.head = Segmentation(classes)
        begin(self)

    def forward(self, batch: dict[str, Tensor]) -> Output:
        """(B, X, Y, Z) by name → logits of occupancy, (B, X, Y, Z)."""
        x = torch.cat([batch[name].float() for name in self.inputs], dim=3)
        x, seen = x.permute(0, 3, 1, 2), {}  # (B, inputs * Z, X, Y)
        for scale, down in zip((1, 2, 4, 8), self.down, strict=True):
            x = down(x if scale == 1 else nn.functional.max_pool2d(x, 2))
            seen[scale] = x
        left = {8: self.leave["8"](x)}
        for scale in (4, 2, 1):
            given = (self.up[f"{one} to {scale}"](values) for one, values in left.items())
            x = self.mix[str(scale)](torch.cat((seen[scale], *given), dim=1))
            if scale > 1:
                left[scale] = self.leave[str(scale)](x)
        return Output(self.head(x.permute(0, 2, 3, 1)[:, None])[:, 0], None)  # from (B, Z, X, Y)


class Segmentation(nn.Module):
    """LMSCNet's head: one channel to eight, which three pairs of convolutions of dilation 1, 2 and
    3 see in turn; (B, 1, X, Y, Z) → (B, classes, X, Y, Z)."""

    def __init__(self, classes: int, width: int = 8):
        super().__init__()
        self.first = nn.Conv3d(1, width, 3, padding=1)
        self.pyramid = nn.ModuleList(
            nn.Sequential(
                nn.Conv3d(width, width, 3, padding=wide, dilation=wide, bias=False),
                nn.BatchNorm3d(width),
                nn.ReLU(inplace=True),
                nn.Conv3d(width, width, 3, padding=wide, dilation=wide, bias=False),
                nn.BatchNorm3d(width),
            )
            for wide in (1, 2, 3)
        )
        self.last = nn.Conv3d(width, classes, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """As the class says."""
        x = torch.relu(self.first(x))
        found = sum(branch(x) for branch in self.pyramid)
        return self.last(torch.relu(x + found))


class SSCNet(nn.Module):
    """3-D convolutions, two of its five residual pairs dilated, at a quarter of the resolution
    (Song et al., "Semantic Scene Completion from a Single Depth Image", CVPR 2017, arXiv
    1611.08974, section 3.2 and figure 3).

    The paper predicts at that resolution. Here a transposed convolution, 4 wide with stride 4,
    gives every voxel of a cell its own logit; `classes` asks for the paper's own last layer.
    """

    tasks = ("occupancy",)

    def __init__(self, config: Any, classes: int | None = None):
        super().__init__()
        self.inputs = config.inputs
        self.stem = nn.Sequential(
            nn.Conv3d(len(self.inputs), 16, 7, stride=2, padding=3),
            nn.ReLU(inplace=True),
            Residual(16, 32),
            nn.MaxPool3d(2),
            Residual(32, 64),
        )
        self.context = nn.ModuleList(Residual(64, 64, wide) for wide in (1, 2, 2))
        self.mix = nn.Sequential(
            *(nn.Conv3d(3 * 64, 128, 1), nn.ReLU(inplace=True)),
            *(nn.Conv3d(128, 128, 1), nn.ReLU(inplace=True)),
        )
        self.last: nn.Module = nn.ConvTranspose3d(128, 1, 4, stride=4)
        if classes:
            self.last = nn.Conv3d(128, classes, 1)
        begin(self)

    def forward(self, batch: dict[str, Tensor]) -> Output:
        """(B, X, Y, Z) by name → logits of occupancy, (B, X, Y, Z)."""
        x = self.stem(torch.stack([batch[name].float() for name in self.inputs], dim=1))
        scales = []
        for context in self.context:
            x = context(x)
            scales.append(x)
        return Output(self.last(self.mix(torch.cat(scales, dim=1)))[:, 0], None)


class Residual(nn.Module):
    """Two convolutions three wide, beside a way past them."""

    def __init__(self, below: int, width: int, wide: int = 1):
        super().__init__()
        self.past = nn.Identity() if below == width else nn.Conv3d(below, width, 1)
        self.pair = nn.Sequential(
            nn.Conv3d(below, width, 3, padding=wide, dilation=wide),
            nn.ReLU(inplace=True),
            nn.Conv3d(width, width, 3, padding=wide, dilation=wide),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, below, x, y, z) → (B, width, x, y, z)."""
        return torch.relu(self.past(x) + self.pair(x))


def flat(below: int, width: int) -> nn.Sequential:
    """A convolution over x and y, three wide, with its activation."""
    return nn.Sequential(nn.Conv2d(below, width, 3, padding=1), nn.ReLU(inplace=True))


def begin(network: nn.Module) -> None:
    """Weights from He et al. 2015: without norms, torch's own let signals fade."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.Conv3d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            if module.bias is not None:
                nn.init.zeros_(module.bias)


if __name__ == "__main__":
    main()
