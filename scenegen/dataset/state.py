"""A folder and the dataset that is to be in it: what is there, what is missing, and what the
manifest says of it."""

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
from scenegen.base.files import disk_told, remove_drafts
from scenegen.base.stores import Place, Store, names_at, read_at, remove_at
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
"""About what a voxel and a ray take on disk; half of it may do."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A dataset to be: its manifest without shards, and the shards that it is to have."""

    folder: Place
    manifest: Manifest
    shards: tuple[ShardSpec, ...]

    @property
    def name(self) -> str:
        """The last part of its folder's name."""
        return Path(str(self.folder)).name

    @property
    def samples(self) -> int:
        """In all splits."""
        return sum(shard.samples for shard in self.shards)

    @property
    def bytes_expected(self) -> int:
        """A rough size on disk."""
        each = FULL_BYTES if "tudf" in self.manifest.fields else COMPACT_BYTES
        schema = self.manifest.schema
        rays = sum(
            math.prod(schema.shape(name)) for name in {"ranges", "earlier_ranges"} & {*schema.names}
        )
        voxels = math.prod(schema.grid.shape)
        return int(self.samples * (each * voxels + RAY_BYTES * rays))


class State:
    """The folder of a plan, as far as one run knows it.

    The manifest is read here, and again only where another job may have written one meanwhile:
    before this run's first shard, and before its signature. `force` allows another dataset in the
    folder, which `open` then replaces.

    Raises DatasetError unless the folder is free, or holds this dataset, or one that is the same
    but for fewer samples, or, with `force`, another one. A manifest without a shard, left by a run
    that drew none, stands in nobody's way.
    """

    def __init__(self, plan: Plan, *, force: bool = False):
        self.plan = plan
        self.reports: dict[str, ShardReport] = {}
        """What is known of every shard that is there, by its file."""
        self._force = force
        self._names: Mapping[str, int | None] | None = None
        """What lies in the folder, if that was just listed."""
        self._content = b""
        """The manifest as it was read."""
        self._listed = self._read()

    @property
    def begun(self) -> bool:
        """Whether the folder holds a manifest of this dataset."""
        return self._listed is not None

    @property
    def done(self) -> bool:
        """Whether every shard is known, and the manifest that was read says just that."""
        whole = len(self.reports) == len(self.plan.shards)
        return whole and self._content == manifest.encode(self.current())

    def current(self) -> Manifest:
        """The manifest of the shards that are known."""
        reports = self.reports_of(self.plan.shards)
        complete = len(reports) == len(self.plan.shards)
        rejected = {}
        for what in ("worlds", "viewpoints"):
            counts = sum((Counter(report.rejected[what]) for report in reports), Counter[str]())
            rejected[what] = dict(sorted(counts.items()))
        return msgspec.structs.replace(
            self.plan.manifest,
            complete=complete,
            shards=tuple(report.entry for report in reports),
            rejected=rejected,
            digest=total_digest([report.digests for report in reports]) if complete else None,
        )

    def _read(self) -> Mapping[str, ShardEntry] | None:
        """The shards that the manifest of this dataset lists, by file; None where there is none."""
        folder = self.plan.folder
        with disk_told(folder):
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
            former = manifest.parse(self._content, Path(str(folder)))
        except DatasetError as error:
            if self._has_shards_among(names):
                return {}  # the manifest alone is damaged
            if self._force:
                return None
            raise DatasetError(
                f"{folder}/{NAME}: {error}; choose another folder with --out, or replace "
                f"the dataset with --force"
            ) from None
        differing = differences(former.parameters, self.plan.manifest.parameters)
        grows = all(line.startswith("counts.") for line in differing) and all(
            former.counts[split] <= self.plan.manifest.counts[split] for split in SPLITS
        )
        if grows:
            return {entry.file: entry for entry in former.shards}
        if not self._force and any(map(SHARD_FILE.fullmatch, names)):
            more = f" (and {len(differing) - 3} more)" if len(differing) > 3 else ""
            raise DatasetError(
                f"{folder}: holds another dataset: {'; '.join(differing[:3])}{more}; choose "
                "another folder with --out, or replace it with --force"
            )
        return None

    def _has_shards_among(self, names: Sequence[str]) -> bool:
        """Whether one of the files `names` is a sound shard of this dataset."""
        planned_here = (shard for shard in self.plan.shards if shard.file in names)
        return any(report_at(self.plan.folder, (shard, None)) for shard in planned_here)

    def look(self, shards: Sequence[ShardSpec], *, workers: int = 1) -> None:
        """Take in those of `shards` that are on disk, are not known yet, and are as the manifest
        says.

        The samples of those that it does not list are held against their own digests. Each worker
        reads its part.
        """
        if self._listed is None:
            return
        folder = self.plan.folder
        names = names_at(folder) if self._names is None else self._names
        self._names, listed = None, dict(self._listed)
        if isinstance(folder, Path):
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
        """Make the folder ready for shards, if it lacks any, and touch nothing but the dataset that
        `force` replaces.

        Raises DatasetError where a file stands in the way that is of neither.
        """
        if not self.done:
            self._begin()
        write_rays(self.plan.manifest.recipe.lidar, self.plan.folder)

    def _begin(self) -> None:
        folder = self.plan.folder
        with disk_told(folder):
            if isinstance(folder, Path):
                folder.mkdir(parents=True, exist_ok=True)
            # listed first: what comes later is another job's, and this dataset's
            names = names_at(folder).keys()
            self._listed, self._names = self._read(), None
            self.clear()
        if not self.begun:
            former = _former_files(folder, names)
            planned = {name for shard in self.plan.shards for name in (shard.file, shard.worlds)}
            planned |= rays_digest(self.plan.manifest.tables.lidar).keys()
            for name in sorted(planned & names - set(former)):
                raise DatasetError(
                    f"{folder}/{name}: is of no dataset there; move it away, or choose another "
                    f"--out"
                )
            for name in former:  # before the manifest that says whose they are
                remove_at(folder, name)
            self._remove_notes()
        if not self.begun or NAME not in names:
            self.note()
            self._listed = self._listed or {}
        if isinstance(folder, Path):
            with disk_told(folder):
                for part in {shard.file.rpartition("/")[0] for shard in self.plan.shards}:
                    (folder / part).mkdir(exist_ok=True)

    def clear(self) -> None:
        """Remove what killed processes left behind; at a store, objects are complete or absent."""
        if isinstance(self.plan.folder, Path):
            remove_drafts(self.plan.folder)

    def _remove_notes(self) -> None:
        if isinstance(self.plan.folder, Path):
            remove_notes(self.plan.folder)

    def note(self, mine: Sequence[ShardSpec] | None = None) -> None:
        """Write down the shards that are known, for a run that is stopped: the next one hashes
        their files, and not their samples. The manifest lists them; those of a job that sees to
        `mine` alone stand in a file of its own."""
        if mine is not None and len(mine) < len(self.plan.shards):
            if isinstance(self.plan.folder, Path):  # at a store, a report lies beside each shard
                files = [shard.file for shard in mine]
                fingerprint = self.plan.manifest.fingerprint
                write_note(self.plan.folder, fingerprint, files, self.reports_of(mine))
            return
        manifest.write(self.plan.folder, self.current())

    def sign(self, *, workers: int = 1) -> Manifest:
        """Write the manifest, complete if no shard is missing; the manifest.

        Other jobs may write shards meanwhile, and manifests. The one that finds a file of every
        shard looks at all of them; others leave what is not theirs alone, but look again once they
        have written. A job whose shards are all in a complete manifest already is done.
        """
        if self.done:
            self._remove_notes()
            return self.current()
        while True:
            content = manifest.read_content(self.plan.folder)
            if len(self.reports) < len(self.plan.shards) and (signed := self._signed(content)):
                return signed
            if whole := not self.absent():
                self.look(self.plan.shards, workers=workers)
            final = self.current()
            if manifest.read_content(self.plan.folder) != manifest.encode(final):
                manifest.write(self.plan.folder, final)
            if final.complete:
                self._remove_notes()
            if whole or self.absent():
                return final

    def _signed(self, content: bytes) -> Manifest | None:
        """The manifest in `content`, if it is this dataset's, complete, and lists what is known
        just so."""
        with contextlib.suppress(DatasetError):
            there = manifest.parse(content)
            listed = {entry.file: entry for entry in there.shards}
            known = (report.entry for report in self.reports.values())
            if (
                there.complete
                and there.parameters == self.plan.manifest.parameters
                and all(listed.get(entry.file) == entry for entry in known)
            ):
                return there
        return None

    def absent(self) -> list[ShardSpec]:
        """Shards that are neither known nor on disk."""
        names = self.reports.keys() | names_at(self.plan.folder).keys()
        return [shard for shard in self.plan.shards if shard.file not in names]

    def reports_of(self, shards: Sequence[ShardSpec]) -> list[ShardReport]:
        """The reports of those of `shards` that are known, in their order."""
        return [self.reports[shard.file] for shard in shards if shard.file in self.reports]


def _former_files(folder: Place, names: Set[str]) -> list[str]:
    """Those of the `names` in `folder` that are of the dataset whose manifest lies there: its table
    of rays, the shards that it lists, and those not listed yet, which carry its fingerprint; every
    shard where the manifest cannot be read. In an order that can be gone on with: worlds come
    before their samples, which hold their digest."""
    if NAME not in names:
        return []
    shards = {name for name in names if SHARD_FILE.fullmatch(name)}
    try:
        former = manifest.parse(manifest.read_content(folder))
    except DatasetError:
        return sorted({*shards, *({RAYS} & names)}, reverse=True)
    owned = names & former.files.keys()
    for name in sorted(shards - owned):
        content = read_at(folder, name, sys.maxsize - 1)
        samples = name.replace(".worlds.zip", ".h5")
        if name == samples:
            is_owned = former.fingerprint.encode() in content
        elif samples in names:
            is_owned = samples in owned
        else:  # whose writer was killed before it put the samples beside them
            is_owned = content.startswith(ARCHIVE)
        if is_owned:
            owned.add(name)
    return sorted(owned, reverse=True)
