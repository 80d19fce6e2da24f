"""What checks are handed at each stage. What several of them need is computed here, once."""

import functools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import BufferedReader
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import Engine, ObservedGrid, Pose, Scan, fuse
from lidarsim.engines import ENGINES
from lidarsim.solids.shapes import Solids
from scenegen.dataset.layout import ShardFile
from scenegen.dataset.trust import Entry, GatheredEntry
from scenegen.verification.contract import (
    Archive,
    Contract,
    archived_world,
    auditor,
    compile_solids,
)
from scenegen.verification.rays import as_rounded
from scenegen.verification.report import BrokenError
from scenegen.worlds.world import World

AUDITED_SHARE, LEAST_AUDITED = 0.05, 8
"""Checks that cost much look at this share of a shard's samples, and at this many at least."""


@dataclass(frozen=True)
class Task:
    """All that examining one shard depends on."""

    contract: Contract
    """What is promised of the dataset that the shard was made for; its other shards are not in
    it."""
    entry: Entry
    """The shard, as the manifest lists it."""
    number: int
    """Its place in the manifest."""
    start: int
    """Place of its first sample within the split of the dataset that it was made for."""
    quick: bool
    seed: int
    twins_of: int
    """One of so many samples is compared with those of other splits."""
    not_comparable: str
    """Why samples made here need not have the dataset's bits; empty where they must."""
    not_scanned: str = ""
    """Why scans made here of its archived worlds need not have its bits; empty where they must."""

    @property
    def stop(self) -> int:
        """One more than the place of its last sample."""
        return (
            self.entry.stop
            if isinstance(self.entry, GatheredEntry)
            else self.start + self.entry.samples
        )

    @property
    def cut(self) -> bool:
        """Whether some of the samples between were left out."""
        return isinstance(self.entry, GatheredEntry) and self.entry.cut

    @property
    def file(self) -> str:
        """The shard's, by which executors call the task."""
        return self.entry.file


@dataclass(frozen=True, eq=False)
class SignedFile:
    """A file whose SHA-256 the manifest lists."""

    file: BufferedReader
    name: str
    sha256: str


@dataclass(frozen=True, eq=False)
class Worlds:
    """The archive of one shard, screened."""

    task: Task
    archive: Archive
    solids: dict[int, Solids] = field(default_factory=dict)
    """The solids of every world that was compiled, by its number."""
    _auditors: dict[int, Engine] = field(default_factory=dict)
    _made: dict[int, tuple[World, Engine]] = field(default_factory=dict)
    _worlds: dict[int, World] = field(default_factory=dict)

    def compile(self, number: int) -> Solids:
        """Compile a world to its solids, which checks of samples are handed later. Raises
        BrokenError."""
        name = f"{self.task.entry.worlds}: {number:06d}.xml"
        self.solids[number] = compile_solids(*self.archive.world(number), name)
        return self.solids[number]

    def auditor(self, number: int) -> Engine:
        """What casts rays anew in a world that was compiled."""
        if number not in self._auditors:
            world, made_with = self.archive.world(number), self.task.contract.engine
            self._auditors[number] = auditor(*world, self.solids[number], made_with=made_with)
        return self._auditors[number]

    def world(self, number: int) -> World:
        """A world, compiled. Raises BrokenError."""
        if number not in self._worlds:
            self._worlds.clear()  # samples come world by world
            self._worlds[number] = archived_world(self.archive, number)
        return self._worlds[number]

    def made(self, number: int) -> tuple[World, Engine]:
        """A world that was compiled, and the dataset's own engine of it, which is one of ours.
        Raises BrokenError."""
        if number not in self._made:
            self._made.clear()
            world = self.world(number)
            self._made[number] = (
                world,
                ENGINES.find(self.task.contract.engine).of(world.model, world.data),
            )
        return self._made[number]


@dataclass(frozen=True, eq=False)
class Shard:
    """One shard, its file open."""

    task: Task
    worlds: Worlds | None
    """None where the archive cannot be read."""
    file: ShardFile
    rejected: dict[str, Counter[str]]
    """How many worlds and viewpoints were rejected, by reason, as the shard says."""

    @functools.cached_property
    def rng(self) -> np.random.Generator:
        """What is chosen at random in this shard comes from here, in the order of its samples."""
        return np.random.default_rng(
            np.random.SeedSequence(self.task.seed, spawn_key=(self.task.number,))
        )

    @functools.cached_property
    def places(self) -> Sequence[int]:
        """Places of its samples; where it is cut, as their names tell. Raises BrokenError."""
        task = self.task
        if not task.cut:
            return range(task.start, task.stop)
        numbering = task.contract.numbering(task.entry.split)
        found: list[int] = numbering.place(
            self.file.column("world"), self.file.column("viewpoint")
        ).tolist()
        if (min(found), max(found)) != (task.start, task.stop - 1):
            raise BrokenError(
                f"{task.entry.file}: its samples stood from {min(found)} to {max(found)} in their "
                f"split, the manifest "
                f"says {task.start} to {task.stop - 1}"
            )
        return found

    @functools.cached_property
    def audited(self) -> frozenset[int]:
        """The samples that checks which cost much look at."""
        samples = self.task.entry.samples
        chosen = self.rng.permutation(samples)[: max(LEAST_AUDITED, round(AUDITED_SHARE * samples))]
        return frozenset(chosen.tolist())


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample, unpacked: all fields, or where `quick` those that are not derived from others."""

    shard: Shard
    row: int
    fields: Mapping[str, NDArray[Any]]
    own_digest: bytes

    @property
    def contract(self) -> Contract:
        """What the manifest promises."""
        return self.shard.task.contract

    @property
    def where(self) -> str:
        """How faults name this sample."""
        return f"{self.shard.task.entry.file}: sample {self.row}"

    @property
    def world(self) -> int:
        """Number of the world that it says it is of."""
        return int(self.fields["world"])

    @property
    def solids(self) -> Solids | None:
        """The solids of its world; None where there is no such world, or it was not compiled."""
        return self.shard.worlds.solids.get(self.world) if self.shard.worlds else None

    @functools.cached_property
    def packed(self) -> dict[str, NDArray[np.uint8]]:
        """The stored grids, eight voxels a byte."""
        return {name: np.packbits(self.fields[name]) for name in ("observed", "occupancy")}

    @functools.cached_property
    def scans(self) -> list[Scan]:
        """The stored ranges and poses: its own scan, and those before it. Raises BrokenError where
        a pose is none."""
        found = []
        for ranges, *pose in self.contract.of_scans(
            self.fields.__getitem__, "ranges", "position", "quaternion"
        ):
            # a range that is no number is a fault of `laws`; here it counts as no return
            clean = np.where(np.isfinite(ranges), ranges, np.float32(np.inf))
            try:
                found.append(Scan(clean, Pose(*pose), self.contract.lidar))
            except ValueError as error:
                raise BrokenError(f"{self.where}: {error}") from None
        return found

    @functools.cached_property
    def seen(self) -> ObservedGrid:
        """What follows from the stored ranges and poses. Raises BrokenError where a pose is
        none."""
        grid = self.contract.grid
        seen = fuse(self.scans[::-1], grid, self.fields["origin"], self.contract.mapping)
        return (
            as_rounded(seen, self.scans[0], grid, self.fields)
            if self.contract.generator == 1
            else seen
        )
