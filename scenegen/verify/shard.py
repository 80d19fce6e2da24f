"""One shard examined: its two files, every sample, its worlds, and the few that are cast and made anew."""

import hashlib
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import Engine, Pose, Scan, voxelize
from lidarsim.engines import ENGINES
from lidarsim.solids.shapes import Solids
from scenegen.dataset.layout import DIGEST, ShardFile, most_bytes, open_file, open_shard
from scenegen.dataset.trust import Entry
from scenegen.geometry import geometry_digest
from scenegen.quiet import quiet_mujoco
from scenegen.sample import SCHEMA, derive_tudf
from scenegen.truth import rasterize
from scenegen.verify.archive import Archive, auditor, compile_solids, read_archive
from scenegen.verify.contract import Contract
from scenegen.verify.rays import audit, disagrees
from scenegen.verify.regenerate import regenerate
from scenegen.verify.report import BrokenError, Ledger
from scenegen.verify.rounding import as_rounded
from scenegen.verify.twins import fold, signature

AUDITED_SHARE, LEAST_AUDITED = 0.05, 8
"""Of a shard's samples, as many have their rays cast anew."""
DIGESTED = ("observed", "occupancy", "ranges", "position", "quaternion", "origin", "world", "viewpoint")
"""What a sample's digest covers, in order: written anew from docs/format.md."""
UNITS_AGAIN = 1
"""Of a shard's flights, as many are made anew."""


@dataclass(frozen=True)
class Task:
    """All that examining one shard depends on."""

    contract: Contract
    number: int
    """The shard's place in the manifest."""
    start: int
    """Place of its first sample within its split."""
    quick: bool
    seed: int
    not_comparable: str
    """Why samples made here need not have the dataset's bits; empty where they must."""

    @property
    def entry(self) -> Entry:
        """The shard's entry in the manifest."""
        return self.contract.shards[self.number]


@dataclass(eq=False)
class Findings:
    """What one shard's examination leaves for the whole folder's."""

    number: int
    samples: int
    ledger: Ledger = field(default_factory=Ledger)
    digests: bytes = b""
    """The samples' own, as computed; 32 bytes each."""
    worlds: dict[bytes, int] = field(default_factory=dict)
    """Digest of a world's geometry → its number."""
    rows: list[int] = field(default_factory=list)
    """The samples that the next three belong to; see `scenegen.verify.twins`."""
    signatures: list[NDArray[np.uint32]] = field(default_factory=list)
    folds: list[NDArray[np.uint64]] = field(default_factory=list)
    observed: list[int] = field(default_factory=list)
    rejected: dict[str, Counter[str]] = field(default_factory=dict)


@quiet_mujoco()
def examine(task: Task) -> Findings:
    """Everything that can be said about one shard by itself. Faults go to the findings' ledger; raises nothing for
    what may be wrong with the files."""
    found = Findings(task.number, task.entry.samples)
    archive = _examine_worlds(task, found.ledger)
    solids = _compile(task, archive, found)
    path = task.contract.folder / task.entry.file
    with found.ledger.checking("layout"), open_file(path) as file:
        if os.fstat(file.fileno()).st_size <= most_bytes(task.contract.layout, task.entry.samples):
            with found.ledger.checking("checksums"):
                _check_sum(file, path, task.entry.sha256, found.ledger)
        shard = open_shard(file, path, task.entry.samples, task.contract.layout)
        if shard.stray_bytes:
            raise BrokenError(f"{shard.name}: {shard.stray_bytes} of its bytes belong to no sample")
        entry = task.entry
        shard.check_origin(split=entry.split, first_world=entry.first_world, worlds_sha256=entry.worlds_sha256)
        found.ledger.count("layout", files=1)
        found.ledger.expect(
            "manifest",
            shard.attributes["parameters"] == task.contract.fingerprint,
            f"{task.entry.file}: was written for other parameters than the manifest's: one of the two was edited, or "
            "the shard is another dataset's",
        )
        found.rejected = shard.rejected()
        _Samples(task, shard, solids, found).examine()
        if archive is not None and not task.quick:
            _make_again(task, shard, archive, found.ledger)
    return found


