"""The type of a check, and its inputs at each level: files, archives, shards, samples, folder.
Values that several checks need are cached in these inputs."""

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
from lidarsim.grid import Floats
from lidarsim.registry import Registry
from lidarsim.solids import Solids
from scenegen.base.errors import CorruptFileError, SceneError, reraise_as
from scenegen.dataset.archive import open_archive, referred
from scenegen.dataset.layout import ShardFile
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import ShardEntry
from scenegen.draw.sample import rng_of
from scenegen.verification.rays import MapAuditor, MovingAuditor
from scenegen.verification.report import Page
from scenegen.worlds.place import Place
from scenegen.worlds.screen import screen
from scenegen.worlds.world import AnyWorld, archived_world

CONTENT = ("observed", "occupancy", "ranges", "position", "quaternion", "origin")
"""Fields that a sample's digest covers before `world` and `viewpoint`, in order. Independent of the
writer's code: from docs/format.md."""
AUDITED_SHARE, MIN_AUDITED = 0.05, 8
"""Expensive checks examine this share of a shard's samples, and at least this number."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check of a dataset.

    It has a function for each level that it examines. The function gets the object and the check's
    page of the ledger, where it records faults, counts what it examined, and keeps data for the
    final level. A CorruptFileError becomes a fault of the check. A check that counts nothing and
    has no faults is reported as skipped, so checks count samples without findings, too.
    """

    name: str
    proves: str = ""
    """Property of every dataset that passes, for readers."""
    quick: bool = False
    """Whether it is part of `--quick`."""
    field: str = ""
    """Field that it examines, if some datasets lack it; the check is then omitted. Functions test
    other conditions themselves, by `RawSample.contract`."""
    part: bool = False
    """Whether it examines optional parts (see `scenegen.draw.parts`); without any, the check is
    omitted."""
    file: "Callable[[SignedFile, Page], None] | None" = None
    """Examines the bytes of a shard or an archive."""
    archive: "Callable[[Worlds, Page], None] | None" = None
    """Examines the screened worlds of an archive."""
    shard: "Callable[[Shard, Page], None] | None" = None
    """Examines an open shard, before its samples."""
    sample: "Callable[[RawSample, Page], None] | None" = None
    """Examines one unpacked sample."""
    folder: Callable[[Manifest, Page], None] | None = None
    """Examines the whole dataset at the end, with the data that earlier levels kept."""


OWN_CHECKS = Registry("check", {}, needs={"name": "its name"})
"""Checks of the user, each a `Check` named as ``module:Object``."""


@dataclass(frozen=True)
class Task:
    """Input of one shard's examination."""

    contract: Manifest
    """Manifest of the dataset, without its list of shards."""
    entry: ShardEntry
    """The shard's entry in the manifest."""
    number: int
    """Its position in the manifest."""
    quick: bool
    seed: int
    twins_of: int
    """Every n-th sample is compared with other splits, where n is this number."""
    # by name: every process imports them for itself
    own: tuple[str, ...] = ()
    """The user's checks, as ``module:Object``."""

    @property
    def file(self) -> str:
        """File of the shard; executors use it to name the task."""
        return self.entry.file


@dataclass(frozen=True, eq=False)
class SignedFile:
    """A file with its SHA-256 in the manifest."""

    file: BufferedReader
    name: str
    sha256: str


def auditor(world: AnyWorld, made_with: str, times_s: Floats | None = None) -> Caster:
    """Engine that repeats the casting of rays: another one than the dataset's, and always one of
    ours.

    Args:
        world: The world.
        made_with: Name of the dataset's engine.
        times_s: (n,): when each ray is cast, seconds; needed in a world with movers.
    """
    if isinstance(world, Place):
        return MapAuditor(world.voxels)
    # an engine cannot confirm its own results
    factory = AnalyticEngine.of if made_with == MUJOCO else MujocoEngine
    if world.movers is None or times_s is None:
        return world.caster(factory)
    return MovingAuditor(world, factory, times_s)


