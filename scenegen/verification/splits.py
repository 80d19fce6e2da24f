"""Checks that splits share nothing: no world, and no map that looks nearly the same; and the search
for such near-twins."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.engines.voxels import VoxelMap
from lidarsim.grid import Ints, Mask
from scenegen import SPLITS
from scenegen.dataset.layout import Layout, ShardFile, open_shard
from scenegen.dataset.trust import Manifest
from scenegen.errors import GuardError, raised_as
from scenegen.limits import GUARD_BYTES, GUARD_S
from scenegen.run.workers import guarded
from scenegen.verification.check import Check, Sample, Worlds
from scenegen.verification.report import BrokenError, Page
from scenegen.worlds.place import map_digest
from scenegen.worlds.world import geometry_digest

OCCUPIED_IOU = 0.9
"""Two samples are near-twins only if the intersection over union of their occupied voxels is at
least this."""
OBSERVED_IOU = 0.5
"""Two samples are near-twins only if the intersection over union of their observed voxels is at
least this. The occupied voxels alone do not decide: two worlds with next to nothing on a flat floor
have the same, but from another height and heading, rays hit other parts of that floor."""
STANDING_IOU, FLOOR_SHARE = 0.5, 0.95
"""Two samples are near-twins only if the intersection over union of what stands on their floor is
at least the first number. A layer is floor where both maps fill at least the second number of it.
Two floors that are nearly empty may by chance be observed alike, too; what stands on them then
tells them apart."""
MOST_PAIRS = 8_000_000
"""The search ends once so many pairs of maps have blocks that may be those of twins."""
MOST_COMPARED = 5_000
"""This many pairs are compared voxel by voxel at most."""
MOST_TWINS = 200_000
"""This many samples are searched at most, evenly spread: each takes 2.4 KB of memory until all are
seen."""
_BITS = 13


def signature(occupancy: Mask) -> NDArray[np.uint32]:
    """Count the occupied voxels in each of 8 x 8 x 5 blocks of a map, flat (320,)."""
    sums, blocks = occupancy, np.zeros((8, 8, 5), np.uint32)
    for axis in (2, 1, 0):  # along the rows in memory first
        count, parts = occupancy.shape[axis], blocks.shape[axis]
        begins = range(0, count, -(-count // parts))
        sums = np.add.reduceat(sums, begins, axis=axis, dtype=np.uint32)
    blocks[tuple(map(slice, sums.shape))] = sums
    return blocks.reshape(-1)


def fold(observed: Mask) -> NDArray[np.uint64]:
    """Scatter the observed voxels over 8192 bits by their number, (128,) words; two voxels may
    share a bit."""
    number = np.flatnonzero(observed).astype(np.uint32)
    bits = np.zeros(1 << _BITS, bool)
    bits[(number * np.uint32(2654435761)) >> np.uint32(32 - _BITS)] = True
    return np.packbits(bits).view(np.uint64)


def candidates(
    signatures: NDArray[np.uint32],
    folds: NDArray[np.uint64],
    observed: Ints,
    splits: Ints,
) -> tuple[Ints, bool]:
    """Find the pairs (P, 2) of the n samples that may be near-twins, and whether these are all:
    then none is missed.

    `signatures` (n, 320) and `folds` (n, 128) are of every sample, `observed` (n,) counts its
    observed voxels, `splits` (n,) numbers its split. Voxels in which two maps differ are at least
    as many as the sum of the differences of their blocks, so most pairs are ruled out by a few
    numbers; sorted by how much is occupied, only neighbours are looked at. Of what is left, the
    bits that two samples' observed voxels share tell almost all apart.
    """
    counts, share = signatures.sum(axis=1, dtype=np.int64), 1.0 - OCCUPIED_IOU
    fine = signatures.astype(np.int32)
    coarse = fine.reshape(-1, 2, 4, 2, 4, 5).sum(axis=(2, 4)).reshape(-1, 20)
    # voxels whose bit another one has, too
    lost = observed - np.bitwise_count(folds).sum(axis=1, dtype=np.int64)
    order = np.argsort(counts, kind="stable")
    ends = np.searchsorted((1.0 - share) * counts[order], counts[order], side="right")
    found, tried = list[tuple[int, int]](), 0
    for place, one in enumerate(order.tolist()):
        if not counts[one]:
            continue  # an empty map has no twin
        others = order[place + 1 : ends[place]]
        others = others[splits[others] != splits[one]]
        for blocks in (coarse, fine):
            # with d voxels that differ and s = |A| + |B|, the union is (s + d) / 2, so IoU >= 1 -
            # share means this
            most = np.floor(share * (counts[one] + counts[others]) / (2.0 - share) + 1e-9)
            others = others[np.abs(blocks[others] - blocks[one]).sum(axis=1) <= most]
        tried += len(others)
        shared = np.bitwise_count(folds[others] & folds[one]).sum(axis=1, dtype=np.int64)
        # with s = |A| + |B| and IoU = |A and B| / (s - |A and B|), at least this many are in both
        least = OBSERVED_IOU / (1.0 + OBSERVED_IOU) * (observed[one] + observed[others])
        others = others[shared + np.minimum(lost[one], lost[others]) >= least - 1e-6]
        found += [(one, other) for other in others.tolist()]
        if tried > MOST_PAIRS or len(found) > MOST_COMPARED:
            return np.array(found[:MOST_COMPARED]), False
    return np.array(found, np.int64).reshape(-1, 2), True


def overlap(a: Mask, b: Mask) -> float:
    """Return the intersection over union of two maps; 0 where both are empty."""
    return float(np.count_nonzero(a & b)) / max(float(np.count_nonzero(a | b)), 1.0)


def standing_overlap(a: Mask, b: Mask) -> float:
    """Return `overlap` of two maps without the layers that are floor in both; 1 where nothing else
    is there."""
    floor = np.minimum(a.mean(axis=(0, 1)), b.mean(axis=(0, 1))) >= FLOOR_SHARE
    a, b = a[:, :, ~floor], b[:, :, ~floor]
    return overlap(a, b) if a.any() or b.any() else 1.0


DIGEST_BYTES = 32
"""Length of a world's digest."""
MOST_OPEN = 100
"""This many shards are open at once at most."""
SECONDS_A_PAIR = 1.0
"""Comparing samples may take so much longer for every pair, seconds."""
Place = tuple[int, int]
"""A sample: number of its shard, row in it."""