def _check_sum(file: BufferedReader, path: Path, expected: str, ledger: Ledger) -> None:
    file.seek(0)
    found = hashlib.file_digest(file, "sha256").hexdigest()
    ledger.count("checksums", files=1)
    ledger.expect(
        "checksums", found == expected, f"{path.name}: SHA-256 {found[:16]}…, the manifest lists {expected[:16]}…"
    )


def _examine_worlds(task: Task, ledger: Ledger) -> Archive | None:
    """The shard's archive, if it can be read."""
    path, archive = task.contract.folder / task.entry.worlds, None
    with ledger.checking("archives"), open_file(path) as file:
        ledger.count("archives", files=1)
        archive = read_archive(file, path.name)
        with ledger.checking("checksums"):
            _check_sum(file, path, task.entry.worlds_sha256, ledger)
        expected = task.contract.worlds(task.entry.split, task.start, task.entry.samples)
        there = sorted(archive.documents)
        ledger.expect(
            "archives",
            len(there) == len(expected) and there == list(expected),
            f"{path.name}: holds worlds {_spans(there)}, its samples are of {_spans(expected)}",
        )
        ledger.expect(
            "archives",
            task.entry.first_world == expected[0],
            f"{task.entry.file}: first_world = {task.entry.first_world}, its samples begin with {expected[0]}",
        )
        if task.contract.scenes is not None:
            _check_scenes(task, archive, ledger)
    return archive


def _check_scenes(task: Task, archive: Archive, ledger: Ledger) -> None:
    """Worlds drawn by hand are those that the manifest names."""
    listed = (task.contract.scenes or {})[task.entry.split]
    for number in archive.documents:
        document, assets = archive.world(number)
        digest = hashlib.sha256(document)
        for name, content in sorted(assets.items()):
            digest.update(name.encode() + hashlib.sha256(content).digest())
        expected = listed[number].get("sha256") if number < len(listed) else None
        ledger.expect(
            "archives",
            digest.hexdigest() == expected,
            f"{task.entry.worlds}: {number:06d}.xml is not the world that the manifest's recipe.scenes names",
        )


def _spans(numbers: Sequence[int]) -> str:
    return f"{numbers[0]} to {numbers[-1]} ({len(numbers)})" if numbers else "none"


def _compile(task: Task, archive: Archive | None, found: Findings) -> dict[int, tuple[Solids, Engine]]:
    """Every archived world's solids and what audits rays among them, and a digest of its geometry; of its outline alone
    where `quick`."""
    compiled: dict[int, tuple[Solids, Engine]] = {}
    for number in sorted(archive.documents) if archive else ():
        with found.ledger.checking("splits"):
            assert archive is not None
            found.ledger.count("splits", worlds=1)
            if task.quick:
                found.worlds.setdefault(archive.outlines[number], number)
                continue
            world = archive.world(number)
            solids = compile_solids(*world, f"{task.entry.worlds}: {number:06d}.xml")
            found.worlds.setdefault(geometry_digest(solids), number)
            compiled[number] = solids, auditor(*world, solids, made_with=task.contract.engine)
    return compiled


