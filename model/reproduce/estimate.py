"""What a study will take, before it begins."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from lidarsim import GridSpec
from scenegen.model.config import NetworkConfig, TrainConfig
from scenegen.model.network import build, placed
from scenegen.model.reproduce.config import ReproduceConfig
from scenegen.model.reproduce.runs import Run
from scenegen.model.training.device import Group, choose_device, device_name, resolve_precision
from scenegen.model.training.loop import Step, optimizer_of

SAMPLE_S, SAMPLE_BYTES = 0.006, 15e3
"""A sample of a compact dataset, one core: docs/log.md."""
ROW_S, STUDIED_S, UNLEARNED_S = 0.08, 0.15, 0.03
"""A row of the bench, one with its study, and all of those that need no network, by map and core,
planning included: docs/log.md."""
RUN_BYTES = 10e6
"""What a run's folder takes."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Hours and bytes of a study, on this machine."""

    device: str
    map_s: float
    """A training step's time by map, measured just now."""
    train_s: float
    generate_s: float
    bench_s: float
    bytes: float

    def words(self) -> dict[str, str]:
        """For people."""
        total = self.generate_s + self.train_s + self.bench_s
        return {
            "time": f"about {_time(total)}: datasets {_time(self.generate_s)}, networks "
            f"{_time(self.train_s)}, bench "
            f"{_time(self.bench_s)}",
            "disk": f"about {self.bytes / 1e6:.0f} MB",
            "on": f"{self.device}, {1e3 * self.map_s:.1f} ms a map of training",
        }


def estimate(
    config: ReproduceConfig, runs: Sequence[Run], *, device: str, workers: int
) -> Estimate:
    """Time two training steps of the paper's network, and add up the rest from measured
    constants."""
    where = choose_device(device)
    maps = sum(run.config(config.scaled(config.maps)).maps or 0 for run in runs)
    worlds = {"", *(run.worlds for run in runs)}
    samples, tested = len(worlds) * 2 * sum(config.counts.values()), 2 * config.counts["test"]
    each = _map_seconds(where)
    return Estimate(
        device=device_name(where),
        map_s=each,
        train_s=maps * each / (1 if where.type == "cuda" else workers),
        generate_s=samples * SAMPLE_S / workers,
        bench_s=tested * (sum(map(_row_seconds, runs)) + len(worlds) * UNLEARNED_S) / workers,
        bytes=samples * SAMPLE_BYTES + len(runs) * RUN_BYTES,
    )


def _row_seconds(run: Run) -> float:
    return STUDIED_S if run.share == 1 else ROW_S


def _map_seconds(device: torch.device) -> float:
    config = TrainConfig(network=NetworkConfig())
    network, threads = placed(build(config.network), device), torch.get_num_threads()
    precision = resolve_precision(config.precision, device)
    learn = Step(
        network, optimizer_of(network, config), config, GridSpec(), device, precision, Group(device)
    )
    batch = {
        name: torch.rand(config.batch, *GridSpec().shape) > 0.97
        for name in ("observed", "occupancy")
    }
    try:
        torch.set_num_threads(1)
        learn(batch, 0.0)
        begin = time.perf_counter()
        learn(batch, 0.0)
        return (time.perf_counter() - begin) / config.batch
    finally:
        torch.set_num_threads(threads)


def _time(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds > 3600 else f"{max(seconds / 60, 1):.0f} min"
