"""What a check is, and what checks are handed at each level of the walk over a dataset: files,
archives, shards, samples, and the folder. What several checks need is computed here, once."""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from io import BufferedReader
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import AnalyticEngine, MujocoEngine, ObservedGrid, Pose, Scan, fuse
from lidarsim.engines import MUJOCO, Caster
from lidarsim.engines.voxels import VoxelMap
from lidarsim.registry import Registry
from lidarsim.solids import Solids
from scenegen.base.errors import SceneError, raised_as
from scenegen.dataset.archive import open_archive, referred
from scenegen.dataset.layout import ShardFile
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import ShardEntry
from scenegen.draw.sample import rng_of
from scenegen.verification.rays import MapAuditor
from scenegen.verification.report import BrokenError, Page
from scenegen.worlds.place import Place
from scenegen.worlds.screen import screen
from scenegen.worlds.world import AnyWorld, archived_world

CONTENT = ("observed", "occupancy", "ranges", "position", "quaternion", "origin")
"""What a sample's digest covers before its name, `world` and `viewpoint`, in order: written anew
from docs/format.md."""
AUDITED_SHARE, LEAST_AUDITED = 0.05, 8
"""Expensive checks look at this share of a shard's samples, and at this many at least."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check of a dataset.

    Its examinations are functions, one for each level at which it looks. Each is handed what it
    looks at, and the check's page of the ledger: there it writes down faults, counts what it
    examined, and keeps what it needs at the end. A BrokenError that it raises becomes a fault of
    this check. One that counts nothing and finds no fault is told as skipped, so a check counts
    also the samples in which there is nothing to find.
    """

    name: str
    proves: str = ""
    """What holds of a dataset that passes, for readers."""
    quick: bool = False
    """Whether `--quick` makes it."""
    field: str = ""
    """The field of samples that it examines, where not every dataset stores that field: without it
    the check is left out. What else a check depends on, such as `Manifest.noise`, it
    asks its `Sample.contract` itself."""
    part: bool = False
    """Whether it examines parts of samples, see `scenegen.draw.parts`: without any,
    the check is left out."""
    file: "Callable[[SignedFile, Page], None] | None" = None
    """Looks at the bytes of a shard or of an archive."""
    archive: "Callable[[Worlds, Page], None] | None" = None
    """Looks at the worlds of a shard's archive, which are screened by then."""
    shard: "Callable[[Shard, Page], None] | None" = None
    """Looks at a shard, whose file is open by then, before its samples."""
    sample: "Callable[[Sample, Page], None] | None" = None
    """Looks at one sample, whose fields are unpacked by then."""
    folder: Callable[[Manifest, Page], None] | None = None
    """Looks at the whole folder in the end; the page holds what the levels before kept."""


OWN_CHECKS = Registry("check", {}, needs={"name": "its name"})
"""Checks of a user's own, each a `Check` named as ``module:Object``."""


@dataclass(frozen=True)
class Task:
    """All that examining one shard depends on."""

    contract: Manifest
    """What is promised of the dataset that the shard was made for, without its other shards."""
    entry: ShardEntry
    """The shard, as the manifest lists it."""
    number: int
    """Its position in the manifest."""
    quick: bool
    seed: int
    twins_of: int
    """One of so many samples is compared with those of other splits."""
    own: tuple[str, ...] = ()
    """The user's own checks, as ``module:Object``."""

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


def auditor(world: AnyWorld, made_with: str) -> Caster:
    """The engine that casts rays anew in a world: never the one that the dataset was `made_with`,
    and always one of ours."""
    if isinstance(world, Place):
        return MapAuditor(world.voxels)
    return world.caster(AnalyticEngine.of if made_with == MUJOCO else MujocoEngine)