class _Samples:
    """All samples of an open shard, one after the other."""

    def __init__(self, task: Task, shard: ShardFile, solids: dict[int, tuple[Solids, Engine]], found: Findings):
        self._task, self._shard, self._solids, self._found = task, shard, solids, found
        self._ledger = found.ledger
        self._rng = np.random.default_rng(np.random.SeedSequence(task.seed, spawn_key=(task.number,)))
        audited = max(LEAST_AUDITED, round(AUDITED_SHARE * task.entry.samples))
        order = self._rng.permutation(task.entry.samples)
        self._audited = set() if task.quick else {int(row) for row in order[:audited]}
        derived = [name for name in task.contract.fields if SCHEMA[name]["derived"] and not task.quick]
        self._fields = [name for name, meta in SCHEMA.items() if not meta["derived"]] + derived

    def examine(self) -> None:
        """Examine every sample; one that cannot be read is a fault of `layout`, and the others go on."""
        for row in range(self._task.entry.samples):
            with self._ledger.checking("layout"):
                self._ledger.count("layout", samples=1)
                stored = {name: self._shard.value(name, row, read_only=self._task.quick) for name in self._fields}
                own = self._shard.value(DIGEST, row).tobytes()
                self._cheap(row, stored, own)
                if not self._task.quick:
                    self._recompute(row, stored)
                    self._found.rows.append(row)
                    with self._ledger.checking("near-twins"):
                        self._found.signatures.append(signature(stored["occupancy"]))
                        self._found.folds.append(fold(stored["observed"]))
                        self._found.observed.append(int(np.count_nonzero(stored["observed"])))

    def _expect(self, check: str, holds: Any, row: int, line: str) -> None:
        if not holds:
            self._ledger.fault(check, f"{self._task.entry.file}: sample {row}: {line}")

    def _cheap(self, row: int, stored: dict[str, NDArray[Any]], own: bytes) -> None:
        """What needs no computing to speak of."""
        world, viewpoint = int(stored["world"]), int(stored["viewpoint"])
        with self._ledger.checking("digest"):
            self._ledger.count("digest", samples=1)
            packed = {name: np.packbits(stored[name]) for name in ("observed", "occupancy")}
            digest = hashlib.sha256(b"".join((packed.get(name, stored[name])).tobytes() for name in DIGESTED)).digest()
            self._found.digests += digest
            self._expect("digest", digest == own, row, "its content does not have the digest stored beside it")
        with self._ledger.checking("names"):
            self._ledger.count("names", samples=1)
            expected = self._task.contract.name(self._task.entry.split, self._task.start + row)
            self._expect(
                "names",
                (world, viewpoint) == expected,
                row,
                f"is world {world}, viewpoint {viewpoint}, expected {expected}",
            )
        with self._ledger.checking("centred"):
            self._ledger.count("centred", samples=1)
            position, quaternion = stored["position"], stored["quaternion"]
            centred = self._task.contract.grid.origin_at(position)
            off = float(np.abs(stored["origin"] - centred).max())
            self._expect("centred", off == 0.0, row, f"origin is {off:.3g} m from position less half the grid")
            length = float(np.sqrt((quaternion**2).sum()))
            self._expect("centred", abs(length - 1) <= 1e-9, row, f"quaternion has length {length:g}, expected 1")
        with self._ledger.checking("laws"):
            self._ledger.count("laws", samples=1)
            ranges, most = stored["ranges"], self._task.contract.lidar.max_range_m
            held = (ranges >= 0) & ((ranges <= np.float32(most)) | np.isposinf(ranges))
            self._expect(
                "laws", held.all(), row, f"{np.count_nonzero(~held)} ranges are not from 0 to {most:g} m, or inf"
            )
            stray = np.bitwise_count(packed["observed"] & ~packed["occupancy"]).sum()
            self._expect("laws", not stray, row, f"{stray} observed voxels are not occupied")
            if "free" in stored:
                both = np.count_nonzero(stored["free"] & stored["observed"])
                self._expect("laws", not both, row, f"{both} voxels are both free and observed")

    def _recompute(self, row: int, stored: dict[str, NDArray[Any]]) -> None:
        """What follows from other fields, and what follows from the world."""
        contract = self._task.contract
        if "tudf" in stored:
            with self._ledger.checking("tudf"):
                self._ledger.count("tudf", samples=1)
                self._same(
                    "tudf", row, stored["tudf"], derive_tudf(stored["occupancy"], grid=contract.grid), "occupancy"
                )
        with self._ledger.checking("voxels"):
            self._ledger.count("voxels", samples=1)
            try:
                pose = Pose(stored["position"], stored["quaternion"])
            except ValueError as error:
                raise BrokenError(f"{self._task.entry.file}: sample {row}: {error}") from None
            # a range that is no number was told of above; here it counts as none
            ranges = np.where(np.isfinite(stored["ranges"]), stored["ranges"], np.float32(np.inf))
            scan = Scan(ranges, pose, contract.lidar)
            seen = voxelize(scan, contract.grid, stored["origin"])
            if contract.generator == 1:
                seen = as_rounded(seen, scan, contract.grid, stored)
            self._same("voxels", row, stored["observed"], seen.observed, "ranges", name="observed")
        if "free" in stored:
            with self._ledger.checking("free"):
                self._ledger.count("free", samples=1)
                self._same("free", row, stored["free"], seen.free, "ranges")
        if int(stored["world"]) not in self._solids:
            return
        solids, engine = self._solids[int(stored["world"])]
        with self._ledger.checking("occupancy"):
            self._ledger.count("occupancy", samples=1)
            truth = rasterize(solids, contract.grid, stored["origin"])
            self._same("occupancy", row, stored["occupancy"], truth, f"world {int(stored['world'])}")
        if row in self._audited:
            with self._ledger.checking("rays"):
                self._cast_again(row, stored, engine, len(solids.shape) + len(solids.triangles))

    def _same(
        self, check: str, row: int, stored: NDArray[Any], again: NDArray[Any], source: str, *, name: str = ""
    ) -> None:
        bits = f"u{again.itemsize}"
        if not np.array_equal(stored.view(bits), again.view(bits)):
            differing = np.argwhere(stored.view(bits) != again.view(bits))
            first = tuple(int(n) for n in differing[0]) if len(differing) else ()
            here = f", at {first} {stored[first]} is stored, {again[first]} expected" if first else ""
            line = f"{name or check} is not what follows from {source}: {len(differing)} voxels differ{here}"
            self._expect(check, False, row, line)

    def _cast_again(self, row: int, stored: dict[str, NDArray[Any]], engine: Engine, solids: int) -> None:
        lidar = self._task.contract.lidar
        rays, found, gap = audit(
            stored["ranges"], stored["position"], stored["quaternion"], engine, lidar, solids=solids, rng=self._rng
        )
        wrong = disagrees(gap, found, lidar.max_range_m)
        self._ledger.count("rays", samples=1, rays=len(rays))
        self._ledger.note_greatest("rays", "greatest difference in m", float(gap[~wrong].max(initial=0.0)))
        if wrong.any():
            n = int(np.flatnonzero(wrong)[np.argmax(gap[wrong])])
            place = tuple(int(at) for at in np.unravel_index(rays[n], lidar.shape))
            self._expect(
                "rays",
                False,
                row,
                f"{np.count_nonzero(wrong)} of {len(rays)} rays differ; ray {place} has "
                f"{stored['ranges'][place]} m, the solids of world {int(stored['world'])} are {found[n]:.7g} m "
                "away",
            )


