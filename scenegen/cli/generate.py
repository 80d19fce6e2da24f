"""`scenegen generate` makes a plan from its options, and a dataset from the plan; `recipe` prints a
preset."""

from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.engines import DEFAULT, ENGINES
from lidarsim.registry import Registry
from scenegen.base.errors import UsageError, reraise_as
from scenegen.base.limits import USUAL_IN_SHARD
from scenegen.base.paths import WORLD_FILES
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
    without,
    workers_option,
)
from scenegen.cli.show import (
    ProgressBar,
    Reporter,
    announce_compilation,
    echo,
    flat,
    info,
    per_split,
    rejections,
    seconds_taken,
    show_table,
)
from scenegen.cli.types import FILE, Choice, DatasetPath, Named, Written, read_range
from scenegen.draw.parts import PARTS
from scenegen.worlds.kinds import KINDS
from scenegen.worlds.mapping import Mapper

if TYPE_CHECKING:
    from scenegen.dataset.build import Summary
    from scenegen.dataset.generation import GenerationPlan
    from scenegen.dataset.shard import ShardReport

KIND = Named(
    # mixed is not a kind, but a collection with a dataset of each
    Registry("kind", {**KINDS.builtin, "mixed": ""}),
    file_options={".toml": "--recipe", **dict.fromkeys(WORLD_FILES, "--scene")},
)
"""Type of --kind; files and recipes are refused with the option that takes them."""
COUNT = click.IntRange(min=1)
"""Type of a number of samples."""
RECIPE_NOTE = "this as a recipe file, without --scene, --compact, --engine, seed and sizes"
"""Heading of the recipe that --dry-run prints."""


def part_options(function: Any) -> Any:
    """Add an option for each optional part of samples."""
    # reversed: the option of the last decorator is listed first
    for name, part in [*PARTS.items()][::-1]:
        kind: Any = {"type": Choice(list(part.choices))} if part.choices else {"is_flag": True}
        function = click.option(f"--{name}", help=part.help, **kind)(function)
    return function


