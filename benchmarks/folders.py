"""What commands cost on folders of very many shards: processor time, and memory of the largest
process.

    python benchmarks/folders.py --shards 10 1000 10000 100000 [--samples 10000] [--at /dev/shm]
    [--workers 1]

A first folder has full `pillar` maps in shards of a thousand. Each of the others has as many tiny
shards, of one map of 16³ voxels each: one flight is drawn for all, and every shard has its own
numbers, a world that differs in a digit, and a pose that differs in its last bits. Every command
runs on each in a process of its own. What a shard takes more is the difference between the last
and the first of the tiny folders; what a sample takes, that between the full folder and the first;
from both comes what 1, 10 and 100 million full samples in shards of a thousand would take.
"""

import multiprocessing
import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import measuring
from measuring import Cost

RECIPE = """
kind = "pillar"
world = {size_m = [16, 16, 8]}
flight = {viewpoints = 1, margin_m = 2, min_distance_m = 6}
accept = {min_solids = 1}
lidar = {rows = 4, columns = 16}
grid = {shape = [16, 16, 16]}
"""
IN_SHARD = 1000
"""Samples of a shard of full maps."""
MILLIONS = (1, 10, 100)


def command(*words: object) -> Callable[[], Cost]:
    """A command of scenegen, to be measured."""
    return lambda: measuring.run("-m", "scenegen", *words)[0]


def main() -> None:
    """Make the folders one after the other, and print the tables."""
    parser = measuring.options(__doc__)
    parser.add_argument("--shards", type=int, nargs="+", default=[10, 1000, 10_000])
    parser.add_argument("--samples", type=int, default=10_000, help="full samples")
    parser.add_argument("--at", type=Path, help="where folders are made, such as a RAM disk")
    parser.add_argument("--workers", type=int, default=1)
    asked = measuring.parse(parser, shards=[10, 20], samples=10)
    found: dict[int, dict[str, Cost]] = {}
    with tempfile.TemporaryDirectory(dir=asked.at) as here:
        recipe = Path(here, "tiny.toml")
        recipe.write_text(RECIPE)
        full = split(asked.samples, "--kind", "pillar", "--shard-samples", IN_SHARD)
        command(*full, "--out", Path(here, "full"))()
        each = measure(Path(here, "full"), full, asked.workers)
        for shards in asked.shards:
            folder = Path(here, str(shards))
            words = split(shards, "--recipe", recipe, "--shard-samples", 1, "--compact")
            # in a process of its own: the memory of those begun here counts what this one has
            made = multiprocessing.get_context("spawn").Process(
                target=fill, args=(folder, recipe, shards, asked.workers)
            )
            made.start()
            made.join()
            found[shards] = measure(folder, words, asked.workers)
    (few, least), (many, most) = list(found.items())[:: len(found) - 1]
    print(f"\n| processor s, MB | {asked.samples} full samples |", end="")
    print(*(f" {shards} tiny shards |" for shards in found), *(f" {n} M |" for n in MILLIONS))
    print("|---" * (2 + len(found) + len(MILLIONS)) + "|")
    for name, cost in each.items():
        costs = [cost, *(one[name] for one in found.values())]
        row = [f"{it.processor_s:.1f}, {it.megabytes:.0f} |" for it in costs]
        base = least[name].processor_s
        sample = max(cost.processor_s - base, 0) / asked.samples
        shard = (most[name].processor_s - base) / (many - few)
        row += [f"{base + 1e6 * n * (sample + shard / IN_SHARD):.0f} |" for n in MILLIONS]
        print(f"| {name} |", *row)


def split(count: int, *words: object) -> list[object]:
    """The command that generates `count` samples, an eighth of them for other splits."""
    test = max(count // 10, 1)
    rest = ["--n", count - 2 * test, "--val", test, "--test", test, "--quiet"]
    return ["generate", *words, *rest]


def fill(folder: Path, recipe: Path, shards: int, workers: int) -> None:
    """A folder of so many tiny shards, which no manifest lists yet."""
    from scenegen.dataset.generation import plan_generation
    from scenegen.dataset.state import State
    from scenegen.run.workers import run

    test = max(shards // 10, 1)
    plan = plan_generation(
        n=shards - 2 * test,
        val=test,
        test=test,
        out=folder,
        recipe=recipe,
        compact=True,
        shard_samples=1,
    )
    State(plan).open()
    first: Any = plan.shards[0]
    for _ in run(partial(forge, first.draw(0)), list(enumerate(plan.shards)), workers):
        pass


def forge(unit: Any, task: tuple[int, Any]) -> None:
    """Write a shard of the one sample of `unit`, as if it were another one's."""
    from scenegen.dataset.shard import put
    from scenegen.draw import Rejections

    number, spec = task
    (sample,) = unit.samples
    position = sample.position.copy()
    position.view("<i8")[0] += number
    origin = sample.grid.origin_at(position)
    sample = replace(sample, world=spec.first_unit, position=position, origin=origin)
    world = re.sub(rb'pos="(\S+)', rb'pos="\g<1>%06d' % number, unit.world.mjcf, count=1)
    documents = {f"{spec.first_unit:06d}.xml": world}
    put(spec, [(partial(getattr, sample), sample.sha256())], documents, Rejections())


def measure(folder: Path, words: list[object], workers: int) -> dict[str, Cost]:
    """What every command takes on a folder, which the command `words` makes or goes on with."""
    here, again = folder.parent, [*words, "--out", folder, "--workers", workers]
    quiet = ["--quiet", "--workers", workers]
    parts = [here / f"{folder.name}-{name}" for name in ("train", "test", "both")]
    read = f"import scenegen; scenegen.load({str(folder)!r})[0].ranges"
    rows: dict[str, Callable[[], Cost]] = {
        "nothing: `scenegen --version`": command("--version"),
        "resume, unlisted": command(*again),
        "resume, listed": command(*again),
        "open, read one sample": lambda: measuring.run("-c", read)[0],
        "inspect": command("inspect", folder),
        "verify --quick": command("verify", folder, "--quick", *quiet),
        "take --split train": command("take", folder, "--split", "train", "-o", parts[0], *quiet),
        "take --split test": command("take", folder, "--split", "test", "-o", parts[1], *quiet),
        "merge of both": command("merge", *parts[:2], "-o", parts[2], *quiet),
    }
    found = {}
    for name, task in rows.items():
        found[name] = task()
        used, wall, memory = found[name]
        print(f"{folder.name}: {name}: {used:.1f} s, {wall:.1f} by the clock, {memory:.0f} MB")
    print(
        f"{folder.name}: dataset.json has {(folder / 'dataset.json').stat().st_size} bytes",
        flush=True,
    )
    return found


if __name__ == "__main__":
    main()
