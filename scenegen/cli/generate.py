"""`scenegen generate` and `scenegen recipe`: from options to a plan, and from a plan to a
dataset."""

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.engines import DEFAULT, ENGINES
from lidarsim.registry import Registry
from scenegen.cli.options import (
    command,
    difficulty_option,
    engine_option,
    force_option,
    group,
    lidar_option,
    mapping_given,
    mapping_options,
    noise_option,
    on_option,
    options_of,
    out_option,
    printing,
    seed_option,
    without,
    workers_option,
)
from scenegen.cli.show import (
    Progress,
    Tell,
    announce_compilation,
    flat,
    note,
    per_split,
    rejections,
    say,
    seconds_taken,
    show_table,
)
from scenegen.cli.types import FILE, Choice, Named, Written, read_range
from scenegen.errors import AskedError, raised_as
from scenegen.limits import USUAL_IN_SHARD
from scenegen.paths import WORLD_FILES
from scenegen.recipes import KINDS
from scenegen.worlds.mapping import Mapper

if TYPE_CHECKING:
    from scenegen.dataset.state import Plan

KIND = Named(
    Registry("kind", {**KINDS.builtin, "mixed": ""}),
    others={".toml": "--recipe", **dict.fromkeys(WORLD_FILES, "--scene")},
)
COUNT = click.IntRange(min=1)
BESIDE = "this as a recipe file, without --scene, --labels, --compact, --engine, seed and sizes"