@command(
    "generate --kind pillar -n 100",
    "generate --scene scenes/forest.xml --lidar ouster-os1-128 --noise datasheet -n 50",
    "generate --like data/pillar --lidar livox-mid-360 -o data/livox",
    "generate --kind geometric --seed 7 --dry-run",
)
@click.argument("named", metavar="[KIND]", type=KIND, required=False)
@click.option(
    "--kind",
    type=KIND,
    help=f"Kind of random worlds: {', '.join(KINDS.builtin)}; mixed for all that methods may "
    "train on; or MODULE:CLASS.",
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
    help="TOML file with the parameters that differ from the preset.",
)
@click.option(
    "--allow-unseen",
    is_flag=True,
    help="Allow scenes with geoms that rays cannot see; these are left out.",
)
@click.option(
    "--like",
    type=DatasetPath(),
    metavar="DATASET",
    help="A dataset, or its dataset.json: make it again, or scan its worlds from the same poses "
    "with another --lidar, --noise, --engine or map.",
)
@part_options
@lidar_option("the recipe's")
@noise_option
@mapping_options()
@options_of(
    Mapper,
    tilt_mps="Speed, metres a second, of a quadrotor that leans as it flies; 0 for a level body.",
)
@engine_option(
    f"Engine that casts rays: {', '.join(ENGINES.builtin)}, or MODULE:CLASS.  [default: {DEFAULT}]"
)
@click.option("-n", "--n", type=COUNT, help="Training samples.  [default: 2500]")
@click.option(
    "--val", type=click.IntRange(min=0), help="Validation samples.  [default: a tenth of --n]"
)
@click.option("--test", type=click.IntRange(min=0), help="Test samples.  [default: a fifth]")
@click.option(
    "--shard-samples", type=COUNT, help=f"Samples in a file.  [default: {USUAL_IN_SHARD}]"
)
@click.option(
    "--split-range",
    type=Written(read_range, "FIRST:STOP"),
    help="Only these shards, for a cluster; --dry-run prints how many there are.",
)
@click.option(
    "--compact",
    is_flag=True,
    help="Leave out fields that readers can derive: free space and distances.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    help="Seed; the same one gives the same dataset.  [default: 0]",
)
@out_option("Folder of the dataset, or s3://bucket/folder.  [default: data/<kind>]", stores=True)
@force_option
@click.option("--dry-run", is_flag=True, help="Print the plan and its recipe, and make nothing.")
@workers_option
@on_option
@printing
@group("Worlds", f"kind difficulty scene recipe like allow-unseen {' '.join(PARTS)}")
@group("Size and files", "n val test shard-samples split-range compact")
def generate(
    named: str | None,
    workers: int,
    on: str,
    dry_run: bool,
    report_result: Reporter,
    verbose: bool,
    **options: Any,
) -> None:
    """Make a dataset: worlds, flights, scans and truth. The same command continues a stopped run.

    \f
    Raises:
        UsageError: Options contradict each other.
        ScenegenError: There is no such kind, file or sensor; the folder holds something else; or
            samples cannot be drawn.
    """
    if named is not None and options["kind"] is not None:
        raise click.UsageError("the kind is given twice; leave out --kind, or the word without it")
    options["kind"] = named or options["kind"]
    shards, force = options.pop("split_range"), options.pop("force")
    if verbose:
        announce_compilation()  # before imports that may take seconds
    from scenegen.base.workers import keep_memory
    from scenegen.dataset.generation import plan_generation
    from scenegen.dataset.state import State

    # every shard takes the memory that the last one freed: keeping it saves a fifteenth of the time
    keep_memory()
    # errors of the plan are errors of the options: exit code 2
    with reraise_as(click.UsageError, of=UsageError):
        plans = plan_generation(
            mapping=mapping_given(options),
            report=info if verbose else lambda line: None,
            **without(Mapper, options),
        )
    # a collection has a dataset for each kind, and so no common numbers of shards
    if shards and plans.is_collection:
        raise click.UsageError("--split-range: is for one dataset; use --on rank for several")
    if shards and shards[1] > (count := len(plans.datasets[0].shards)):
        raise click.UsageError(f"--split-range {shards[0]}:{shards[1]}: there are {count} shards")
    if dry_run:
        for plan in plans.datasets:
            State(plan, force=force)  # refuses a folder that holds something else
        _show_plans(plans, report_result)
        return
    make(
        plans,
        workers=workers,
        on=on,
        shards=shards,
        force=force,
        report_result=report_result,
        verbose=verbose,
    )


def _show_plans(plans: "GenerationPlan", report_result: Reporter) -> None:
    """Print the plans, and each as a recipe file."""
    rows = {
        "folder": str(plans.folder),
        "samples": sum(plan.samples for plan in plans.datasets),
        "shards": sum(len(plan.shards) for plan in plans.datasets),
        "bytes_expected": sum(plan.bytes_expected for plan in plans.datasets),
    }
    parameters = {plan.name: plan.manifest.parameters for plan in plans.datasets}
    details: Any = {"datasets": parameters}
    if not plans.is_collection:
        details = {"parameters": plans.datasets[0].manifest.parameters}
    if not report_result(rows | details):
        return
    from scenegen.dataset.parameters import recipe_text

    show_table(rows, "would make")
    for plan in plans.datasets:
        # the recipe is printed below, as a file
        rows_of_plan = flat({**plan.manifest.parameters, "recipe": None})
        show_table({name: value for name, value in rows_of_plan.items() if value is not None}, "")
        echo(f"\n{recipe_text(plan.manifest.tables, RECIPE_NOTE)}".rstrip())


