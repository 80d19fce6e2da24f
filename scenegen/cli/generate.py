"""`scenegen generate`: from options to a plan, and from a plan to a dataset."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.engines import DEFAULT, ENGINES
from scenegen.cli.options import (
    json_option,
    lidar_option,
    mapping_given,
    mapping_options,
    noise_option,
    on_option,
    options_of,
    out_option,
    quiet_option,
    seed_option,
    workers_option,
)
from scenegen.cli.progress import Progress, announce_compilation, note
from scenegen.cli.show import flat, per_split, rejections, say, show_table
from scenegen.cli.types import Named, ShardRange
from scenegen.limits import USUAL_IN_SHARD
from scenegen.recipes import KINDS
from scenegen.worlds.mapping import Mapper

if TYPE_CHECKING:
    from scenegen.dataset.build import Summary
    from scenegen.dataset.state import Plan

KIND = Named(KINDS, others={".xml": "--scene", ".toml": "--recipe"})
NETWORK_EDGE = 8
"""The bundled networks' three halvings need edges of maps that are multiples of this."""


@click.command()
@click.argument("named", metavar="[KIND]", type=KIND, required=False)
@click.option(
    "--kind", type=KIND, help=f"Kind of random worlds: {', '.join(KINDS.known)}, or MODULE:CLASS."
)
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="An MJCF file of your own world, or a folder of them.",
)
@click.option(
    "--recipe", type=click.Path(path_type=Path), help="TOML file with what differs from the preset."
)
@lidar_option("The sensor", "  [default: the recipe's]")
@noise_option
@mapping_options()
@options_of(
    Mapper,
    tilt_mps="Lean as a quadrotor that flies at so many metres a second; 0 for a level body.",
)
@click.option(
    "--engine",
    type=Named(ENGINES),
    default=DEFAULT,
    show_default=True,
    help=f"What casts the rays: {', '.join(ENGINES.known)}, or MODULE:CLASS.",
)
@click.option(
    "-n",
    "--n",
    type=click.IntRange(min=1),
    default=2500,
    show_default=True,
    help="Training samples.",
)
@click.option(
    "--val", type=click.IntRange(min=0), help="Validation samples.  [default: a tenth of --n]"
)
@click.option("--test", type=click.IntRange(min=0), help="Test samples.  [default: a fifth of --n]")
@seed_option("The same seed, the same dataset.")
@out_option("Folder of the dataset, or s3://bucket/folder.  [default: data/<kind>]", places=True)
@workers_option
@on_option
@click.option(
    "--labels",
    type=click.Choice(["name", "material", "group"]),
    help="Say of every return and voxel which geom it is of, and which class: by names or "
    "materials of geoms, or by "
    "their group.",
)
@click.option(
    "--compact", is_flag=True, help="Leave out what readers can derive: free space and distances."
)
@click.option(
    "--shard-samples",
    type=click.IntRange(min=1),
    default=USUAL_IN_SHARD,
    show_default=True,
    help="Samples in a file.",
)
@click.option(
    "--split-range",
    type=ShardRange(),
    help="Only these shards, for a cluster; --dry-run counts them.",
)
@click.option(
    "--allow-unseen",
    is_flag=True,
    help="Take scenes with geoms that rays cannot see; leave these out.",
)
@click.option("--force", is_flag=True, help="Replace another dataset in the folder.")
@click.option(
    "--dry-run", is_flag=True, help="Say what would be made, as a recipe file, and make nothing."
)
@json_option
@quiet_option
def generate(
    named: str | None,
    n: int,
    val: int | None,
    test: int | None,
    workers: int,
    on: str,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Make a dataset: worlds, flights, scans and truth. Given again after a stop, it goes on where
    it was."""
    begin = time.perf_counter()
    if named is not None and options["kind"] is not None:
        raise click.UsageError("the kind is given twice; leave out --kind, or the word without it")
    options["kind"] = named or options["kind"]
    given = [name for name in ("kind", "scene", "recipe") if options[name] is not None]
    if not given:
        raise click.UsageError("give --kind, --scene or --recipe, for instance --kind pillar")
    if {"kind", "scene"} <= set(given):
        raise click.UsageError("--kind draws worlds and --scene reads them; give one of the two")
    talk = not (quiet or as_json)
    if talk:
        announce_compilation()
    from scenegen.dataset.build import build, check_folder
    from scenegen.dataset.generation import plan_generation
    from scenegen.run import executor
    from scenegen.run.workers import keep_memory

    keep_memory()

    asked = [*("kind", "scene", "recipe", "out", "lidar", "noise", "labels", "seed", "engine")]
    asked += ["compact", "shard_samples", "allow_unseen"]
    plan = plan_generation(
        n=n,
        val=val,
        test=test,
        mapping=mapping_given(options),
        tell=note if talk else lambda line: None,
        **{name: options[name] for name in asked},
    )
    shard_range = options["split_range"]
    if shard_range and shard_range[1] > len(plan.shards):
        raise click.UsageError(
            f"--split-range {shard_range[0]}:{shard_range[1]}: there are {len(plan.shards)} shards"
        )
    check_folder(plan, force=options["force"])
    if talk and any(edge % NETWORK_EDGE for edge in plan.parameters["grid"]["shape"]):
        note(
            f"note: the bundled networks need edges that are multiples of {NETWORK_EDGE}, and "
            f"grid.shape = "
            f"{plan.parameters['grid']['shape']}; other methods take any"
        )
    if dry_run:
        _show_plan(plan, as_json)
        return
    execute = executor(on, workers)
    chosen = execute.mine(plan.shards[slice(*shard_range)] if shard_range else plan.shards)
    names = {shard.file.name for shard in chosen}

    def start() -> None:
        progress.start(sum(shard.samples for shard in chosen))

    def count(report: Any, fresh: bool) -> None:
        progress.count(report.samples if report.file in names else 0)

    with Progress(plan.parameters["kind"], shown=talk) as progress:
        summary = build(
            plan,
            execute=execute,
            workers=workers,
            shard_range=shard_range,
            force=options["force"],
            on_start=start,
            on_shard=count,
        )
    if as_json:
        print(
            json.dumps(
                {
                    **vars(summary),
                    "folder": str(summary.folder),
                    "seconds": time.perf_counter() - begin,
                }
            )
        )
    elif talk:
        show_summary(summary, time.perf_counter() - begin)


def _show_plan(plan: "Plan", as_json: bool) -> None:
    """What would be made, and the recipe file that says all of it."""
    rows = {
        "folder": str(plan.folder),
        "samples": plan.samples,
        "shards": len(plan.shards),
        "bytes_expected": plan.bytes_expected,
    }
    if as_json:
        print(json.dumps(rows | {"parameters": plan.parameters}))
        return
    from scenegen.share.regenerate import recipe_text

    of_recipe = ("kind", "recipe", "lidar", "noise", "mapping", "grid")
    show_table(
        rows | flat({key: value for key, value in plan.parameters.items() if key not in of_recipe}),
        "would make",
    )
    say(f"\n{recipe_text(plan.parameters, 'this as a recipe file')}".rstrip())


def show_summary(summary: "Summary", seconds: float) -> None:
    """What was made."""
    present = sum(summary.samples.values())
    show_table(
        {
            "folder": summary.folder,
            "samples": f"{present}  ({per_split(summary.samples)})",
            "worlds": f"{sum(summary.worlds.values())}  ({per_split(summary.worlds)})",
            "rejected": rejections(summary.rejected),
            "size": f"{summary.bytes / 1e6:.1f} MB, {summary.bytes / max(present, 1) / 1e3:.1f} "
            f"KB a sample",
            "time": f"{seconds:.1f} s, {summary.samples_written / seconds:.0f} samples a second, "
            f"start-up included"
            if summary.samples_written
            else f"{seconds:.1f} s; nothing was left to make",
            "digest": summary.digest
            or f"none yet: {summary.shards_missing} of {summary.shards} shards are missing",
            "next": f"scenegen inspect {summary.folder}",
        }
    )