@dataclass(frozen=True, eq=False)
class Worlds:
    """The screened archive of one shard."""

    task: Task
    documents: dict[int, bytes]
    """MJCF documents by the number of the world."""
    outlines: dict[int, bytes]
    """Result of `screen` for each document."""
    assets: dict[str, bytes]
    solids: dict[int, Solids | VoxelMap] = field(default_factory=dict)
    """Solids, or maps, of all compiled worlds, by number."""

    @classmethod
    def read(cls, task: Task, file: BufferedReader, name: str) -> "Worlds":
        """Read and screen all members of an archive.

        Args:
            task: The shard.
            file: The open archive.
            name: Its name, for messages.

        Raises:
            CorruptFileError: if it is damaged, or a world is refused.
        """
        max_worlds = task.entry.samples
        with open_archive(file, name) as members:
            # bounds the time that screening may take
            if (worlds := sum(member.endswith(".xml") for member in members)) > max_worlds:
                raise CorruptFileError(
                    f"{worlds} worlds, expected one a sample at most, {max_worlds}"
                )
            assets = {member: members.read(member) for member in members}
            # a list of the names, as documents are popped from what is walked
            documents = {
                int(name[:-4]): assets.pop(name) for name in [*assets] if name.endswith(".xml")
            }
            # screened before anything compiles them, as MuJoCo may crash on hostile documents
            outlines = {
                number: screen(document, assets, f"{number:06d}.xml")
                for number, document in documents.items()
            }
        return cls(task, documents, outlines, assets)

    def source(self, number: int) -> tuple[bytes, dict[str, bytes]]:
        """Document of a world, and the files that it refers to.

        Raises:
            CorruptFileError: if there is no such world.
        """
        if number not in self.documents:
            raise CorruptFileError(f"has no member {number:06d}.xml")
        document = self.documents[number]
        return document, {name: self.assets[name] for name in referred(document, self.assets)}

    def compile(self, number: int) -> Solids | VoxelMap:
        """Compile a world, and keep its solids, or its map, for checks of samples. Raises
        CorruptFileError."""
        world = self.world(number)
        self.solids[number] = world.voxels if isinstance(world, Place) else world.solids
        return self.solids[number]

    @lru_cache(maxsize=1)  # noqa: B019 (consecutive samples share a world)
    def world(self, number: int) -> AnyWorld:
        """Compile a world.

        Raises:
            CorruptFileError: if it cannot be compiled, or has no movers and the samples do.
        """
        name = f"{self.task.entry.worlds}: {number:06d}.xml"
        with reraise_as(CorruptFileError, of=SceneError):
            world = archived_world(*self.source(number), name=name)
        if "movers" in self.task.contract.parts and getattr(world, "movers", None) is None:
            raise CorruptFileError(f"{name}: has no movers, and the samples do")
        return world


@dataclass(frozen=True, eq=False)
class Shard:
    """One open shard."""

    task: Task
    worlds: Worlds | None
    """None if the archive cannot be read."""
    file: ShardFile
    rejected: dict[str, Counter[str]]
    """Numbers of rejected worlds and viewpoints by reason, as stored in the shard."""

    @cached_property
    def rng(self) -> np.random.Generator:
        """Random choices in this shard, in the order of its samples."""
        return rng_of(self.task.seed, self.task.number)

    @cached_property
    def first_place(self) -> int:
        """Position of its first sample in its split. Raises CorruptFileError."""
        return self.task.contract.first_place(self.task.entry)

    @cached_property
    def audited(self) -> frozenset[int]:
        """Rows of the samples that expensive checks examine."""
        samples = self.task.entry.samples
        chosen = self.rng.permutation(samples)[: max(MIN_AUDITED, round(AUDITED_SHARE * samples))]
        return frozenset(chosen.tolist())