def make(
    plans: "GenerationPlan",
    *,
    workers: int,
    on: str,
    force: bool,
    report_result: Reporter,
    verbose: bool,
    shards: tuple[int, int] | None = None,
) -> None:
    """Make planned datasets, with a bar for each, and print a summary.

    Args:
        plans: The plans.
        workers: Number of processes.
        on: Name of the executor, see `scenegen.base.executors.executor`.
        force: Whether to replace another dataset in the folder.
        report_result: Prints the result as JSON if the user wants that.
        verbose: Whether to print for people.
        shards: First shard to make, and the one after the last; None for all.
    """
    from scenegen.base.executors import executor
    from scenegen.dataset.build import build

    # refuses folders of something else before any of them is written
    plans.claim_folder(force=force)
    summaries = []
    for plan in plans.datasets:
        with ProgressBar(plan.name, visible=verbose) as progress:
            summary = build(
                plan,
                execute=executor(on, workers),
                workers=workers,
                shard_range=shards,
                force=force,
                on_start=progress.start,
                on_shard=partial(_count, progress),
            )
        summaries.append(summary)
    seconds = seconds_taken()
    rows = [{**vars(summary), "folder": str(summary.folder)} for summary in summaries]
    if plans.is_collection:
        row: Any = {"folder": str(plans.folder), "datasets": rows, "seconds": seconds}
    else:
        row = {**rows[0], "seconds": seconds}
    if report_result(row):
        for summary in summaries:
            _show_summary(summary, seconds, is_single=not plans.is_collection)
        if plans.is_collection:
            show_table({"collection": plans.folder, "time": f"{seconds:.1f} s"})


def _count(progress: ProgressBar, report: "ShardReport", fresh: bool) -> None:
    """Count the samples of a shard that exists, whether this run or an earlier one wrote it."""
    progress.count(report.entry.samples)


def _show_summary(summary: "Summary", seconds: float, *, is_single: bool) -> None:
    """Print a dataset; if it `is_single` and not of a collection, with time and next step."""
    samples, written = sum(summary.samples.values()), summary.samples_written
    rows = {
        "folder": summary.folder,
        "samples": f"{samples}  ({per_split(summary.samples)})",
        "worlds": f"{sum(summary.worlds.values())}  ({per_split(summary.worlds)})",
        "rejected": rejections(summary.rejected),
        "size": f"{summary.bytes / 1e6:.1f} MB, "
        f"{summary.bytes / max(samples, 1) / 1e3:.1f} KB a sample",
    }
    if is_single:
        rate = f", {written / seconds:.1f} samples a second, imports included"
        rows["time"] = f"{seconds:.1f} s" + (rate if written else "; nothing was left to make")
    rows["digest"] = (
        summary.digest
        or f"none yet: {summary.shards_missing} of {summary.shards} shards are missing"
    )
    if is_single:
        rows["next"] = f"scenegen inspect {quote(str(summary.folder))}"
    show_table(rows)


@command("recipe pillar", "recipe rooms -o rooms.toml")
@click.argument("kind", type=Named(KINDS))
@lidar_option("the kind's")
@out_option("The file to write.  [default: standard output]", file=True)
def recipe(kind: str, lidar: str | None, out: Path | None) -> None:
    """Print the preset of a kind of worlds as a recipe, every parameter with its value, for
    `generate --recipe`.

    \f
    Raises:
        RecipeError: A recipe file cannot hold the sensor.
    """
    from lidarsim import Lidar
    from scenegen.base.errors import RecipeError
    from scenegen.base.files import write_result
    from scenegen.dataset.build import recipe_entry
    from scenegen.dataset.parameters import recipe_text
    from scenegen.worlds.recipe import preset

    chosen = preset(kind, lidar=lidar)
    if not isinstance(chosen.lidar, Lidar):
        raise RecipeError(
            f"--lidar {lidar}: is not a raster, and a recipe file holds no other sensor; give it "
            "to generate"
        )
    title = f"the preset of {kind}, version {chosen.version}; lengths are metres"
    text = recipe_text(recipe_entry(chosen), title)
    if out is None:
        echo(text.rstrip())
    else:
        write_result(out, text.encode())
        echo(f"written: {out}")