@command(
    "generate --kind pillar -n 100",
    "generate --scene scenes/forest.xml --lidar ouster-os1-128 --noise datasheet -n 50",
    "generate --kind geometric --seed 7 --dry-run",
)
@click.argument("named", metavar="[KIND]", type=KIND, required=False)
@click.option(
    "--kind",
    type=KIND,
    help=f"Kind of random worlds: {', '.join(KINDS.builtin)}; mixed for all; or MODULE:CLASS.",
)
@difficulty_option
@click.option(
    "--scene",
    type=FILE,
    help="An MJCF file, a mesh or a map of your own world, or a folder of them.",
)
@click.option(
    "--recipe",
    type=FILE,
    help="TOML file with what differs from the preset.",
)
@click.option(
    "--allow-unseen",
    is_flag=True,
    help="Take scenes with geoms that rays cannot see; leave these out.",
)
@click.option(
    "--labels",
    type=Choice(["class", "name", "material", "group"]),
    help="Store the geom and the class of every return and voxel: the kinds' own classes, or by "
    "names, materials or groups of geoms.",
)
@lidar_option("the recipe's")
@noise_option
@mapping_options()
@options_of(
    Mapper,
    tilt_mps="Speed, metres a second, at which the body leans as a quadrotor; 0 for a level body.",
)
@engine_option(
    f"What casts the rays: {', '.join(ENGINES.builtin)}, or MODULE:CLASS.", default=DEFAULT
)
@click.option("-n", "--n", type=COUNT, default=2500, help="Training samples.")
@click.option(
    "--val", type=click.IntRange(min=0), help="Validation samples.  [default: a tenth of --n]"
)
@click.option("--test", type=click.IntRange(min=0), help="Test samples.  [default: a fifth]")
@click.option("--shard-samples", type=COUNT, default=USUAL_IN_SHARD, help="Samples in a file.")
@click.option(
    "--split-range",
    type=Written(read_range, "FIRST:STOP"),
    help="Only these shards, for a cluster; --dry-run counts them.",
)
@click.option(
    "--compact",
    is_flag=True,
    help="Leave out what readers can derive: free space and distances.",
)
@seed_option("The same seed, the same dataset.")
@out_option("Folder of the dataset, or s3://bucket/folder.  [default: data/<kind>]", stores=True)
@force_option
@click.option(
    "--dry-run", is_flag=True, help="Print the recipe that would be used, and make nothing."
)
@workers_option
@on_option
@printing
@group("Worlds", "kind difficulty scene recipe allow-unseen labels")
@group("Size and files", "n val test shard-samples split-range compact")
def generate(
    named: str | None,
    workers: int,
    on: str,
    dry_run: bool,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Make a dataset: worlds, flights, scans and truth. Given again after a stop, it goes on where
    it was."""
    if named is not None and options["kind"] is not None:
        raise click.UsageError("the kind is given twice; leave out --kind, or the word without it")
    options["kind"] = named or options["kind"]
    shards, force = options.pop("split_range"), options.pop("force")
    if talk:
        announce_compilation()
    from scenegen.dataset.generation import plan_generation
    from scenegen.dataset.state import State
    from scenegen.run.workers import keep_memory

    keep_memory()
    with raised_as(click.UsageError, of=AskedError):
        plan = plan_generation(
            mapping=mapping_given(options),
            tell=note if talk else lambda line: None,
            **without(Mapper, options),
        )
    if shards and shards[1] > len(plan.shards):
        raise click.UsageError(
            f"--split-range {shards[0]}:{shards[1]}: there are {len(plan.shards)} shards"
        )
    if dry_run:
        State(plan, force=force)  # which refuses a folder that holds something else
        _show_plan(plan, tell)
        return
    make(
        plan,
        workers=workers,
        on=on,
        shards=shards,
        force=force,
        tell=tell,
        talk=talk,
    )


def _show_plan(plan: "Plan", tell: Tell) -> None:
    """Prints what would be made, and the recipe file that says all of it."""
    rows = {
        "folder": str(plan.folder),
        "samples": plan.samples,
        "shards": len(plan.shards),
        "bytes_expected": plan.bytes_expected,
    }
    if not tell(rows | {"parameters": plan.parameters}):
        return
    from scenegen.share.regenerate import recipe_text

    of_recipe = ("kind", "recipe", "lidar", "noise", "mapping", "grid", "sources")
    others = {key: value for key, value in plan.parameters.items() if key not in of_recipe}
    show_table(rows | flat(others), "would make")
    say(f"\n{recipe_text(plan.parameters, BESIDE)}".rstrip())


def make(
    plan: "Plan",
    *,
    workers: int,
    on: str,
    force: bool,
    tell: Tell,
    talk: bool,
    shards: tuple[int, int] | None = None,
) -> None:
    """Makes a planned dataset, with a bar, and prints what was made.

    Args:
        plan: What is made.
        workers: Processes.
        on: Where the work is done, as `scenegen.run.executor` takes it.
        force: Replace another dataset in the folder.
        tell: Prints the result as JSON, if that is asked for.
        talk: Show a bar meanwhile.
        shards: First of the shards that are made, and the one after the last; all unless given.
    """
    from scenegen.dataset.build import build
    from scenegen.run import executor

    with Progress(plan.folder.name, shown=talk) as progress:
        summary = build(
            plan,
            execute=executor(on, workers),
            workers=workers,
            shard_range=shards,
            force=force,
            on_start=progress.start,
            on_shard=lambda report, fresh: progress.count(report.samples),
        )
    seconds = seconds_taken()
    if not tell({**vars(summary), "folder": str(summary.folder), "seconds": seconds}):
        return
    samples, written = sum(summary.samples.values()), summary.samples_written
    rate = f", {written / seconds:.1f} samples a second, imports included"
    show_table(
        {
            "folder": summary.folder,
            "samples": f"{samples}  ({per_split(summary.samples)})",
            "worlds": f"{sum(summary.worlds.values())}  ({per_split(summary.worlds)})",
            "rejected": rejections(summary.rejected),
            "size": f"{summary.bytes / 1e6:.1f} MB, "
            f"{summary.bytes / max(samples, 1) / 1e3:.1f} KB a sample",
            "time": f"{seconds:.1f} s" + (rate if written else "; nothing was left to make"),
            "digest": summary.digest
            or f"none yet: {summary.shards_missing} of {summary.shards} shards are missing",
            "next": f"scenegen inspect {quote(str(summary.folder))}",
        }
    )


@command("recipe pillar", "recipe rooms -o rooms.toml")
@click.argument("kind", type=Named(KINDS))
@lidar_option("the kind's")
@out_option("The file to write.  [default: standard output]", file=True)
def recipe(kind: str, lidar: str | None, out: Path | None) -> None:
    """Print the preset of a kind of worlds as a recipe, every parameter with its value, for
    `generate --recipe`."""
    from lidarsim import Lidar
    from scenegen.dataset import manifest
    from scenegen.errors import RecipeError
    from scenegen.files import write_result
    from scenegen.recipe import preset
    from scenegen.share.regenerate import recipe_text
    from scenegen.source import DrawnWorlds

    found = preset(kind, lidar=lidar)
    if not isinstance(found.lidar, Lidar):
        raise RecipeError(
            f"--lidar {lidar}: is no raster, which a recipe file could hold; give it to generate"
        )
    counts = {"train": 0, "val": 0, "test": 0}
    given = manifest.parameters(found, DrawnWorlds(found), seed=0, counts=counts)
    text = recipe_text(given, f"the preset of {kind}, version {found.version}; lengths are metres")
    if out is None:
        say(text.rstrip())
    else:
        write_result(out, text.encode())
        say(f"written: {out}")
