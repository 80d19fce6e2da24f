"""What a stream costs: CPU time a sample against `generate`; with --train, how long training waits
for it, a map.

python benchmarks/stream.py --kind pillar
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import measuring

import scenegen
from scenegen.dataset.build import plan_dataset
from scenegen.dataset.shard import write_shard
from scenegen.recipe import preset
from scenegen.recipes import kind_names
from scenegen.source import DrawnWorlds
from scenegen.streams.stream import Stream

BATCH = 8
NETWORKS_MS = (1.0, 15.0, 80.0, 100.0)
"""What a map may take a network, milliseconds: on a GPU, and on two cores."""


def generate(kind: str, count: int, first: int) -> None:
    """Write `count` samples as a shard, compact as a network needs it."""
    recipe = preset(kind)
    with tempfile.TemporaryDirectory() as folder:
        counts = {"train": (first + 1) * count, "val": 0, "test": 0}
        plan = plan_dataset(
            Path(folder),
            recipe,
            DrawnWorlds(recipe),
            seed=0,
            counts=counts,
            compact=True,
            shard_samples=count,
        )
        write_shard(plan.shards[first])


def read(samples: Stream, count: int, first: int) -> None:
    """Ask for what a network needs, a batch at a time."""
    for at in range(first * count, (first + 1) * count, BATCH):
        for sample in samples.__getitems__(range(at, min(at + BATCH, (first + 1) * count))):
            sample.observed, sample.free, sample.occupancy  # noqa: B018
    samples.close()


@contextmanager
def ways(kind: str, workers: int) -> Iterator[dict[str, Callable[[int, int], None]]]:
    """What is compared, by name: functions of a count of samples and a round's number."""
    with tempfile.TemporaryDirectory() as folder:
        cached = Path(folder)
        yield {
            "generate --compact": lambda count, n: generate(kind, count, n),
            "stream, this process": lambda count, n: read(scenegen.stream(kind), count, n),
            f"stream, {workers} workers": lambda count, n: read(
                scenegen.stream(kind, workers=workers), count, n
            ),
            "stream, cache written": lambda count, n: read(
                scenegen.stream(kind, cache=cached), count, n
            ),
            "stream, cache read": lambda count, n: read(
                scenegen.stream(kind, cache=cached), count, n
            ),
        }


def waits(kind: str, workers: int, steps: int, dataset: Path | None) -> tuple[float, float]:
    """Milliseconds a map that training waits for its loader, and that its steps take: means over
    all steps but the first, in which processes begin."""
    import torch

    from scenegen.model.config import TrainConfig
    from scenegen.model.network import Network
    from scenegen.model.training.course import Course
    from scenegen.model.training.data import Maps, load, opened
    from scenegen.model.training.device import Group, choose_device, resolve_precision
    from scenegen.model.training.loop import Step, optimizer_of

    config, device = TrainConfig(maps=10**6, batch=BATCH), choose_device("cpu")
    maps = Maps([scenegen.stream(kind)] if dataset is None else opened([dataset], "train"), "train")
    torch.manual_seed(0)
    network = Network(config.network).to(memory_format=torch.channels_last_3d)
    precision = resolve_precision(config.precision, device)
    learn = Step(
        network, optimizer_of(network, config), config, maps.grid, device, precision, Group(device)
    )
    found, at = [], time.perf_counter()
    for batch in load(maps, Course(maps, config).batches(0, steps), workers=workers, pinned=False):
        waited, at = time.perf_counter() - at, time.perf_counter()
        learn(batch, 1e-3)
        found.append((waited, time.perf_counter() - at))
        at = time.perf_counter()
    waited, stepped = (
        sum(column) / (len(found) - 1) / BATCH * 1e3 for column in zip(*found[1:], strict=True)
    )
    return waited, stepped


def main() -> None:
    """Parse, measure in turn, and print."""
    parser = measuring.options(__doc__)
    parser.add_argument("--kind", choices=kind_names(), help="one kind instead of two")
    parser.add_argument("--samples", type=int, default=100, help="samples of a round")
    parser.add_argument("--rounds", type=int, default=7, help="how often each is measured, in turn")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--train",
        type=int,
        metavar="STEPS",
        help="instead, steps of training on the CPU to look at",
    )
    parser.add_argument(
        "--dataset", type=Path, help="a dataset whose reading --train is to be compared with"
    )
    options = measuring.parse(parser, kind="pillar", samples=8, rounds=1, workers=1)
    if options.train:
        for kind in [options.kind] if options.kind else ["geometric", "pillar"]:
            for workers in (0, 1, 2):
                waited, stepped = waits(kind, workers, options.train, None)
                print(
                    f"{kind}, {workers} loader processes: waits {waited:.1f} ms a map, steps "
                    f"{stepped:.1f} ms a map",
                    flush=True,
                )
        if options.dataset:
            waited, stepped = waits("", 0, options.train, options.dataset)
            print(
                f"{options.dataset}, no loader process: waits {waited:.1f} ms a map, steps "
                f"{stepped:.1f} ms a map",
                flush=True,
            )
        return
    for kind in [options.kind] if options.kind else ["geometric", "pillar"]:
        generate(kind, 10, 0)  # kernels compile
        with ways(kind, options.workers) as compared:
            found: dict[str, list[measuring.Time]] = {name: [] for name in compared}
            for number in range(options.rounds):
                for name, way in compared.items():
                    found[name].append(measuring.timed(partial(way, options.samples, number)))
        print(
            f"\n{kind}: CPU ms a sample (ratio to generate), wall ms a sample; medians of "
            f"{options.rounds}"
        )
        medians = {name: measuring.median(times) for name, times in found.items()}
        base = medians["generate --compact"].processor
        for name, (wall, cpu) in medians.items():
            print(
                f"  {name:24} {cpu / options.samples:6.2f} ({cpu / base:.2f})   "
                f"{wall / options.samples:6.2f}"
            )
        each = medians["stream, this process"].processor / options.samples
        for cores in (2, 16):
            said = ", ".join(
                f"{each / cores / ms:.1%} of a network's {ms:g} ms" for ms in NETWORKS_MS
            )
            print(f"  computed, {cores} cores: {1e3 * cores / each:.0f} samples/s, {said}")


if __name__ == "__main__":
    main()
