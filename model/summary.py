"""What a network costs: parameters, multiply-accumulates, and the memory that training keeps per
map."""

from typing import Any

import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import Network


def cost(config: NetworkConfig, shape: tuple[int, int, int]) -> dict[str, Any]:
    """What a network costs for one map of `shape`, counted by running it once.

    `macs` are multiply-accumulates of a forward pass: convolutions, linear layers, attention;
    `activation_bytes` is what a training step keeps for its backward pass, float32.
    """
    network = Network(config).train()
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
        "stem_stride": config.stem_stride,
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "macs": counter.get_total_flops() // 2,
        "activation_bytes": sum(kept.values()),
    }


def costs(shape: tuple[int, int, int] = (80, 80, 40)) -> list[dict[str, Any]]:
    """The costs of all variants with both stems."""
    return [
        cost(NetworkConfig(variant=variant, stem_stride=stride), shape)
        for stride in (2, 1)
        for variant in VARIANTS
    ]
