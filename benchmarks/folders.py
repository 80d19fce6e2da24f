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
        words = [
            "generate",
            "--recipe",
            recipe,
            "--n",
            asked.samples - 2 * test,
            "--val",
            test,
            "--test",
            test,
        ]
        words += ["--compact", "--shard-samples", asked.shard_samples, "--quiet", "--out", folder]
        words += ["--workers", asked.workers]
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
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from scenegen.dataset import manifest
from scenegen.dataset.placed import write_note
from scenegen.dataset.trust import load
folder = Path(sys.argv[1])
there = load(folder)
manifest.write(folder, manifest.assemble(there.parameters, [], complete=False))
if sys.argv[2] == "noted":
    files = [entry.file for entry in there.shards]
    reports = [SimpleNamespace(entry=partial(asdict, entry)) for entry in there.shards]
    write_note(folder, there.fingerprint, files, reports)
"""
"""Takes the list of shards out of a manifest, and writes it down as one job's of many, if asked
to."""


def _measure(folder: Path, again: list[object], samples: int, workers: int, here: Path) -> None:
    size = (folder / NAME).stat().st_size
    files = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    some = min(100, len(list(folder.glob("*.h5"))))
    print(
        f"{samples} samples of {sum(files) / samples / 1e3:.1f} KB, {len(files)} files; {NAME} "
        f"has {size} bytes"
    )

    def unlisted() -> None:
        measuring.run("-c", FORGET, folder, "")

    def left_to_the_last_job() -> None:
        measuring.run("-c", FORGET, folder, "noted")

    rows: list[tuple[str, Callable[[], None], Callable[[], Cost]]] = [
        ("nothing: `scenegen --version`", lambda: None, command("--version")),
        (
            "open, read one sample",
            lambda: None,
            lambda: measuring.run(
                "-c", f"import scenegen; scenegen.load({str(folder)!r})[0].ranges"
            )[0],
        ),
        ("resume, listed", lambda: None, command(*again)),
        ("resume, unlisted", unlisted, command(*again)),
        ("last job of many, noted", left_to_the_last_job, command(*again)),
        (
            f"a range job of {some} shards",
            lambda: None,
            command(*again, "--split-range", f"0:{some}"),
        ),
        ("inspect", lambda: None, command("inspect", folder)),
        ("inspect --all", lambda: None, command("inspect", folder, "--all", "--workers", workers)),
        (
            "verify --quick",
            lambda: None,
            command("verify", folder, "--quick", "--quiet", "--workers", workers),
        ),
        (
            "take --split train",
            lambda: None,
            command(
                "take",
                folder,
                "--split",
                "train",
                "--quiet",
                "-o",
                here / "a",
                "--workers",
                workers,
            ),
        ),
        (
            "take --split test",
            lambda: None,
            command(
                "take", folder, "--split", "test", "--quiet", "-o", here / "b", "--workers", workers
            ),
        ),
        (
            "merge",
            lambda: None,
            command(
                "merge", here / "a", here / "b", "--quiet", "-o", here / "c", "--workers", workers
            ),
        ),
    ]
    idle = 0.0
    print(
        f"\n| {workers} workers | processor s, clock s | a million samples, processor s | largest "
        f"process, MB |"
    )
    print("|---|---|---|---|")
    for name, prepare, run in rows:
        prepare()
        used, seconds, memory = run()
        idle = idle or used
        of_million = (used - idle) * 1e6 / samples
        print(
            f"| {name} | {used:.1f}, {seconds:.1f} | {of_million:.0f} | {memory:.0f} |", flush=True
        )


if __name__ == "__main__":
    main()
