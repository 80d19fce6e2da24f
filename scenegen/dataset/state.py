"""State of a dataset's folder: existing shards, missing ones, and what the manifest lists."""

import contextlib
import math
import sys
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec

from scenegen import SPLITS
from scenegen.base.errors import DatasetError
from scenegen.base.files import disk_errors, remove_temp_files
from scenegen.base.stores import Location, Store, names_at, read_at, remove_at
from scenegen.base.workers import run
from scenegen.dataset import manifest
from scenegen.dataset.manifest import Manifest, total_digest
from scenegen.dataset.parameters import RAYS, differences, rays_digest, write_rays
from scenegen.dataset.placed import (
    find_reports,
    read_notes,
    remove_notes,
    report_at,
    write_note,
)
from scenegen.dataset.schema import NAME, SHARD_FILE, ShardEntry
from scenegen.dataset.shard import ARCHIVE, ShardReport, ShardSpec, read_report

FULL_BYTES, COMPACT_BYTES, RAY_BYTES = 0.3, 0.03, 3
"""Approximate bytes on disk of a voxel (of a full or compact dataset) and of a ray. The true size
may be half."""


@dataclass(frozen=True, kw_only=True)
class DatasetPlan:
    """A dataset to make: its manifest without shards, and its shards."""

    folder: Location
    manifest: Manifest
    shards: tuple[ShardSpec, ...]

    @property
    def name(self) -> str:
        """Last part of its folder's path."""
        return Path(str(self.folder)).name

    @property
    def samples(self) -> int:
        """Number of samples in all splits."""
        return sum(shard.samples for shard in self.shards)

    @property
    def bytes_expected(self) -> int:
        """Rough size on disk, bytes."""
        voxel_bytes = FULL_BYTES if "tudf" in self.manifest.fields else COMPACT_BYTES
        schema = self.manifest.schema
        rays = sum(
            math.prod(schema.shape(name)) for name in {"ranges", "earlier_ranges"} & {*schema.names}
        )
        voxels = math.prod(schema.grid.shape)
        return int(self.samples * (voxel_bytes * voxels + RAY_BYTES * rays))


