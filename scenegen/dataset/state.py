"""A folder and the dataset that is to be in it: what is there, what is missing, and what the
manifest says of it."""

import contextlib
import json
import math
import sys
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lidarsim import Sensor
from scenegen import SPLITS
from scenegen.dataset import manifest, trust
from scenegen.dataset.parts import rays_named, tables_of, write_rays
from scenegen.dataset.placed import (
    find_reports,
    read_notes,
    relabel_at,
    remove_notes,
    report_at,
    write_note,
)
from scenegen.dataset.rules import FILE_RULE
from scenegen.dataset.shard import ARCHIVE, ShardReport, ShardTask, read_report
from scenegen.errors import BrokenError, DatasetError
from scenegen.files import Json, disk_told, open_bounded, remove_drafts
from scenegen.run.workers import run
from scenegen.stores import Place, Store, names_at, remove_at

FULL_BYTES, COMPACT_BYTES, RAY_BYTES = 0.3, 0.03, 3
"""About what a voxel and a ray take on disk; half of it may do."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A dataset to be: all its parameters, and its shards."""

    folder: Place
    parameters: Json
    shards: tuple[ShardTask, ...]
    lidars: tuple[Sensor, ...]
    """The sensors of its samples."""

    @property
    def samples(self) -> int:
        """In all splits."""
        return sum(shard.samples for shard in self.shards)

    @property
    def bytes_expected(self) -> int:
        """A rough size on disk."""
        each = FULL_BYTES if "tudf" in self.parameters["fields"] else COMPACT_BYTES
        voxels = self.samples * math.prod(self.parameters["grid"]["shape"])
        rays = sum(
            shard.samples * math.prod(shard.layout[name][1])
            for shard in self.shards
            for name in {"ranges", "earlier_ranges"} & shard.layout.keys()
        )
        return int(each * voxels + RAY_BYTES * rays)


