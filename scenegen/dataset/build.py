"""Build a dataset: plan its shards, find existing ones, write the others, complete the manifest."""

import math
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from lidarsim.engines import DEFAULT
from scenegen import GENERATOR, SPLITS
from scenegen.base.errors import CorruptFileError, DatasetError, check_int, reraise_as
from scenegen.base.executors import Counted, Executor, software, undone, unheard
from scenegen.base.files import writable
from scenegen.base.limits import MAX_SAMPLES_IN_SHARD, MAX_SEED, MAX_SHARDS, USUAL_IN_SHARD
from scenegen.base.stores import Location
from scenegen.base.workers import Local
from scenegen.dataset import manifest
from scenegen.dataset.layout import layout_of
from scenegen.dataset.manifest import Manifest, schema_of
from scenegen.dataset.parameters import mapping_entry, noise_entry, plain, sensor_entry
from scenegen.dataset.placed import write_shard
from scenegen.dataset.schema import RecipeEntry, SceneEntry
from scenegen.dataset.shard import ShardReport, ShardSpec, find_engine
from scenegen.dataset.state import DatasetPlan, State
from scenegen.draw.source import Source
from scenegen.worlds.recipe import Recipe

NOTE_S = 30.0
"""Interval at which a run records finished shards, seconds. With `MAX_SHARDS`, recording takes
some seconds."""


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Result of a run. A job that writes a part of the shards does not examine the others until all
    exist."""

    folder: Location
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
    folder: Location,
    recipe: Recipe,
    source: Source,
    *,
    seed: int,
    counts: Mapping[str, int],
    compact: bool = False,
    shard_samples: int = USUAL_IN_SHARD,
    engine: str = DEFAULT,
    tables: RecipeEntry | None = None,
    like: str | None = None,
    shard_type: type[ShardSpec] = ShardSpec,
) -> DatasetPlan:
    """Divide samples into shards of whole units.

    Args:
        folder: Location of the dataset.
        recipe: Settings of samples.
        source: Where worlds come from.
        seed: Seed of all random numbers.
        counts: Number of samples of each split.
        compact: Whether derived fields are left out.
        shard_samples: Approximate number of samples of a shard.
        engine: Name of the engine that casts rays; see `lidarsim.engines.ENGINES`.
        tables: The recipe's entry in the manifest, if it differs from `recipe_entry`.
        like: Digest of the dataset that is scanned again, if any.
        shard_type: Class of shards, which draws their units.

    Returns:
        The plan. Nothing is written.

    Raises:
        DatasetError: if the engine is not available, or a number exceeds a limit of readers.
        RecipeError: if worlds for testing alone are to be in another split.
    """
    find_engine(engine)
    recipe.check_splits(split for split, count in counts.items() if count)
    seed = check_int("--seed", seed, 0, MAX_SEED)
    shard_samples = check_int("--shard-samples", shard_samples, 1, MAX_SAMPLES_IN_SHARD)
    scenes = source.describe()
    planned = Manifest(
        generator=GENERATOR,
        seed=seed,
        # in this order: the manifest's bytes must not depend on the caller's mapping
        counts={split: counts[split] for split in SPLITS},
        tables=tables or recipe_entry(recipe),
        scenes={split: [SceneEntry(**entry) for entry in scenes[split]] for split in scenes}
        or None,
        like=like,
        fields=schema_of(recipe).stored(compact=compact),
        shard_samples=shard_samples,
        engine=engine,
        software=software(),
        folder=Path(str(folder)),
    )
    with reraise_as(DatasetError, "a manifest cannot say what is asked for: ", of=CorruptFileError):
        # a manifest that no reader accepts is refused before anything is drawn
        manifest.parse(manifest.encode(planned))
    # cached properties would read the table of rays from the folder, where it is not written yet
    planned.__dict__.update(recipe=recipe, lidar=recipe.lidar)
    viewpoints = recipe.flight.viewpoints
    # a shard holds whole flights, at least one
    step = max(shard_samples // viewpoints, 1)
    if (samples := sum(counts.values())) > MAX_SHARDS * step * viewpoints:
        raise DatasetError(
            f"--shard-samples {shard_samples}: {samples} samples are more than {MAX_SHARDS} "
            f"shards of {step * viewpoints}; give {-(-samples // MAX_SHARDS)} or more"
        )
    shards = []
    for split in SPLITS:
        units = math.ceil(counts[split] / viewpoints)
        for index, first in enumerate(range(0, units, step)):
            unit_numbers = range(first, min(first + step, units))
            # with a new world for every unit, a range serves, which takes no memory
            is_range = source.number(split, unit_numbers[-1])[0] == unit_numbers[-1]
            shards.append(
                shard_type(
                    split=split,
                    index=index,
                    first_unit=first,
                    numbers=unit_numbers
                    if is_range
                    else [source.number(split, unit)[0] for unit in unit_numbers],
                    # the last flight of a split may be cut
                    samples=min(len(unit_numbers) * viewpoints, counts[split] - first * viewpoints),
                    seed=seed,
                    layout=layout_of(planned.fields, schema_of(recipe)),
                    parameters=planned.fingerprint,
                    recipe=recipe,
                    source=source,
                    engine=engine,
                )
            )
    return DatasetPlan(folder=folder, manifest=planned, shards=tuple(shards))


def recipe_entry(recipe: Recipe) -> RecipeEntry:
    """Describe a recipe in a manifest.

    Raises:
        CorruptFileError: if the noise cannot be described.
    """
    world = None if recipe.world is None else plain(asdict(recipe.world))
    return RecipeEntry(
        kind=recipe.kind,
        version=recipe.version,
        difficulty=recipe.difficulty,
        world=world,
        flight=plain(asdict(recipe.flight)),
        accept=plain(asdict(recipe.accept)),
        lidar=sensor_entry(recipe.lidar),
        grid=plain(asdict(recipe.grid)),
        noise=noise_entry(recipe.noise, recipe.lidar.max_range_m),
        mapping=mapping_entry(recipe.mapping),
        known=None if recipe.known is None else plain(asdict(recipe.known)),
        parts={name: plain(asdict(settings)) for name, settings in recipe.parts.items()},
    )


def build(
    plan: DatasetPlan,
    *,
    workers: int = 1,
    execute: Executor | None = None,
    shard_range: tuple[int, int] | None = None,
    force: bool = False,
    on_start: Counted = unheard,
    on_shard: Callable[[ShardReport, bool], None] = lambda report, fresh: None,
) -> Summary:
    """Make a dataset, or continue one.

    A folder with the same dataset and fewer samples is continued. A run that is stopped leaves
    complete shards, and the next run continues from there. The run that finds every shard completes
    the manifest.

    Args:
        plan: The plan of the dataset.
        workers: Number of processes of this machine.
        execute: Executor of the shards, instead of `workers`.
        shard_range: Positions (first, one past last) of the shards to write; all by default.
        force: Whether another dataset in the folder is replaced.
        on_start: Called with the number of samples of this run when its workers have started.
        on_shard: Called as on_shard(report, is_new) for each shard of this run that exists or is
            written.

    Returns:
        A summary of the run.

    Raises:
        DatasetError: if the folder holds something else. Errors of writing shards pass through.
    """
    first, stop = shard_range or (0, len(plan.shards))
    execute = execute or Local("", workers)
    state = State(plan, force=force)
    begun = state.begun
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
            state.reports[report.entry.file] = report
            written += report.entry.samples
            on_shard(report, True)
            if time.monotonic() - noted > NOTE_S:
                state.note(mine)
                noted = time.monotonic()
    # a later run can find these shards, even if no job completes the manifest
    if written and len(mine) < len(plan.shards):
        state.note(mine)
    return _summarise(state, state.sign(workers=workers), written)


def _check_space(plan: DatasetPlan, missing: list[ShardSpec]) -> None:
    """Check that the disk can hold the missing shards. Stores do not report their free space."""
    if not missing or not isinstance(plan.folder, Path):
        return
    needed = replace(plan, shards=tuple(missing)).bytes_expected
    disk = shutil.disk_usage(writable(plan.folder))
    # half of the estimate, so that no run is refused wrongly; /proc and the like have size 0
    if needed / 2 > disk.free and disk.total:
        raise DatasetError(
            f"{plan.folder}: needs about {needed / 1e6:.0f} MB, {disk.free / 1e6:.0f} MB are free; "
            "free some space, or choose another disk with --out"
        )


def _summarise(state: State, final: Manifest, written: int) -> Summary:
    plan, reports = state.plan, state.reports
    samples = dict.fromkeys(SPLITS, 0)
    worlds = {split: set[int]() for split in SPLITS}
    for shard in plan.shards:
        if shard.file in reports:
            samples[shard.split] += shard.samples
            worlds[shard.split].update(shard.numbers)
    missing = 0
    if not final.complete:
        # files of all shards may exist while some were not examined here
        missing = len(state.absent()) or len(plan.shards) - len(reports)
    return Summary(
        folder=plan.folder,
        complete=final.complete,
        samples=samples,
        worlds={split: len(numbers) for split, numbers in worlds.items()},
        rejected={subject: dict(counts) for subject, counts in final.rejected.items()},
        bytes=sum(report.size for report in reports.values()),
        shards=len(plan.shards),
        shards_missing=missing,
        samples_written=written,
        digest=final.digest,
    )
