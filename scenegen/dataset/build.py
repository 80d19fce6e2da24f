"""Build a dataset: plan its shards, find those that are there, have the rest written, and sign the whole."""

import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarsim import GridSpec, Sensor
from lidarsim.engines import ENGINES, MUJOCO
from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.sensor import write_rays
from scenegen.dataset.shard import ShardReport, ShardSpec, read_report, write_shard
from scenegen.errors import DatasetError, printable, short
from scenegen.files import disk_error, remove_drafts
from scenegen.limits import MOST_SAMPLES, MOST_SAMPLES_IN_SHARD, MOST_SEED, MOST_SHARDS
from scenegen.recipe import Recipe
from scenegen.source import Source
from scenegen.stopping import undone_if_stopped
from scenegen.workers import run

FULL_BYTES, COMPACT_BYTES = 80_000, 10_000
"""About what a sample of the default grid takes on disk; half of it may do."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A dataset to be: all its parameters, and its shards."""

    folder: Path
    parameters: dict[str, Any]
    shards: tuple[ShardSpec, ...]
    lidar: Sensor

    @property
    def samples(self) -> int:
        """In all splits."""
        return sum(shard.samples for shard in self.shards)

    @property
    def bytes_expected(self) -> int:
        """A rough size on disk."""
        voxels = math.prod(self.parameters["grid"]["shape"])
        each = FULL_BYTES if "tudf" in self.parameters["fields"] else COMPACT_BYTES
        return int(self.samples * each * voxels / math.prod(GridSpec().shape))