def _make_again(task: Task, shard: ShardFile, archive: Archive, ledger: Ledger) -> None:
    """A few of the shard's flights flown again, and their samples compared bit for bit."""
    reason = task.not_comparable
    foreign = task.contract.engine not in ENGINES.known
    if reason and (foreign or (not task.contract.drawn and task.contract.scenes is None)):
        ledger.skip("regenerated", reason)
        return
    each = task.contract.viewpoints
    units = -(-task.entry.samples // each)
    rng = np.random.default_rng(np.random.SeedSequence(task.seed, spawn_key=(task.number, 1)))
    found = Ledger()
    for local in rng.permutation(units)[:UNITS_AGAIN]:
        with found.checking("regenerated"):
            _compare_unit(task, shard, archive, int(local), found)
    if reason:
        found.excuse("regenerated", f"not comparable, {reason}: what comes out otherwise here is no fault")
    ledger.add(found)


def _compare_unit(task: Task, shard: ShardFile, archive: Archive, local: int, ledger: Ledger) -> None:
    each = task.contract.viewpoints
    again = regenerate(task.contract, archive, task.entry.split, task.start // each + local)
    world = archive.documents.get(again.number)
    ledger.count("regenerated", worlds=1)
    ledger.expect(
        "regenerated",
        world == again.world.mjcf,
        f"{task.entry.worlds}: {again.number:06d}.xml is not the world that the seed gives",
    )
    for row, sample in zip(range(local * each, task.entry.samples), again.samples, strict=False):
        ledger.count("regenerated", samples=1)
        for name in task.contract.fields:
            expected = np.asarray(getattr(sample, name), dtype=SCHEMA[name]["dtype"])
            if not ledger.expect(
                "regenerated",
                shard.value(name, row).tobytes() == expected.tobytes(),
                f"{task.entry.file}: sample {row}: {name} is not what the seed gives",
            ):
                break