class State:
    """The folder of a plan, as far as one run knows it.

    The manifest is read here, and again only where another job may have written one meanwhile:
    before this run's first shard, and before its signature. `force` allows another dataset in the
    folder, which `open` then replaces.

    Raises DatasetError unless the folder is free, or holds this dataset, or the beginning of it,
    or, with `force`, another one. A manifest without a shard, left by a run that drew none, stands
    in nobody's way.
    """

    def __init__(self, plan: Plan, *, force: bool = False):
        self.plan = plan
        self.reports: dict[str, ShardReport] = {}
        """What is known of every shard that is there, by its file."""
        self._force = force
        self._smaller: trust.Manifest | None = None
        """The dataset that this one begins with, as far as the folder holds it."""
        self._there: Mapping[str, int | None] | None = None
        """What lies there, if that was just listed."""
        self._written: Json = {}
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
        return whole and _text(self._written) == _text(self._final())

    def _final(self) -> Json:
        """The manifest of what is known."""
        return manifest.assemble(
            self.plan.parameters,
            self.reports_of(self.plan.shards),
            complete=len(self.reports) == len(self.plan.shards),
        )

    def _read(self) -> Mapping[str, trust.Entry] | None:
        """The shards that the manifest of this dataset lists, by file; None where there is none."""
        folder = self.plan.folder
        with disk_told(folder):
            try:
                self._there = names_at(folder)
            except FileNotFoundError:
                return None
            except NotADirectoryError:
                raise DatasetError(
                    f"{folder}: is a file, expected a folder; choose another one with --out"
                ) from None
        names = sorted(name for name in self._there if not name.endswith(".tmp"))
        if not names:
            return None
        if manifest.NAME not in names:
            found_here = (shard for shard in self.plan.shards if shard.file in names)
            if any(shard.tells and report_at(folder, (shard, None)) for shard in found_here):
                return {}  # the manifest alone was lost
            raise DatasetError(
                f"{folder}: holds files ({names[0]}, …), but no {manifest.NAME} and no sound "
                "shard of this dataset; choose another folder with --out"
            )
        self._written = manifest.read(folder)
        differing = manifest.differences(
            manifest.completed(self._written), manifest.completed(self.plan.parameters)
        )
        former: trust.Manifest | None = None
        with contextlib.suppress(BrokenError):
            former = trust.parse(self._written, Path(str(folder)))
        if not differing:
            # if what it says of its shards is damaged, they are held against their own digests
            return {} if former is None else {entry.file: entry for entry in former.shards}
        if former is not None and all(line.startswith("counts.") for line in differing):
            counts = self.plan.parameters["counts"]
            if all(former.counts[split] <= counts[split] for split in SPLITS):
                self._smaller = former
                return {}
        if not self._force and any(map(FILE_RULE.fits, names)):
            more = f" (and {len(differing) - 3} more)" if len(differing) > 3 else ""
            raise DatasetError(
                f"{folder}: holds another dataset: {'; '.join(differing[:3])}{more}; choose "
                "another folder with --out, or replace it with --force"
            )
        return None

    def adopt(self) -> None:
        """Make the shards of a smaller dataset this one's: they hold the same samples, and say of
        how many they are.

        A run that is killed on the way goes on, whichever of the two its manifest describes.
        """
        if self._smaller is None:
            return
        old = self._smaller.fingerprint
        listed = {entry.file: entry for entry in self._smaller.shards}
        for shard in self.plan.shards:
            entry = listed.get(shard.file)
            if entry is not None and entry.samples == shard.samples:
                relabel_at(self.plan.folder, shard, old, entry)
        self._there = None
        self.look(self.plan.shards)
        self.note()
        self._smaller = None

    def look(self, shards: Sequence[ShardTask], *, workers: int = 1) -> None:
        """Take in those of `shards` that are on disk, are not known yet, and are as the manifest
        says.

        The samples of those that it does not list are held against their own digests. Each worker
        reads its part.
        """
        if self._listed is None:
            return
        folder = self.plan.folder
        there = names_at(folder) if self._there is None else self._there
        self._there, listed = None, dict(self._listed)
        if isinstance(folder, Path):
            listed = read_notes(folder, manifest.fingerprint(self.plan.parameters)) | listed
        tasks = [
            (shard, listed.get(shard.file))
            for shard in shards
            if shard.file not in self.reports and shard.file in there
        ]
        reports = (
            find_reports(folder, there, tasks)
            if isinstance(folder, Store)
            else run(partial(read_report, folder), tasks, workers)
        )
        self.reports |= {report.file: report for report in reports if report is not None}

    def open(self) -> None:
        """Make the folder ready for shards, if it lacks any, and touch nothing but the dataset that
        `force` replaces.

        Raises DatasetError where a file stands in the way that is of neither.
        """
        if not self.done:
            self._begin()
        write_rays(self.plan.lidars, self.plan.folder)

    def _begin(self) -> None:
        folder = self.plan.folder
        with disk_told(folder):
            if isinstance(folder, Path):
                folder.mkdir(parents=True, exist_ok=True)
            # listed first: what comes later is another job's, and this dataset's
            there = names_at(folder).keys()
            self._listed, self._there = self._read(), None
            self.clear()
        if not self.begun:
            former = _former(folder, there)
            planned = {name for shard in self.plan.shards for name in (shard.file, shard.worlds)}
            planned |= tables_of(self.plan.lidars).keys()
            for name in sorted(planned & there - set(former)):
                raise DatasetError(
                    f"{folder}/{name}: is of no dataset there; move it away, or choose another "
                    f"--out"
                )
            for name in former:  # before the manifest that says whose they are
                remove_at(folder, name)
            self._remove_notes()
        if not self.begun or manifest.NAME not in there:
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

    def note(self, mine: Sequence[ShardTask] | None = None) -> None:
        """Write down the shards that are known, for a run that is stopped: the next one hashes
        their files, and not their samples. The manifest lists them; those of a job that sees to
        `mine` alone stand in a file of its own."""
        if mine is not None and len(mine) < len(self.plan.shards):
            if isinstance(self.plan.folder, Path):  # at a store, a report lies beside each shard
                parameters = manifest.fingerprint(self.plan.parameters)
                files = [shard.file for shard in mine]
                write_note(self.plan.folder, parameters, files, self.reports_of(mine))
            return
        manifest.write(self.plan.folder, self._final())

    def sign(self, *, workers: int = 1) -> Json:
        """Write the manifest, complete if no shard is missing; the manifest.

        Other jobs may write shards meanwhile, and manifests. The one that finds a file of every
        shard looks at all of them; others leave what is not theirs alone, but look again once they
        have written. A job whose shards are all in a complete manifest already is done.
        """
        if self.done:
            self._remove_notes()
            return dict(self._written)
        while True:
            if len(self.reports) < len(self.plan.shards) and self._is_signed(
                there := manifest.read(self.plan.folder)
            ):
                return there
            if whole := not self.absent():
                self.look(self.plan.shards, workers=workers)
            final = self._final()
            if _text(manifest.read(self.plan.folder)) != _text(final):
                manifest.write(self.plan.folder, final)
            if final["complete"]:
                self._remove_notes()
            if whole or self.absent():
                return final

    def _is_signed(self, there: Json) -> bool:
        """Whether the manifest `there` is complete, and lists what is known just so."""
        if (
            there.get("complete") is not True
            or manifest.parameters_of(there) != self.plan.parameters
        ):
            return False
        listed = {entry.get("file"): entry for entry in there["shards"] if isinstance(entry, dict)}
        return all(listed.get(report.file) == report.entry() for report in self.reports.values())

    def absent(self) -> list[ShardTask]:
        """Shards that are neither known nor on disk."""
        there = self.reports.keys() | names_at(self.plan.folder).keys()
        return [shard for shard in self.plan.shards if shard.file not in there]

    def reports_of(self, shards: Sequence[ShardTask]) -> list[ShardReport]:
        """The reports of those of `shards` that are known, in their order."""
        return [self.reports[shard.file] for shard in shards if shard.file in self.reports]


def _text(there: Json) -> str:
    """A manifest to compare with another one: to Python, false is 0 and 1.0 is 1."""
    return json.dumps(there, sort_keys=True)


def _former(folder: Place, names: Set[str]) -> list[str]:
    """Those of the `names` in `folder` that are of the dataset whose manifest lies there: its
    tables of rays, the shards that it lists, and those not listed yet, which carry its fingerprint,
    or that of one of its sources. In an order that can be gone on with: worlds come before their
    samples, which hold their digest."""
    if manifest.NAME not in names:
        return []
    there, found = manifest.read(folder), set[str]()
    owners = [manifest.fingerprint(manifest.parameters_of(there))]
    with contextlib.suppress(BrokenError, LookupError, TypeError):
        # first: it needs no more of a damaged manifest than its sensors
        found |= names & set(rays_named(there).values())
        former = trust.parse(there, Path(str(folder)))
        found |= names & former.files.keys()
        owners += [source.fingerprint for source in former.sources]
    for name in filter(FILE_RULE.fits, sorted(names - found)):
        if isinstance(folder, Store):
            content = folder.read(name, sys.maxsize - 1)
        else:
            with open_bounded(folder / name, sys.maxsize) as file:
                content = file.read()
        samples = name.replace(".worlds.zip", ".h5")
        if name == samples:
            known = any(owner.encode() in content for owner in owners)
        elif samples in names:
            known = samples in found
        else:  # whose writer was killed before it put the samples beside them
            known = content.startswith(ARCHIVE)
        if known:
            found.add(name)
    return sorted(found, reverse=True)
