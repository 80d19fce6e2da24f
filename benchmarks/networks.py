"""What the networks' variants cost: parameters, multiply-accumulates, memory of a training step.

python benchmarks/networks.py       # a table of docs/results/columns.csv
"""

from pathlib import Path
from typing import Any

import measuring
import torch
from scoring import RESULTS, publish, titled
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from lidarsim import GridSpec
from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import build_network

TITLE = "## Cost of a variant for one map of 80 × 80 × 40 (benchmarks/networks.py)"


class Options(measuring.Options):
    """What is measured leaves nothing to choose."""

    figures: Path = RESULTS / "columns.csv"
    """where the table is written"""


def cost(config: NetworkConfig, shape: tuple[int, int, int]) -> dict[str, Any]:
    """What a network costs for one map of `shape`, counted by running it once.

    `macs` are multiply-accumulates of a forward pass: convolutions, linear layers, attention;
    `activation_bytes` is what a training step keeps for its backward pass, float32.
    """
    network: Any = build_network(config).train()
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept.setdefault(storage.data_ptr(), storage.nbytes())
        return tensor

    for parameter in network.parameters():  # weights are kept anyway
        kept[parameter.untyped_storage().data_ptr()] = 0
    counter = FlopCounterMode(display=False)
    maps = {name: torch.zeros(1, *shape) for name in config.inputs}
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), counter:  # fused attention is not counted
        network(maps)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        network(maps)
    return {
        "variant": config.variant,
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "macs": counter.get_total_flops() // 2,
        "activation_bytes": sum(kept.values()),
    }


def main() -> None:
    """Write a row for every variant, for maps of the usual grid."""
    options = measuring.parse(Options)
    rows = []
    for variant in VARIANTS:
        row = cost(NetworkConfig(variant=variant), GridSpec().shape)
        gmacs, megabytes = row["macs"] / 1e9, row["activation_bytes"] / 1e6
        rows.append(
            (f"`{variant}`", (f"{row['parameters']:,}", f"{gmacs:.2f}", f"{megabytes:.0f} MB"))
        )
    publish(options, titled(TITLE, ("parameters", "GMACs", "activations"), rows))


if __name__ == "__main__":
    main()
