"""Build a dataset: plan its shards, find those that are there, have the rest written, and sign the
whole."""

import math
import shutil
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from lidarsim.engines import DEFAULT, MUJOCO
from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.layout import layout_of
from scenegen.dataset.parts import schema_of
from scenegen.dataset.placed import write_shard
from scenegen.dataset.shard import ShardReport, ShardSpec, ShardTask, find_engine
from scenegen.dataset.state import Plan, State
from scenegen.errors import DatasetError
from scenegen.files import Json, writable
from scenegen.limits import MOST_SHARDS
from scenegen.recipe import Recipe
from scenegen.run import Counted, Executor, undone, unheard
from scenegen.run.workers import Local
from scenegen.source import Source
from scenegen.stores import Place

NOTE_S = 30.0
"""Seconds after which a run writes down what is finished; of the most shards that there can be,
that takes some seconds."""


@dataclass(frozen=True, kw_only=True)
class Summary:
    """What a run did, and what it knows to be there; a job with a part of the shards looks at no
    others until all are there."""

    folder: Place
    complete: bool
    samples: dict[str, int]
    worlds: dict[str, int]
    rejected: dict[str, dict[str, int]]
    bytes: int
    shards: int
    shards_missing: int
    samples_written: int
    digest: str | None


def plan_dataset(
    folder: Place,
    recipe: Recipe,
    source: Source,
    **options: Any,
) -> Plan:
    """Divide the samples that `options` ask for, those of `manifest.parameters`, into shards made
    of whole units.

    Raises DatasetError for an engine that is not to be had, and for numbers beyond those that
    readers take.
    """
    given = manifest.parameters(recipe, source, **options)
    find_engine(options.get("engine", DEFAULT))
    return divide(folder, given, recipe, source)


def divide(
    folder: Place,
    given: Json,
    recipe: Recipe,
    source: Source,
    kind: type[ShardSpec] = ShardSpec,
) -> Plan:
    """Divide the samples that the manifest's parameters `given` ask for into shards of a `kind`.
    Raises DatasetError."""
    counts, fingerprint = given["counts"], manifest.fingerprint(given)
    each = recipe.flight.viewpoints
    step = max(given["shard_samples"] // each, 1)
    layout = layout_of(given["fields"], schema_of(recipe))
    shards = []
    if (samples := sum(counts.values())) > MOST_SHARDS * step * each:
        raise DatasetError(
            f"--shard-samples {given['shard_samples']}: {samples} samples are more than "
            f"{MOST_SHARDS} shards of {step * each}; give {-(-samples // MOST_SHARDS)} or more"
        )
    for split in SPLITS:
        units = math.ceil(counts[split] / each)
        for index, first in enumerate(range(0, units, step)):
            here = range(first, min(first + step, units))
            # a world a unit is a range, which takes no memory, or worlds come again
            apart = source.number(split, here[-1])[0] == here[-1]
            shards.append(
                kind(
                    split=split,
                    index=index,
                    first_unit=first,
                    numbers=here if apart else [source.number(split, unit)[0] for unit in here],
                    samples=min(len(here) * each, counts[split] - first * each),
                    seed=given["seed"],
                    layout=layout,
                    parameters=fingerprint,
                    recipe=recipe,
                    source=source,
                    engine=given.get("engine", MUJOCO),
                )
            )
    return Plan(folder=folder, parameters=dict(given), shards=tuple(shards), lidars=(recipe.lidar,))


def build(
    plan: Plan,
    *,
    workers: int = 1,
    execute: Executor | None = None,
    shard_range: tuple[int, int] | None = None,
    force: bool = False,
    on_start: Counted = unheard,
    on_shard: Callable[[ShardReport, bool], None] = lambda report, fresh: None,
) -> Summary:
    """Make `plan`'s dataset, or go on with it, or, with `shard_range` (first, one past last), make
    a part of it.

    A folder that holds the same dataset with fewer samples goes on from there.

    `workers` processes of this machine write the shards, or whatever `execute` has do it. `force`
    replaces another dataset in the folder. `on_start` is told once the work has begun how many
    samples this run sees to, and `on_shard` of each of its shards that is there already (False) and
    of each that is written (True). A run that ends in any way leaves whole shards, and the next one
    goes on from there. The run that finds every shard completes the manifest.

    Raises DatasetError for a folder that holds something else, and what writing shards raises.
    """
    first, stop = shard_range or (0, len(plan.shards))
    execute = execute or Local("", workers)
    state = State(plan, force=force)
    begun = state.begun
    state.adopt()
    mine = execute.mine(plan.shards[first:stop])
    state.look(mine, workers=workers)
    missing = [shard for shard in mine if shard.file not in state.reports]
    _check_space(plan, missing)
    # kernels compile here, once, before workers start, and hopeless parameters end here, before
    # anything is written
    if missing and (not begun or (len(missing) > 1 and workers > 1)):
        missing[0].prepare(workers)
    state.open()
    for report in state.reports_of(mine):
        on_shard(report, False)
    samples = sum(shard.samples for shard in mine)
    written, noted = 0, time.monotonic()
    write = partial(write_shard, plan.folder)
    with (
        undone(state.clear),
        closing(execute(write, missing, lambda: on_start(samples))) as results,
    ):
        for report in results:
            state.reports[report.file] = report
            written += report.samples
            on_shard(report, True)
            if time.monotonic() - noted > NOTE_S:
                state.note(mine)
                noted = time.monotonic()
    if written and len(mine) < len(plan.shards):
        state.note(mine)
    return _summarise(state, state.sign(workers=workers), written)


def _check_space(plan: Plan, missing: list[ShardTask]) -> None:
    """Raise DatasetError where the disk clearly cannot hold what is to be written; a store tells
    nobody beforehand."""
    if not missing or not isinstance(plan.folder, Path):
        return
    needed = replace(plan, shards=tuple(missing)).bytes_expected
    disk = shutil.disk_usage(writable(plan.folder))
    # the system's own folders have no size; they refuse by themselves
    if needed / 2 > disk.free and disk.total:
        raise DatasetError(
            f"{plan.folder}: needs about {needed / 1e6:.0f} MB, {disk.free / 1e6:.0f} MB are free; "
            "free some space, or choose another disk with --out"
        )


def _summarise(state: State, final: Json, written: int) -> Summary:
    plan, reports = state.plan, state.reports
    samples = dict.fromkeys(SPLITS, 0)
    worlds = {split: set[int]() for split in SPLITS}
    for shard in plan.shards:
        if shard.file in reports:
            samples[shard.split] += shard.samples
            source = shard.more.get("source", 0) << 32
            worlds[shard.split].update(source + number for number in shard.numbers)
    whole = final["complete"]
    missing = 0 if whole else len(state.absent()) or len(plan.shards) - len(reports)
    return Summary(
        folder=plan.folder,
        complete=whole,
        samples=samples,
        worlds={split: len(found) for split, found in worlds.items()},
        rejected=final["rejected"],
        bytes=sum(report.size for report in reports.values()),
        shards=len(plan.shards),
        shards_missing=missing,
        samples_written=written,
        digest=final["digest"],
    )
