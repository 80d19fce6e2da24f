"""Training: what the loader gives a second, and milliseconds a map of a step, by variant, stem and
precision.

python benchmarks/training.py data/pillar data/geometric
"""

import itertools
import time
from pathlib import Path

import measuring
import torch

from scenegen.model.config import VARIANTS, NetworkConfig, TrainConfig
from scenegen.model.network import Batch, build, placed
from scenegen.model.training.data import Maps, epoch_batches, load, opened
from scenegen.model.training.device import Group, choose_device
from scenegen.model.training.loop import Step


def main() -> None:
    """Print the loader's rate and one table of steps."""
    parser = measuring.options(__doc__)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--variant", nargs="*", choices=VARIANTS, default=VARIANTS)
    parser.add_argument("--stem-stride", nargs="*", type=int, choices=(2, 1), default=(2, 1))
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = measuring.parse(parser, variant=["occ"], stem_stride=[2], batch=1, rounds=1)
    torch.set_num_threads(options.threads)
    maps = Maps(opened(options.datasets, "train"), "train")
    loader(maps, options.batch)
    device = choose_device(options.device)
    batch = next(
        load(
            maps,
            epoch_batches(maps, batch=options.batch, seed=0, epoch=0),
            workers=0,
            pinned=False,
        )
    )
    print(
        f"steps on {device}, {options.threads} threads, batch {options.batch}; median of "
        f"{options.rounds}"
    )
    for stride in options.stem_stride:
        for variant in options.variant:
            cells = []
            for precision in (torch.float32, torch.bfloat16):
                config = TrainConfig(
                    network=NetworkConfig(variant=variant, stem_stride=stride), batch=options.batch
                )
                network = placed(build(config.network), device)
                optimizer = torch.optim.AdamW(network.parameters())
                learn = Step(
                    network, optimizer, config, maps.grid, device, precision, Group(device)
                )
                said = step(learn, batch, options.rounds)
                cells.append(f"{str(precision).removeprefix('torch.')} {said}")
            print(f"{variant:<9} stem {stride}:  {';   '.join(cells)}", flush=True)


def loader(maps: Maps, batch: int) -> None:
    """Print samples a second in one process."""
    batches = list(itertools.islice(epoch_batches(maps, batch=batch, seed=0, epoch=0), 60))
    begin, cpu = time.perf_counter(), time.process_time()
    for _ in load(maps, batches, workers=0, pinned=False):
        pass
    count = len(batches) * batch
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
