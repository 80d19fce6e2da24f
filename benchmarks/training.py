"""Training: what the loader gives a second, and milliseconds a map of a step, by variant and
precision; or how long steps wait for a stream.

    python benchmarks/training.py data/pillar data/geometric
    python benchmarks/training.py --stream pillar --steps 13
"""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import measuring
import torch
from tyro.conf import Positional

import scenegen
from scenegen.model.config import VARIANTS, NetworkConfig, TrainConfig
from scenegen.model.network import build_network, placed
from scenegen.model.training.data import Maps, load_batches, opened
from scenegen.model.training.device import Group, choose_device
from scenegen.model.training.loop import Step, optimizer_of
from scenegen.model.training.schedule import Schedule


class Options(measuring.Options):
    """What is trained, and on what."""

    datasets: Positional[Sequence[Path]] = ()
    stream: str | None = None
    """in place of datasets, a kind"""
    steps: int = 60
    """batches that are read"""
    variant: Sequence[str] = tuple(VARIANTS)
    batch: int = 8
    rounds: int = 5
    device: str = "auto"


def main() -> None:
    """Print the loader's rate and one table of steps, or a line for each number of loaders."""
    given = measuring.parse(Options, variant=["occ"], batch=1, rounds=1)
    if given.stream:
        maps = Maps([scenegen.stream(given.stream)], "train")
        for workers in (0, 1, 2):
            waits(learner(given, maps, "proposed", torch.float32), maps, workers, given.steps)
        return
    maps = Maps(opened(given.datasets, "train"), "train")
    batches = list(Schedule(maps, TrainConfig(batch=given.batch)).batches(0, given.steps))
    read = measuring.timed(
        lambda: sum(1 for _ in load_batches(maps, batches, workers=0, pinned=False))
    )
    count = 1e3 * sum(map(len, batches))
    print(
        f"loader, one process: {count / read.wall:.0f} samples/s, {count / read.processor:.0f} per "
        f"second of CPU time"
    )
    batch = next(load_batches(maps, batches, workers=0, pinned=False))
    print(
        f"steps on {choose_device(given.device)}, {torch.get_num_threads()} threads, batch "
        f"{given.batch}; median of {given.rounds}"
    )
    for variant in given.variant:
        steps = {
            str(precision).removeprefix("torch."): partial(
                learner(given, maps, variant, precision), batch, 1e-3
            )
            for precision in (torch.float32, torch.bfloat16)
        }
        cells = []
        for name, took in measuring.in_turn(steps, given.rounds).items():
            wall, processor = (ms / len(batch["occupancy"]) for ms in took)
            cells.append(f"{name} {wall:6.1f} ms a map, {processor:.1f} of processor")
        print(f"{variant:<9} {';   '.join(cells)}", flush=True)


def learner(given: Options, maps: Maps, variant: str, precision: torch.dtype) -> Step:
    """What makes the steps of a new network, whole ones: to the device, forward, losses, backward,
    update."""
    config = TrainConfig(network=NetworkConfig(variant=variant), batch=given.batch)
    device = choose_device(given.device)
    made = placed(build_network(config.network), device)
    return Step(made, optimizer_of(made, config), config, maps.grid, Group(device, precision))


def waits(learn: Step, maps: Maps, workers: int, steps: int) -> None:
    """Print milliseconds a map that training waits for its loader, and that its steps take: means
    over all steps but the first, in which processes begin."""
    config = TrainConfig(maps=10**6, batch=learn.config.batch)
    found, at = [], time.perf_counter()
    for batch in load_batches(
        maps, Schedule(maps, config).batches(0, steps), workers=workers, pinned=False
    ):
        ready = time.perf_counter()
        learn(batch, 1e-3)
        found.append((ready - at, time.perf_counter() - ready))
        at = time.perf_counter()
    totals = map(sum, zip(*found[1:], strict=True))
    waited, stepped = (1e3 * total / (len(found) - 1) / config.batch for total in totals)
    print(
        f"{workers} loaders: waits {waited:.1f} ms a map, steps {stepped:.1f} ms a map", flush=True
    )


if __name__ == "__main__":
    main()
