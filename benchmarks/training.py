"""Training: what the loader gives a second, and milliseconds a map of a step, by variant, stem and
precision; or how long steps wait for a stream.

    python benchmarks/training.py data/pillar data/geometric
    python benchmarks/training.py --stream pillar --steps 13
"""

import itertools
import time
from pathlib import Path

import measuring
import torch

import scenegen
from scenegen.model.config import VARIANTS, NetworkConfig, TrainConfig
from scenegen.model.network import Batch, build, placed
from scenegen.model.training.course import Course
from scenegen.model.training.data import Maps, load, opened
from scenegen.model.training.device import Group, choose_device
from scenegen.model.training.loop import Step, optimizer_of


def main() -> None:
    """Print the loader's rate and one table of steps, or a line for each number of loaders."""
    parser = measuring.options(__doc__)
    parser.add_argument("datasets", nargs="*", type=Path)
    parser.add_argument("--stream", help="in place of datasets, a kind")
    parser.add_argument("--steps", type=int, default=60, help="batches that are read")
    parser.add_argument("--variant", nargs="*", choices=VARIANTS, default=VARIANTS)
    parser.add_argument("--stem-stride", nargs="*", type=int, choices=(2, 1), default=(2, 1))
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--device", default="auto")
    options = measuring.parse(parser, variant=["occ"], stem_stride=[2], batch=1, rounds=1)
    device = choose_device(options.device)
    sources = [scenegen.stream(options.stream)] if options.stream else None
    maps = Maps(sources or opened(options.datasets, "train"), "train")
    if options.stream:
        for workers in (0, 1, 2):
            learn = learner(maps, NetworkConfig(), options.batch, device, torch.float32)
            waits(learn, maps, workers, options.steps)
        return
    config = TrainConfig(batch=options.batch)
    batches = list(Course(maps, config).batches(0, options.steps))
    loader(maps, batches)
    batch = next(load(maps, batches, workers=0, pinned=False))
    print(
        f"steps on {device}, {torch.get_num_threads()} threads, batch {options.batch}; median of "
        f"{options.rounds}"
    )
    for stride, variant in itertools.product(options.stem_stride, options.variant):
        network, cells = NetworkConfig(variant=variant, stem_stride=stride), []
        for precision in (torch.float32, torch.bfloat16):
            learn = learner(maps, network, options.batch, device, precision)
            said = step(learn, batch, options.rounds)
            cells.append(f"{str(precision).removeprefix('torch.')} {said}")
        print(f"{variant:<9} stem {stride}:  {';   '.join(cells)}", flush=True)


def learner(
    maps: Maps, network: NetworkConfig, batch: int, device: torch.device, precision: torch.dtype
) -> Step:
    """What makes the steps of a new network."""
    config = TrainConfig(network=network, batch=batch)
    made = placed(build(network), device)
    return Step(made, optimizer_of(made, config), config, maps.grid, Group(device, precision))


def waits(learn: Step, maps: Maps, workers: int, steps: int) -> None:
    """Print milliseconds a map that training waits for its loader, and that its steps take: means
    over all steps but the first, in which processes begin."""
    config = TrainConfig(maps=10**6, batch=learn.config.batch)
    found, at = [], time.perf_counter()
    for batch in load(maps, Course(maps, config).batches(0, steps), workers=workers, pinned=False):
        waited, at = time.perf_counter() - at, time.perf_counter()
        learn(batch, 1e-3)
        found.append((waited, time.perf_counter() - at))
        at = time.perf_counter()
    totals = (sum(column) for column in zip(*found[1:], strict=True))
    waited, stepped = (1e3 * total / (len(found) - 1) / config.batch for total in totals)
    print(
        f"{workers} loaders: waits {waited:.1f} ms a map, steps {stepped:.1f} ms a map", flush=True
    )


def loader(maps: Maps, batches: list[list[tuple[int, int]]]) -> None:
    """Print samples a second in one process."""
    begin, cpu = time.perf_counter(), time.process_time()
    for _ in load(maps, batches, workers=0, pinned=False):
        pass
    count = sum(map(len, batches))
    wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
    print(
        f"loader, one process: {count / wall:.0f} samples/s, {count / cpu:.0f} per second of CPU "
        f"time"
    )


def step(learn: Step, batch: Batch, rounds: int) -> str:
    """What a whole step takes, a map: to the device, forward, losses, backward, update."""
    times = [measuring.timed(lambda: learn(batch, 1e-3)) for _ in range(rounds + 2)]
    wall, processor = (ms / len(batch["occupancy"]) for ms in measuring.median(times[2:]))
    return f"{wall:6.1f} ms a map, {processor:.1f} of processor"


if __name__ == "__main__":
    main()