def _digest_worlds(worlds: Worlds, page: Page) -> None:
    digests, numbers = list[bytes](), list[int]()
    for number in sorted(worlds.documents):
        page.count(worlds=1)
        try:
            if worlds.task.quick:
                digests.append(worlds.outlines[number])
            elif isinstance(solids := worlds.compile(number), VoxelMap):
                digests.append(map_digest(solids))
            else:
                digests.append(geometry_digest(solids))
            numbers.append(number)
        except BrokenError as error:
            page.fault(str(error))
    page.kept.append(
        (worlds.task.number, b"".join(digests), np.array(numbers, np.int32))
    )  # there may be millions


def _in_one_split(contract: Manifest, page: Page) -> None:
    if not page.kept:
        return
    digests = np.frombuffer(b"".join(some for _, some, _ in page.kept), f"S{DIGEST_BYTES}")
    worlds = np.concatenate([of for _, _, of in page.kept])
    shards = np.repeat([shard for shard, _, _ in page.kept], [len(of) for _, _, of in page.kept])
    splits = [entry.split for entry in contract.shards]
    order = np.argsort(digests, kind="stable")  # the same ones stay in the order of shards
    for n in np.flatnonzero(digests[order[1:]] == digests[order[:-1]]):
        first, second = order[n : n + 2]
        ours, theirs = splits[shards[second]], splits[shards[first]]
        page.expect(
            ours == theirs,
            f"world {worlds[second]} of {ours} has the same solids as world {worlds[first]} of "
            f"{theirs}, expected another one",
        )


def _keep_signature(sample: Sample, page: Page) -> None:
    if sample.shard.places[sample.row] % sample.shard.task.twins_of:
        return
    occupancy, observed = sample.fields["occupancy"], sample.fields["observed"]
    signs = signature(occupancy), fold(observed), int(np.count_nonzero(observed))
    page.kept.append(((sample.shard.task.number, sample.row), *signs))


def _compare(contract: Manifest, page: Page) -> None:
    if not page.kept:
        return
    places, signatures, folds, returns = zip(*page.kept, strict=True)
    page.count(samples=len(places))
    splits = np.array([SPLITS.index(contract.shards[number].split) for number, _ in places])
    pairs, complete = candidates(np.array(signatures), np.array(folds), np.array(returns), splits)
    page.count(**{"pairs alike enough to compare": len(pairs)})
    shards = {
        number: (contract.folder / entry.file, entry.samples, contract.home(entry).layout)
        for number in {places[sample][0] for sample in pairs.flat}
        for entry in (contract.shards[number],)
    }
    named_pairs = [(places[a], places[b]) for a, b in pairs]
    with raised_as(BrokenError, "comparing samples voxel by voxel ", of=GuardError):
        twins = guarded(
            _find_twins,
            (shards, named_pairs),
            seconds=GUARD_S + SECONDS_A_PAIR * len(pairs),
            memory_bytes=GUARD_BYTES,
        )
    for one, other, occupied_iou, seen_iou in twins:
        page.fault(
            f"{contract.shards[one[0]].file}: sample {one[1]} shows the map of "
            f"{contract.shards[other[0]].file}: sample {other[1]} (occupied IoU "
            f"{occupied_iou:.3f}, observed {seen_iou:.3f}), expected another world"
        )
    if not complete and not twins:
        page.skipped = f"too many maps are alike: {len(pairs)} pairs were compared, not all"


def _find_twins(
    task: tuple[dict[int, tuple[Path, int, Layout]], list[tuple[Place, Place]]],
) -> list[tuple[Place, Place, float, float]]:
    """The pairs of samples that are near-twins, with the overlap of their occupied and of their
    observed voxels. Opens the shards again, which is not for `verify`'s own process to do."""
    shards, pairs = task

    @functools.lru_cache(maxsize=MOST_OPEN)
    def opened(number: int) -> ShardFile:
        return open_shard(*shards[number])

    def maps(name: str, *places: Place) -> Any:
        return [opened(number).value(name, row) for number, row in places]

    twins = []
    for pair in pairs:
        seen_iou = overlap(*maps("observed", *pair))
        if seen_iou < OBSERVED_IOU:
            continue
        truths = maps("occupancy", *pair)
        occupied_iou = overlap(*truths)
        if occupied_iou >= OCCUPIED_IOU and standing_overlap(*truths) >= STANDING_IOU:
            twins.append((*pair, occupied_iou, seen_iou))
    return twins


CHECKS = (
    Check(name="splits", quick=True, archive=_digest_worlds, folder=_in_one_split),
    Check(name="near-twins", sample=_keep_signature, folder=_compare),
)
