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

import re
import shlex
import tempfile
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import measuring

from scenegen.dataset.schema import NAME

RECIPE = """
kind = "pillar"
world = {size_m = [16, 16, 8]}
flight = {viewpoints = 5, margin_m = 2, min_distance_m = 6}
accept = {min_solids = 1}
lidar = {rows = 4, columns = 16}
grid = {shape = [16, 16, 16]}
"""


FORGET = """
import sys
from pathlib import Path
from msgspec.structs import replace
from scenegen.dataset import manifest
folder = Path(sys.argv[1])
whole = manifest.load(folder)
manifest.write(folder, replace(whole, shards=(), complete=False, digest=None))
"""
"""Takes the list of shards out of a manifest."""
OPEN = "import scenegen, sys; scenegen.load(sys.argv[1])[0].ranges"
UNLISTED = "resume, unlisted"


class Options(measuring.Options):
    """What the dataset is."""

    samples: int = 20_000
    shard_samples: int = 20
    workers: int = 2
    folder: Path | None = None
    """where the dataset is kept; else in a folder that is removed"""
    forged: bool = False
    """as many shards as samples"""


def main() -> None:
    """Make the dataset, and print the table."""
    given = measuring.parse(Options, samples=20, shard_samples=10, workers=1)
    with tempfile.TemporaryDirectory() as name:
        here = Path(name)
        folder, recipe = given.folder or here / "d", here / "tiny.toml"
        recipe.write_text(RECIPE)
        test = given.samples // 10
        train = given.samples - 2 * test
        if given.forged:
            given.shard_samples = 1
            recipe.write_text(RECIPE.replace("viewpoints = 5", "viewpoints = 1"))
            # by another process, since the memory of others counts that of this one
            forged = (folder, recipe, train, test, given.workers)
            made = get_context("spawn").Process(target=forge, args=forged)
            made.start()
            made.join()
        generate = (
            f"-m scenegen generate --recipe {recipe} --n {train} --val {test} --test {test} "
            f"--shard-samples {given.shard_samples} --compact --workers {given.workers} --quiet "
            f"--out {shlex.quote(str(folder))}"
        )
        measuring.run(*shlex.split(generate))  # the kernels compile
        _measure(folder, generate, given, here)


def forge(folder: Path, recipe: Path, train: int, test: int, workers: int) -> None:
    """A folder of shards of one sample each, which no manifest lists yet."""
    from scenegen.base.workers import run
    from scenegen.dataset.generation import plan_generation
    from scenegen.dataset.state import State

    (plan,) = plan_generation(
        n=train,
        val=test,
        test=test,
        out=folder,
        recipe=recipe,
        compact=True,
        shard_samples=1,
    ).datasets
    State(plan).open()
    first: Any = plan.shards[0]
    for _ in run(partial(_forge, folder, first.draw(0)), list(enumerate(plan.shards)), workers):
        pass


def _forge(folder: Path, unit: Any, task: tuple[int, Any]) -> None:
    """Write a shard of the one sample of `unit`, as if it were another one's."""
    from scenegen.dataset.shard import put
    from scenegen.draw.draw import none_rejected

    number, spec = task
    (sample,) = unit.samples
    position = sample.position.copy()
    position.view("<i8")[0] += number
    origin = sample.grid.origin_at(position)
    sample = replace(sample, world=spec.first_unit, position=position, origin=origin)
    world = re.sub(rb'pos="(\S+)', rb'pos="\g<1>%06d' % number, unit.world.mjcf, count=1)
    documents = {f"{spec.first_unit:06d}.xml": world}
    put(folder, spec, [(partial(getattr, sample), sample.sha256())], documents, none_rejected())


def _measure(folder: Path, generate: str, given: Options, here: Path) -> None:
    """Print what commands take."""
    files = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    samples, workers, data = given.samples, given.workers, shlex.quote(str(folder))
    print(
        f"{samples} samples of {sum(files) / samples / 1e3:.1f} KB, {len(files)} files; {NAME} "
        f"has {(folder / NAME).stat().st_size} bytes"
    )
    quiet = f"--quiet --workers {workers}"
    rows = {
        "nothing: `scenegen --version`": "-m scenegen --version",
        "open, read one sample": f"-c {shlex.quote(OPEN)} {data}",
        "resume, listed": generate,
        UNLISTED: generate,
        "inspect": f"-m scenegen inspect {data}",
        "inspect --all": f"-m scenegen inspect {data} --all --workers {workers}",
        "verify --quick": f"-m scenegen verify {data} --quick {quiet}",
        "take --split train": f"-m scenegen take {data} --split train -o {here}/a.json {quiet}",
    }
    idle = 0.0
    print(
        f"\n| {workers} workers | processor s, clock s | a million samples, processor s | largest "
        f"process, MB |\n|---|---|---|---|"
    )
    for name, words in rows.items():
        if name == UNLISTED:
            measuring.run("-c", FORGET, folder)
        used, seconds, memory = measuring.run(*shlex.split(words))[0]
        idle = idle or used
        of_million = (used - idle) * 1e6 / samples
        print(
            f"| {name} | {used:.1f}, {seconds:.1f} | {of_million:.0f} | {memory:.0f} |", flush=True
        )


if __name__ == "__main__":
    main()