@dataclass(frozen=True, eq=False)
class Worlds:
    """The archive of one shard, screened."""

    task: Task
    documents: dict[int, bytes]
    """MJCF by the world's number."""
    outlines: dict[int, bytes]
    """What `screen` gives for each document."""
    assets: dict[str, bytes]
    solids: dict[int, Solids | VoxelMap] = field(default_factory=dict)
    """The solids of every world that was compiled, or its map, by its number."""

    @classmethod
    def read(cls, task: Task, file: BufferedReader, name: str) -> "Worlds":
        """Read and screen all members of the archive in `file`. Raises BrokenError, which names
        `name` and the fault."""
        most = task.entry.samples
        with open_archive(file, name) as members:
            if (worlds := sum(member.endswith(".xml") for member in members)) > most:
                raise BrokenError(f"{worlds} worlds, expected one a sample at most, {most}")
            assets = {member: members.read(member) for member in members}
            documents = {
                int(name[:-4]): assets.pop(name) for name in [*assets] if name.endswith(".xml")
            }
            outlines = {
                number: screen(document, assets, f"{number:06d}.xml")
                for number, document in documents.items()
            }
        return cls(task, documents, outlines, assets)

    def source(self, number: int) -> tuple[bytes, dict[str, bytes]]:
        """A world's document and the files it refers to. Raises BrokenError where there is none."""
        if number not in self.documents:
            raise BrokenError(f"has no member {number:06d}.xml")
        document = self.documents[number]
        return document, {name: self.assets[name] for name in referred(document, self.assets)}

    def compile(self, number: int) -> Solids | VoxelMap:
        """Compile a world to its solids, or read its map, which checks of samples are handed later.
        Raises BrokenError."""
        world = self.world(number)
        self.solids[number] = world.voxels if isinstance(world, Place) else world.solids
        return self.solids[number]

    @lru_cache(maxsize=1)  # noqa: B019 (samples come world by world)
    def world(self, number: int) -> AnyWorld:
        """A world, compiled. Raises BrokenError."""
        name = f"{self.task.entry.worlds}: {number:06d}.xml"
        with raised_as(BrokenError, of=SceneError):
            return archived_world(*self.source(number), name=name)


@dataclass(frozen=True, eq=False)
class Shard:
    """One shard, its file open."""

    task: Task
    worlds: Worlds | None
    """None where the archive cannot be read."""
    file: ShardFile
    rejected: dict[str, Counter[str]]
    """How many worlds and viewpoints were rejected, by reason, as the shard says."""

    @cached_property
    def rng(self) -> np.random.Generator:
        """What is chosen at random in this shard comes from here, in the order of its samples."""
        return rng_of(self.task.seed, self.task.number)

    @cached_property
    def first_place(self) -> int:
        """The place of its first sample in its split. Raises BrokenError."""
        return self.task.contract.first_place(self.task.entry)

    @cached_property
    def audited(self) -> frozenset[int]:
        """The samples that expensive checks look at."""
        samples = self.task.entry.samples
        chosen = self.rng.permutation(samples)[: max(LEAST_AUDITED, round(AUDITED_SHARE * samples))]
        return frozenset(chosen.tolist())


def scans_of(contract: Manifest, stored: Callable[[str], Any]) -> list[Scan]:
    """The scans of a sample whose fields are `stored`: its own, and those before it. Raises
    ValueError for an invalid pose."""
    names = ("ranges", "position", "quaternion")
    views: list[Any] = [[stored(name) for name in names]]
    if contract.mapping.scans > 1:
        views += zip(*(stored(f"earlier_{name}") for name in names), strict=True)
    # a range that is no length is a fault of `laws`; here it counts as no return
    return [
        Scan(np.where(ranges >= 0, ranges, np.float32(np.inf)), Pose(*pose), contract.lidar)
        for ranges, *pose in views
    ]


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample, unpacked: all fields, or where `quick` those that are not derived from others."""

    shard: Shard
    row: int
    fields: Mapping[str, NDArray[Any]]
    own_digest: bytes

    @property
    def contract(self) -> Manifest:
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
    def solids(self) -> Solids | VoxelMap | None:
        """The solids of its world, or its map; None where there is no such world, or it was not
        compiled."""
        return self.shard.worlds.solids.get(self.world) if self.shard.worlds else None

    @property
    def audited(self) -> AnyWorld | None:
        """The world, compiled, of one of the samples that expensive checks look at; None for the
        others, and where `solids` are. Raises BrokenError."""
        worlds = self.shard.worlds
        if worlds is None or self.solids is None or self.row not in self.shard.audited:
            return None
        return worlds.world(self.world)

    @cached_property
    def packed(self) -> dict[str, NDArray[np.uint8]]:
        """The stored grids, eight voxels a byte."""
        return {name: np.packbits(self.fields[name]) for name in ("observed", "occupancy")}

    @cached_property
    def content(self) -> "hashlib._Hash":
        """The hash of its `CONTENT`; what goes on hashing takes a copy."""
        parts = (self.packed.get(name, self.fields[name]).tobytes() for name in CONTENT)
        return hashlib.sha256(b"".join(parts))

    @cached_property
    def scans(self) -> list[Scan]:
        """The stored ranges and poses: its own scan, and those before it. Raises BrokenError for
        an invalid pose."""
        with raised_as(BrokenError, f"{self.where}: "):
            return scans_of(self.contract, self.fields.__getitem__)

    @cached_property
    def seen(self) -> ObservedGrid:
        """The map that follows from the stored ranges and poses. Raises BrokenError for an invalid
        pose."""
        contract = self.contract
        return fuse(self.scans[::-1], contract.grid, self.fields["origin"], contract.mapping)
