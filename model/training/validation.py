"""What a network is worth on the validation split, by the definitions of the bench."""

import math
from collections import Counter, defaultdict

import torch
from torch import nn

from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import LossConfig
from scenegen.model.evaluation.metrics import METRICS
from scenegen.model.evaluation.reconstruction import measure_whole
from scenegen.model.losses import loss_of
from scenegen.model.network import Output
from scenegen.model.training.data import Maps, TudfOf, load
from scenegen.model.training.device import Group, autocast


@torch.inference_mode()
def validate(
    network: nn.Module,
    maps: Maps,
    loss: LossConfig,
    batch: int,
    device: torch.device,
    precision: torch.dtype,
    group: Group,
    workers: int = 0,
) -> dict[str, float]:
    """Means over samples: the losses (of each batch for all its samples), and the bench's metrics
    at the paper's thresholds, over whole maps; a map that has no value of a metric is left out of
    it.

    And ``largest``, the largest probability anywhere: while it stays below the threshold, nothing
    is ever occupied.
    """
    network.eval()
    grid, tudf_of, loss_in = maps.grid, TudfOf(maps.grid), loss_of(loss, maps.grid)
    batches = [list(range(n, min(n + batch, len(maps)))) for n in range(0, len(maps), batch)]
    sums, counts, largest = defaultdict[str, float](float), Counter[str](), 0.0
    for read in load(maps, batches[group.rank :: group.size], workers=workers, pinned=False):
        true, there = read["occupancy"], {name: values.to(device) for name, values in read.items()}
        tudf = there["tudf"] = tudf_of(there["occupancy"])
        with autocast(device, precision):
            output = Output(*network(there))
        for name, value in loss_in(output, there).items():
            sums[name] += value.item() * len(true)
            counts[name] += len(true)
        probability = (
            None if output.logits is None else output.logits.float().sigmoid().cpu().numpy()
        )
        distance = None if output.tudf is None else output.tudf.float().cpu().numpy()
        largest = max(largest, 0.0 if probability is None else float(probability.max()))
        for n, true_distance in enumerate(tudf.cpu().numpy()):
            said = Prediction(
                *(None if part is None else part[n] for part in (probability, distance))
            )
            measured = measure_whole(said, true[n].numpy(), true_distance, grid)
            for name, value in zip(METRICS, measured.tolist(), strict=True):
                if math.isfinite(value):  # a map without such voxels says nothing of them
                    sums[name] += value
                    counts[name] += 1
    everywhere = group.gather((dict(sums), counts, largest))
    counted = sum((theirs for _, theirs, _ in everywhere), start=Counter[str]())
    means = {
        name: sum(theirs.get(name, 0.0) for theirs, _, _ in everywhere) / n
        for name, n in counted.items()
    }
    return {
        **dict.fromkeys(METRICS, math.nan),
        **means,
        "largest": max(top for _, _, top in everywhere),
    }
