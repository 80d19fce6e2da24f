"""What commands cost on a folder of very many samples: processor time, wall time, memory of the
largest process.

    python benchmarks/folders.py --samples 20000 [--shard-samples 20] [--folder data/tiny]
    [--workers 2] [--forged]

It makes a dataset of tiny maps in small shards, as sound as any, or goes on with that in --folder;
runs every command on it in a process of its own; and prints what each took, and what a million
samples would take, computed from that as if all of it beyond the first line, which any command
takes, grew with the number of samples. With --forged, each shard has one map, and one flight is
drawn for all: a shard's world differs from the others' in a digit, its pose in the last bits, so
that 100,000 shards are made in ten minutes.
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

from scenegen.dataset.manifest import NAME

RECIPE = """
kind = "pillar"
world = {size_m = [16, 16, 8]}
flight = {viewpoints = 5, margin_m = 2, min_distance_m = 6}
accept = {min_solids = 1}
lidar = {rows = 4, columns = 16}
grid = {shape = [16, 16, 16]}
"""


def command(*words: object) -> Callable[[], Cost]:
    """A command of scenegen, to be measured."""
    return lambda: measuring.run("-m", "scenegen", *words)[0]


def main() -> None:
    """Make the dataset, and print the table."""
    parser = measuring.options(__doc__)
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--shard-samples", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--folder", type=Path, help="where the dataset is kept; else in a folder that is removed"
    )
    parser.add_argument("--forged", action="store_true", help="as many shards as samples")
    asked = measuring.parse(parser, samples=20, shard_samples=10, workers=1)
    with tempfile.TemporaryDirectory() as here:
        folder = asked.folder or Path(here, "d")
        recipe = Path(here, "tiny.toml")
        recipe.write_text(RECIPE)
        if asked.forged:
            asked.shard_samples = 1
            recipe.write_text(RECIPE.replace("viewpoints = 5", "viewpoints = 1"))
        test = asked.samples // 10
        words: list[object] = [
            *f"generate --val {test} --test {test} --n {asked.samples - 2 * test} --quiet".split()
        ]
        words += f"--shard-samples {asked.shard_samples} --workers {asked.workers} --out".split()
        words += [folder, "--recipe", recipe, "--compact"]
        if asked.forged:  # by another process, since the memory of others counts that of this one
            options = {"recipe": recipe, "val": test, "test": test, "out": folder}
            made = multiprocessing.get_context("spawn").Process(
                target=forge, args=(asked.samples - 2 * test, options, asked.workers)
            )
            made.start()
            made.join()
        command(*words)()  # the kernels compile
        _measure(folder, words, asked.samples, asked.workers, Path(here))


def forge(train: int, options: dict[str, Any], workers: int) -> None:
    """A folder of shards of one sample each, which no manifest lists yet."""
    from scenegen.dataset.generation import plan_generation
    from scenegen.dataset.state import State
    from scenegen.run.workers import run

    plan = plan_generation(n=train, compact=True, shard_samples=1, **options)
    State(plan).open()
    first: Any = plan.shards[0]
    for _ in run(partial(_forge, first.draw(0)), list(enumerate(plan.shards)), workers):
        pass


def _forge(unit: Any, task: tuple[int, Any]) -> None:
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


FORGET = """
import sys
from pathlib import Path
from scenegen.dataset import manifest
from scenegen.dataset.trust import load
folder = Path(sys.argv[1])
manifest.write(folder, manifest.assemble(load(folder).parameters, [], complete=False))
"""
"""Takes the list of shards out of a manifest."""
UNLISTED = "resume, unlisted"


def _measure(folder: Path, again: list[object], samples: int, workers: int, here: Path) -> None:
    size = (folder / NAME).stat().st_size
    files = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    some = min(100, len(list(folder.glob("*.h5"))))
    print(
        f"{samples} samples of {sum(files) / samples / 1e3:.1f} KB, {len(files)} files; {NAME} "
        f"has {size} bytes"
    )

    opened = f"import scenegen; scenegen.load({str(folder)!r})[0].ranges"
    quiet = "--quiet", "--workers", workers
    rows: dict[str, Callable[[], Cost]] = {
        "nothing: `scenegen --version`": command("--version"),
        "open, read one sample": lambda: measuring.run("-c", opened)[0],
        "resume, listed": command(*again),
        UNLISTED: command(*again),
        f"a range job of {some} shards": command(*again, "--split-range", f"0:{some}"),
        "inspect": command("inspect", folder),
        "inspect --all": command("inspect", folder, "--all", "--workers", workers),
        "verify --quick": command("verify", folder, "--quick", *quiet),
        "take --split train": command("take", folder, "--split", "train", "-o", here / "a", *quiet),
        "take --split test": command("take", folder, "--split", "test", "-o", here / "b", *quiet),
        "merge": command("merge", here / "a", here / "b", "-o", here / "c", *quiet),
    }
    idle = 0.0
    print(
        f"\n| {workers} workers | processor s, clock s | a million samples, processor s | largest "
        f"process, MB |"
    )
    print("|---|---|---|---|")
    for name, run in rows.items():
        if name == UNLISTED:
            measuring.run("-c", FORGET, folder)
        used, seconds, memory = run()
        idle = idle or used
        of_million = (used - idle) * 1e6 / samples
        print(
            f"| {name} | {used:.1f}, {seconds:.1f} | {of_million:.0f} | {memory:.0f} |", flush=True
        )


if __name__ == "__main__":
    main()