@dataclass(frozen=True, kw_only=True)
class Summary:
    """What a run did, and what is there now."""

    folder: Path
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
    folder: Path,
    recipe: Recipe,
    source: Source,
    *,
    seed: int,
    counts: Mapping[str, int],
    compact: bool = False,
    shard_samples: int = 100,
    engine: str = MUJOCO,
) -> Plan:
    """Divide `counts` (samples a split) into shards of about `shard_samples` samples, made of whole units.

    `engine` names what casts the rays; see `lidarsim.engines.ENGINES`. Raises DatasetError for an engine that is not to
    be had, and for numbers beyond those that readers take.
    """
    _check_asked("--seed", seed, 0, MOST_SEED)
    _check_asked("--shard-samples", shard_samples, 1, MOST_SAMPLES_IN_SHARD)
    for split, count in counts.items():
        _check_asked("--n" if split == "train" else f"--{split}", count, 0, MOST_SAMPLES)
    try:
        ENGINES.find(engine)
    except ValueError as error:
        raise DatasetError(printable(error)) from None
    given = manifest.parameters(
        recipe, source, seed=seed, counts=counts, compact=compact, shard_samples=shard_samples, engine=engine
    )
    fingerprint = manifest.fingerprint(given)
    each = recipe.flight.viewpoints
    step = max(shard_samples // each, 1)
    shards = []
    if sum(counts.values()) > MOST_SHARDS * step * each:
        raise DatasetError(
            f"{sum(counts.values())} samples in shards of {step * each}: too many files; raise --shard-samples"
        )
    for split in SPLITS:
        units = math.ceil(counts[split] / each)
        for index, first in enumerate(range(0, units, step)):
            here = min(step, units - first)
            shards.append(
                ShardSpec(
                    folder=folder,
                    split=split,
                    index=index,
                    first_unit=first,
                    units=here,
                    samples=min(here * each, counts[split] - first * each),
                    seed=seed,
                    compact=compact,
                    parameters=fingerprint,
                    recipe=recipe,
                    source=source,
                    engine=engine,
                )
            )
    return Plan(folder=folder, parameters=given, shards=tuple(shards), lidar=recipe.lidar)


def _check_asked(option: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise DatasetError(f"{option} {short(value)}: expected a whole number from {least} to {most}")


def build(
    plan: Plan,
    *,
    workers: int = 1,
    shard_range: tuple[int, int] | None = None,
    force: bool = False,
    on_start: Callable[[], None] = lambda: None,
    on_shard: Callable[[ShardReport, bool], None] = lambda report, fresh: None,
) -> Summary:
    """Make `plan`'s dataset, or go on with it, or, with `shard_range` (first, one past last), make a part of it.

    `workers` processes write; `force` replaces another dataset in the folder. `on_shard` is called for every
    shard that is there already (False) and for every one that is written (True), `on_start` once the workers run. A run
    that ends in any way leaves whole shards, and the next one goes on from there. The manifest is signed complete by
    the run that finds every shard.

    Raises DatasetError for a folder that holds something else, and what writing shards raises.
    """
    first, stop = shard_range or (0, len(plan.shards))
    check_folder(plan, force=force)
    begun = _is_begun(plan)
    known = {entry["file"]: entry for entry in manifest.read(plan.folder)["shards"]} if begun else {}
    reports = _look(plan, known, {}, verify=True) if begun else {}
    missing = [shard for shard in plan.shards[first:stop] if shard.file not in reports]
    _check_space(plan, missing)
    # kernels compile here, once, before workers start, and hopeless parameters end here, before anything is written
    if missing and (not begun or (len(missing) > 1 and workers > 1)):
        _first_unit(missing[0])
    _open_folder(plan, force=force)
    for report in reports.values():
        on_shard(report, False)
    written = 0
    with undone_if_stopped(lambda: remove_drafts(plan.folder)):
        try:
            with closing(run(write_shard, missing, workers, on_start)) as results:
                for report in results:
                    reports[plan.folder / report.file] = report
                    written += report.samples
                    on_shard(report, True)
        finally:
            remove_drafts(plan.folder)
    late = _look(plan, known, reports)
    while True:  # other runs may write shards meanwhile, and manifests: look again after every one of ours
        reports |= late
        ordered = [reports[shard.file] for shard in plan.shards if shard.file in reports]
        final = manifest.assemble(plan.parameters, ordered, complete=len(ordered) == len(plan.shards))
        if manifest.read(plan.folder) != final:
            manifest.write(plan.folder, final)
        late = _look(plan, known, reports)
        if not late:
            return _summarise(plan, ordered, final, written)


def _look(
    plan: Plan, known: Mapping[str, Mapping[str, Any]], seen: Mapping[Path, ShardReport], *, verify: bool = False
) -> dict[Path, ShardReport]:
    """Reports of the shards on disk that are not among those `seen`, and are as the manifest's entries `known` say."""
    found = {}
    for shard in plan.shards:
        if shard.file not in seen:
            report = read_report(shard, known.get(shard.file.name), verify=verify)
            if report is not None:
                found[shard.file] = report
    return found


def _first_unit(shard: ShardSpec) -> None:
    shard.draw(shard.first_unit)


def check_folder(plan: Plan, *, force: bool = False) -> None:
    """Raise DatasetError unless the plan's folder is free, or holds this dataset, or, with `force`, another one.

    A manifest without a shard, left by a run that drew none, stands in nobody's way.
    """
    folder = plan.folder
    try:
        if not folder.exists():
            return
    except OSError as error:
        raise disk_error(folder, error) from None
    if not folder.is_dir():
        raise DatasetError(f"{folder}: is a file, expected a folder; choose another one with --out")
    if not (folder / manifest.NAME).exists():
        others = [item.name for item in folder.iterdir() if not item.name.endswith(".tmp")]
        if others:
            raise DatasetError(
                f"{folder}: holds other files ({others[0]}, …) and no dataset; choose another folder with --out"
            )
        return
    there = manifest.read(folder)
    differing = manifest.differences(manifest.completed(there), plan.parameters)
    if differing and not force and _shard_files(folder):
        more = f" (and {len(differing) - 3} more)" if len(differing) > 3 else ""
        raise DatasetError(
            f"{folder}: holds another dataset: {'; '.join(differing[:3])}{more}; choose another folder with --out, or "
            "replace it with --force"
        )


def _is_begun(plan: Plan) -> bool:
    """Whether the plan's folder holds a manifest of this dataset."""
    if not (plan.folder / manifest.NAME).exists():
        return False
    there = manifest.read(plan.folder)
    return not manifest.differences(manifest.completed(there), plan.parameters)


def _open_folder(plan: Plan, *, force: bool) -> None:
    """Make the folder ready for the plan's shards. Nothing in it is touched unless it is this dataset's or `force`."""
    check_folder(plan, force=force)
    folder = plan.folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_drafts(folder)
    except OSError as error:
        raise disk_error(folder, error) from None
    same = _is_begun(plan)  # anew: another job may have begun it meanwhile
    if not same:
        # the new manifest comes first: shards that carry another fingerprint are not taken for its own
        manifest.write(folder, manifest.assemble(plan.parameters, [], complete=False))
    write_rays(plan.lidar, folder)
    planned = {path for shard in plan.shards for path in (shard.file, shard.worlds_file)}
    for file in _shard_files(folder):
        if not same or file not in planned:  # another dataset's, or left by a replacement that was killed
            file.unlink(missing_ok=True)


def _shard_files(folder: Path) -> list[Path]:
    """Files in `folder` that are named like a dataset's."""
    patterns = (f"{split}-{'[0-9]' * 5}{suffix}" for split in SPLITS for suffix in (".h5", ".worlds.zip"))
    return [file for pattern in patterns for file in folder.glob(pattern)]


def _check_space(plan: Plan, missing: list[ShardSpec]) -> None:
    """Raise DatasetError where the disk clearly cannot hold what is to be written."""
    if not missing:
        return
    needed = plan.bytes_expected * sum(shard.samples for shard in missing) / plan.samples
    there = next(place for place in (plan.folder, *plan.folder.absolute().parents) if place.exists())
    disk = shutil.disk_usage(there)
    if needed / 2 > disk.free and disk.total:  # the system's own folders have no size; they refuse by themselves
        raise DatasetError(
            f"{plan.folder}: needs about {needed / 1e6:.0f} MB, {disk.free / 1e6:.0f} MB are free; free some space, or "
            "choose another disk with --out"
        )
    if plan.folder.exists() and not os.access(plan.folder, os.W_OK):
        raise DatasetError(f"{plan.folder}: no permission to write there; choose another folder with --out")


def _summarise(plan: Plan, reports: list[ShardReport], final: Mapping[str, Any], written: int) -> Summary:
    samples: Counter[str] = Counter()
    worlds: dict[str, set[int]] = {split: set() for split in SPLITS}
    for report in reports:
        samples[report.split] += report.samples
    there = {report.file for report in reports}
    for shard in plan.shards:
        if shard.file.name not in there:
            continue
        worlds[shard.split].update(
            shard.source.number(shard.split, unit)[0]
            for unit in range(shard.first_unit, shard.first_unit + shard.units)
        )
    return Summary(
        folder=plan.folder,
        complete=final["complete"],
        samples={split: samples[split] for split in SPLITS},
        worlds={split: len(worlds[split]) for split in SPLITS},
        rejected=final["rejected"],
        bytes=sum(report.size for report in reports),
        shards=len(plan.shards),
        shards_missing=len(plan.shards) - len(reports),
        samples_written=written,
        digest=final["digest"],
    )