def scans_of(contract: Manifest, stored: Callable[[str], Any]) -> list[Scan]:
    """Make the scans of a sample.

    Args:
        contract: Manifest of the dataset.
        stored: Returns a stored field by its name.

    Returns:
        The sample's own scan, then earlier ones, latest first.

    Raises:
        ValueError: if a pose is invalid.
    """
    names = ("ranges", "position", "quaternion")
    views: list[Any] = [[stored(name) for name in names]]
    if contract.mapping.scans > 1:
        views += zip(*(stored(f"earlier_{name}") for name in names), strict=True)
    # invalid ranges are faults of the check `laws`; here they count as no return
    return [
        Scan(np.where(ranges >= 0, ranges, np.float32(np.inf)), Pose(*pose), contract.lidar)
        for ranges, *pose in views
    ]


MAX_TIME_S = 1e6
"""Latest time of a scan, seconds: no flight lasts so long."""


def times_of(contract: Manifest, stored: Callable[[str], Any]) -> Floats:
    """When the scans of a sample began, seconds, in the order of `scans_of`.

    Args:
        contract: Manifest of the dataset.
        stored: Returns a stored field by its name.
    """
    if "movers" in contract.parts:
        times_s = np.asarray(stored("scan_times"), np.float64)
        # negated, so that NaN is refused
        if not ((times_s >= 0) & (times_s <= MAX_TIME_S)).all():
            raise CorruptFileError(f"scan_times: expected 0 to {MAX_TIME_S:g} s")
        return times_s
    return np.zeros(contract.mapping.scans)


@dataclass(frozen=True, eq=False)
class RawSample:
    """One unpacked sample: all fields, or without derived ones if `quick`."""

    shard: Shard
    row: int
    fields: Mapping[str, NDArray[Any]]
    own_digest: bytes

    @property
    def contract(self) -> Manifest:
        """Manifest of the dataset."""
        return self.shard.task.contract

    @property
    def where(self) -> str:
        """Name of the sample in faults."""
        return f"{self.shard.task.entry.file}: sample {self.row}"

    @property
    def world(self) -> int:
        """Number of its world."""
        return int(self.fields["world"])

    @property
    def solids(self) -> Solids | VoxelMap | None:
        """Solids, or map, of its world; None if it does not exist or was not compiled."""
        return self.shard.worlds.solids.get(self.world) if self.shard.worlds else None

    @property
    def audited(self) -> AnyWorld | None:
        """Its compiled world, if expensive checks examine this sample; otherwise None. Raises
        CorruptFileError."""
        worlds = self.shard.worlds
        if worlds is None or self.solids is None or self.row not in self.shard.audited:
            return None
        return worlds.world(self.world)

    @property
    def times_s(self) -> Floats:
        """When each of `scans` began, seconds; 0 where nothing moves."""
        return times_of(self.contract, self.fields.__getitem__)

    @cached_property
    def packed(self) -> dict[str, NDArray[np.uint8]]:
        """Boolean grids as bits, eight voxels a byte."""
        return {name: np.packbits(self.fields[name]) for name in ("observed", "occupancy")}

    @cached_property
    def content(self) -> "hashlib._Hash":
        """Hash of the fields `CONTENT`. Copy it before updating."""
        parts = (self.packed.get(name, self.fields[name]).tobytes() for name in CONTENT)
        return hashlib.sha256(b"".join(parts))

    @cached_property
    def scans(self) -> list[Scan]:
        """Stored scans: its own, then earlier ones. Raises CorruptFileError if a pose is
        invalid."""
        with reraise_as(CorruptFileError, f"{self.where}: "):
            return scans_of(self.contract, self.fields.__getitem__)

    @cached_property
    def seen(self) -> ObservedGrid:
        """Map that follows from the stored scans. Raises CorruptFileError if a pose is invalid."""
        contract = self.contract
        # oldest first, as when the sample was made
        return fuse(self.scans[::-1], contract.grid, self.fields["origin"], contract.mapping)
