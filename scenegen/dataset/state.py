"""A folder and the dataset that is to be in it: what is there, what is missing, and what the manifest says of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarsim import GridSpec, Sensor
from scenegen import SPLITS
from scenegen.dataset import manifest, trust
from scenegen.dataset.sensor import write_rays
from scenegen.dataset.shard import ShardReport, ShardSpec, read_report
from scenegen.errors import BrokenError, DatasetError
from scenegen.files import disk_error, remove_drafts

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


class State:
    """The folder of a plan, as far as one run knows it.

    The manifest is read here, and again only where another job may have written one meanwhile: before this run's first
    shard, and before its signature. `force` allows another dataset in the folder, which `open` then replaces.

    Raises DatasetError unless the folder is free, or holds this dataset, or, with `force`, another one. A manifest
    without a shard, left by a run that drew none, stands in nobody's way.
    """

    def __init__(self, plan: Plan, *, force: bool = False):
        self.plan = plan
        self.reports: dict[Path, ShardReport] = {}
        """What is known of every shard that is there, by its file."""
        self._force = force
        self._listed = self._read()

    @property
    def begun(self) -> bool:
        """Whether the folder holds a manifest of this dataset."""
        return self._listed is not None

    def _read(self) -> Mapping[str, trust.Entry] | None:
        """The shards that the manifest of this dataset lists, by file; None where there is none."""
        folder = self.plan.folder
        try:
            if not folder.exists():
                return None
        except OSError as error:
            raise disk_error(folder, error) from None
        if not folder.is_dir():
            raise DatasetError(f"{folder}: is a file, expected a folder; choose another one with --out")
        # listed first: what another job begins meanwhile, it begins with a manifest
        others = [item.name for item in folder.iterdir() if not item.name.endswith(".tmp")]
        if not (folder / manifest.NAME).exists():
            if others:
                raise DatasetError(
                    f"{folder}: holds other files ({others[0]}, …) and no dataset; choose another folder with --out"
                )
            return None
        there = manifest.read(folder)
        differing = manifest.differences(manifest.completed(there), manifest.completed(self.plan.parameters))
        if not differing:
            try:
                return {entry.file: entry for entry in trust.parse(there, folder).shards}
            except BrokenError:  # what it says of its shards is damaged: they are held against their own digests
                return {}
        if not self._force and _shard_files(folder):
            more = f" (and {len(differing) - 3} more)" if len(differing) > 3 else ""
            raise DatasetError(
                f"{folder}: holds another dataset: {'; '.join(differing[:3])}{more}; choose another folder with --out, "
                "or replace it with --force"
            )
        return None

    def look(self, *, verify: bool = False) -> bool:
        """Take in the shards on disk that are not known yet and are as the manifest says; whether there are any.

        `verify` holds the samples of those that it does not list against their own digests.
        """
        if self._listed is None:
            return False
        known = len(self.reports)
        for shard in self.plan.shards:
            if shard.file not in self.reports:
                report = read_report(shard, self._listed.get(shard.file.name), verify=verify)
                if report is not None:
                    self.reports[shard.file] = report
        return len(self.reports) > known

    def open(self) -> None:
        """Make the folder ready for shards. Nothing in it is touched unless it is this dataset's or `force`."""
        folder = self.plan.folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            there = _shard_files(folder)  # listed first: what comes later is another job's, and this dataset's
            self._listed = self._read()
            remove_drafts(folder)
        except OSError as error:
            raise disk_error(folder, error) from None
        begun = self.begun
        if not begun:
            # the new manifest comes first: shards that carry another fingerprint are not taken for its own
            manifest.write(folder, manifest.assemble(self.plan.parameters, [], complete=False))
            self._listed = {}
        write_rays(self.plan.lidar, folder)
        planned = {path for shard in self.plan.shards for path in (shard.file, shard.worlds_file)}
        for file in there:
            if not begun or file not in planned:  # another dataset's, or left by a replacement that was killed
                file.unlink(missing_ok=True)

    def sign(self) -> dict[str, Any]:
        """Write the manifest of all shards that are there, complete if none is missing; the manifest.

        Other runs may write shards meanwhile, and manifests: each manifest of this one is followed by another look.
        """
        self.look()
        while True:
            ordered = [self.reports[shard.file] for shard in self.plan.shards if shard.file in self.reports]
            whole = len(ordered) == len(self.plan.shards)
            final = manifest.assemble(self.plan.parameters, ordered, complete=whole)
            if manifest.read(self.plan.folder) != final:
                manifest.write(self.plan.folder, final)
            if not self.look():
                return final


def _shard_files(folder: Path) -> list[Path]:
    """Files in `folder` that are named like a dataset's."""
    patterns = (f"{split}-{'[0-9]' * 5}{suffix}" for split in SPLITS for suffix in (".h5", ".worlds.zip"))
    return [file for pattern in patterns for file in folder.glob(pattern)]
