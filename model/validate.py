"""What a network is worth on the validation split, by the definitions of the bench."""

from collections import Counter

import numpy as np
import torch

from model.bench.reconstruction import METRICS, ReconstructionConfig, measure
from model.complete import Prediction, Thresholds
from model.data import Maps, TudfOf, load
from model.device import Group, autocast
from model.losses import LossConfig, objective
from model.network import Network


@torch.inference_mode()
def validate(
    network: Network,
    maps: Maps,
    loss: LossConfig,
    batch: int,
    device: torch.device,
    precision: torch.dtype,
    group: Group,
    workers: int = 0,
) -> dict[str, float]:
    """Means over samples: the losses, and the bench's metrics at the paper's thresholds, over whole maps.

    And ``largest``, the largest probability anywhere: while it stays below the threshold, nothing is ever occupied.
    """
    network.eval()
    grid, tudf_of, thresholds = maps.grid, TudfOf(maps.grid), Thresholds()
    batches = [list(range(n, min(n + batch, len(maps)))) for n in range(0, len(maps), batch)]
    sums: Counter[str] = Counter()
    largest = 0.0
    for seen, true in load(maps, batches[group.rank :: group.size], workers=workers, pinned=False):
        observed, occupancy = seen.to(device), true.to(device)
        tudf = tudf_of(occupancy)
        with autocast(device, precision):
            output = network(observed.float())
        losses = objective(output, occupancy, tudf, loss, voxel_m=grid.voxel_m, truncation_m=grid.truncation_m)
        sums.update({name: value.item() * len(seen) for name, value in losses.items()})
        probability = None if output.logits is None else output.logits.float().sigmoid().cpu().numpy()
        distance = None if output.tudf is None else output.tudf.float().cpu().numpy()
        largest = max(largest, 0.0 if probability is None else float(probability.max()))
        for n, true_distance in enumerate(tudf.cpu().numpy()):
            said = Prediction(
                occupancy_probability=None if probability is None else probability[n],
                tudf=None if distance is None else distance[n],
            )
            measured = measure(
                said.occupied(thresholds),
                said.distance(thresholds, grid),
                true[n].numpy(),
                true_distance,
                classes=np.zeros(grid.shape, np.uint8),
                class_count=1,
                config=ReconstructionConfig(),
            )[0]
            sums.update(dict(zip(METRICS, np.nan_to_num(measured).tolist(), strict=True)))
    everywhere = group.gather((sums, largest))
    total: Counter[str] = Counter()
    for found, _ in everywhere:
        total.update(found)  # adding with + would drop what is below zero
    return {name: value / len(maps) for name, value in total.items()} | {"largest": max(top for _, top in everywhere)}