class State:
    """State of a plan's folder in one run.

    The manifest is read at first, and again only where another job may have written it: before this
    run's first shard, and before the manifest is completed.

    Args:
        plan: The plan.
        force: Whether another dataset in the folder is accepted. `open` replaces it.

    Raises:
        DatasetError: unless the folder is free, or holds this dataset, the same with fewer samples,
            or a manifest without shards.
    """

    def __init__(self, plan: DatasetPlan, *, force: bool = False):
        self.plan = plan
        self.reports: dict[str, ShardReport] = {}
        """Reports of the known shards, by file."""
        self._force = force
        self._names: Mapping[str, int | None] | None = None
        """Names in the folder, if they were just listed."""
        self._content = b""
        """The manifest when it was read."""
        self._listed = self._read()

    @property
    def begun(self) -> bool:
        """Whether the folder holds a manifest of this dataset."""
        return self._listed is not None

    @property
    def is_complete(self) -> bool:
        """Whether every shard is known, and the manifest says so."""
        is_complete = len(self.reports) == len(self.plan.shards)
        return is_complete and self._content == manifest.encode(self.current())

    def current(self) -> Manifest:
        """Manifest with the known shards."""
        reports = self.reports_of(self.plan.shards)
        complete = len(reports) == len(self.plan.shards)
        rejected = {}
        for subject in ("worlds", "viewpoints"):
            counts = sum((Counter(report.rejected[subject]) for report in reports), Counter[str]())
            # sorted: the manifest's bytes must not depend on which job wrote which shard
            rejected[subject] = dict(sorted(counts.items()))
        return msgspec.structs.replace(
            self.plan.manifest,
            complete=complete,
            shards=tuple(report.entry for report in reports),
            rejected=rejected,
            digest=total_digest([report.digests for report in reports]) if complete else None,
        )

    def _read(self) -> Mapping[str, ShardEntry] | None:
        """Entries of the shards that this dataset's manifest lists, by file; None if there is no
        such manifest."""
        folder = self.plan.folder
        with disk_errors(folder):
            try:
                self._names = names_at(folder)
            except FileNotFoundError:
                return None
            except NotADirectoryError:
                raise DatasetError(
                    f"{folder}: is a file, expected a folder; choose another one with --out"
                ) from None
        names = sorted(name for name in self._names if not name.endswith(".tmp"))
        if not names:
            return None
        if NAME not in names:
            if self._has_shards_among(names):
                return {}  # the manifest alone was lost
            raise DatasetError(
                f"{folder}: holds files ({names[0]}, …), but no {NAME} and no sound "
                "shard of this dataset; choose another folder with --out"
            )
        self._content = manifest.read_content(folder)
        try:
            existing = manifest.parse(self._content, Path(str(folder)))
        except DatasetError as error:
            if self._has_shards_among(names):
                return {}  # the manifest alone is damaged
            if self._force:
                return None
            raise DatasetError(
                f"{folder}/{NAME}: {error}; choose another folder with --out, or replace "
                f"the dataset with --force"
            ) from None
        differing = differences(existing.parameters, self.plan.manifest.parameters)
        # a dataset with more samples keeps all shards of the smaller one
        grows = all(line.startswith("counts.") for line in differing) and all(
            existing.counts[split] <= self.plan.manifest.counts[split] for split in SPLITS
        )
        if grows:
            return {entry.file: entry for entry in existing.shards}
        if not self._force and any(map(SHARD_FILE.fullmatch, names)):
            unlisted = f" (and {len(differing) - 3} more)" if len(differing) > 3 else ""
            raise DatasetError(
                f"{folder}: holds another dataset: {'; '.join(differing[:3])}{unlisted}; choose "
                "another folder with --out, or replace it with --force"
            )
        return None

    def _has_shards_among(self, names: Sequence[str]) -> bool:
        """Whether one of the files `names` is a valid shard of this dataset."""
        candidates = (shard for shard in self.plan.shards if shard.file in names)
        return any(report_at(self.plan.folder, (shard, None)) for shard in candidates)

    def look(self, shards: Sequence[ShardSpec], *, workers: int = 1) -> None:
        """Find existing shards that are not known yet, and are valid.

        Listed shards are compared with the sums in the manifest, others with the digests of their
        samples.

        Args:
            shards: The shards to look for.
            workers: Number of processes that read them.
        """
        if self._listed is None:
            return
        folder = self.plan.folder
        names = names_at(folder) if self._names is None else self._names
        # a listing serves once, as other jobs write meanwhile
        self._names, listed = None, dict(self._listed)
        if isinstance(folder, Path):
            # the manifest takes precedence over notes of jobs
            listed = read_notes(folder, self.plan.manifest.fingerprint) | listed
        tasks = [
            (shard, listed.get(shard.file))
            for shard in shards
            if shard.file not in self.reports and shard.file in names
        ]
        reports = (
            find_reports(folder, names, tasks)
            if isinstance(folder, Store)
            else run(partial(read_report, folder), tasks, workers)
        )
        self.reports |= {report.entry.file: report for report in reports if report is not None}

    def open(self) -> None:
        """Prepare the folder for shards if some are missing. Only the dataset that `force` replaces
        is removed.

        Raises DatasetError if another file has the name of a planned one.
        """
        if not self.is_complete:
            self._begin()
        write_rays(self.plan.manifest.recipe.lidar, self.plan.folder)

    def _begin(self) -> None:
        folder = self.plan.folder
        with disk_errors(folder):
            if isinstance(folder, Path):
                folder.mkdir(parents=True, exist_ok=True)
            # listed before the manifest is read: files that appear later belong to this dataset
            names = names_at(folder).keys()
            # read again, as another job may have begun the dataset meanwhile
            self._listed, self._names = self._read(), None
            self.clear()
        if not self.begun:
            existing = _former_files(folder, names)
            planned = {name for shard in self.plan.shards for name in (shard.file, shard.worlds)}
            planned |= rays_digest(self.plan.manifest.tables.lidar).keys()
            for name in sorted(planned & names - set(existing)):
                raise DatasetError(
                    f"{folder}/{name}: is of no dataset there; move it away, or choose another "
                    f"--out"
                )
            for name in existing:  # before the manifest, which is needed to identify them
                remove_at(folder, name)
            self._remove_notes()
        if not self.begun or NAME not in names:
            self.note()
            self._listed = self._listed or {}
        if isinstance(folder, Path):
            with disk_errors(folder):
                # made once here, and not by every worker
                for part in {shard.file.rpartition("/")[0] for shard in self.plan.shards}:
                    (folder / part).mkdir(exist_ok=True)

    def clear(self) -> None:
        """Remove temporary files of killed processes. Stores have none."""
        if isinstance(self.plan.folder, Path):
            remove_temp_files(self.plan.folder)

    def _remove_notes(self) -> None:
        if isinstance(self.plan.folder, Path):
            remove_notes(self.plan.folder)

    def note(self, mine: Sequence[ShardSpec] | None = None) -> None:
        """Record the known shards for the next run, which then compares sums of files instead of
        digests of samples.

        They are recorded in the manifest, or, for a job with only the shards `mine`, in its own
        note.
        """
        if mine is not None and len(mine) < len(self.plan.shards):
            if isinstance(self.plan.folder, Path):  # a store has a report beside each shard instead
                files = [shard.file for shard in mine]
                fingerprint = self.plan.manifest.fingerprint
                write_note(self.plan.folder, fingerprint, files, self.reports_of(mine))
            return
        manifest.write(self.plan.folder, self.current())

    def sign(self, *, workers: int = 1) -> Manifest:
        """Write the manifest, which is complete if no shard is missing.

        Other jobs may write shards and manifests meanwhile. A job that finds all files examines all
        shards; other jobs only list their own, and check again after writing. If a complete
        manifest already lists all shards of this job, nothing is written.
        """
        if self.is_complete:
            self._remove_notes()
            return self.current()
        while True:
            # in a loop: jobs that finish at the same time could each miss the last shard of the
            # other
            content = manifest.read_content(self.plan.folder)
            if len(self.reports) < len(self.plan.shards) and (signed := self._signed(content)):
                return signed
            if all_exist := not self.absent():
                self.look(self.plan.shards, workers=workers)
            final = self.current()
            if manifest.read_content(self.plan.folder) != manifest.encode(final):
                manifest.write(self.plan.folder, final)
            if final.complete:
                self._remove_notes()
            if all_exist or self.absent():
                return final

    def _signed(self, content: bytes) -> Manifest | None:
        """Parse a manifest. Returns it if it is this dataset's, complete, and consistent with the
        known shards."""
        with contextlib.suppress(DatasetError):
            stored = manifest.parse(content)
            listed = {entry.file: entry for entry in stored.shards}
            known = (report.entry for report in self.reports.values())
            if (
                stored.complete
                and stored.parameters == self.plan.manifest.parameters
                and all(listed.get(entry.file) == entry for entry in known)
            ):
                return stored
        return None

    def absent(self) -> list[ShardSpec]:
        """Shards that are neither known nor on disk."""
        names = self.reports.keys() | names_at(self.plan.folder).keys()
        return [shard for shard in self.plan.shards if shard.file not in names]

    def reports_of(self, shards: Sequence[ShardSpec]) -> list[ShardReport]:
        """Reports of the known ones among `shards`, in order."""
        return [self.reports[shard.file] for shard in shards if shard.file in self.reports]


def _former_files(folder: Location, names: Set[str]) -> list[str]:
    """Files of the dataset whose manifest is in the folder: its table of rays, listed shards, and
    unlisted shards with its fingerprint; all shards if the manifest cannot be read.

    Archives come before the samples that name their digest, so that an interrupted removal can
    continue.
    """
    if NAME not in names:
        return []
    shards = {name for name in names if SHARD_FILE.fullmatch(name)}
    try:
        existing = manifest.parse(manifest.read_content(folder))
    except DatasetError:
        return sorted({*shards, *({RAYS} & names)}, reverse=True)
    # a listed file is this dataset's by name, even if it is damaged
    owned = names & existing.files.keys()
    for name in sorted(shards - owned):
        # one less than the greatest, as stores ask for one byte more than the limit
        content = read_at(folder, name, sys.maxsize - 1)
        samples = name.replace(".worlds.zip", ".h5")
        if name == samples:
            is_owned = existing.fingerprint.encode() in content
        elif samples in names:
            is_owned = samples in owned
        else:  # an archive without samples: its writer was killed in between
            is_owned = content.startswith(ARCHIVE)
        if is_owned:
            owned.add(name)
    return sorted(owned, reverse=True)
