"""Checks that splits share nothing: no world, and no map that looks nearly the same; and the search
for such near-twins."""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.engines.voxels import VoxelMap
from lidarsim.grid import Ints, Mask
from scenegen import SPLITS
from scenegen.base.errors import GuardError, raised_as
from scenegen.base.limits import GUARD_BYTES, GUARD_S
from scenegen.base.workers import guarded
from scenegen.dataset.layout import Layout, ShardFile, open_shard
from scenegen.dataset.manifest import Manifest
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
MOST_COMPARED = 5_000
"""This many pairs are compared voxel by voxel at most."""
MOST_TWINS = 20_000
"""This many samples are searched at most, evenly spread: each takes 2.5 KB of memory until all are
seen, and is held against thousands of others."""
BLOCKS = (8, 8, 5)
"""Blocks of a map along x, y and z."""


def signature(mask: Mask) -> NDArray[np.int32]:
    """Count the true voxels in each of 8 x 8 x 5 blocks of a map, flat (320,)."""
    sums, blocks = mask, np.zeros(BLOCKS, np.int32)
    for axis in (2, 1, 0):  # along the rows in memory first
        count, parts = mask.shape[axis], BLOCKS[axis]
        begins = range(0, count, -(-count // parts))
        sums = np.add.reduceat(sums, begins, axis=axis, dtype=np.int32)
    blocks[tuple(map(slice, sums.shape))] = sums
    return blocks.reshape(-1)


def candidates(
    occupied: NDArray[np.int32], observed: NDArray[np.int32], splits: Ints
) -> tuple[Ints, bool]:
    """Find the pairs of samples of two splits that may be near-twins.

    Two maps have at most as many voxels in common as the smaller count of each block allows, so
    that their blocks bound their intersection over union from above. Sorted by how much is
    occupied, only neighbours are looked at.

    Args:
        occupied: The `signature` of each sample's occupied voxels, (n, 320).
        observed: The same of its observed voxels, (n, 320).
        splits: The number of its split, (n,).

    Returns:
        The pairs (P, 2), and whether these are all: then none is missed.
    """
    counts = occupied.sum(axis=1, dtype=np.int64)
    order = np.argsort(counts, kind="stable")
    ends = np.searchsorted(OCCUPIED_IOU * counts[order], counts[order], side="right")
    pairs = list[tuple[int, int]]()
    for place, one in enumerate(order.tolist()):
        if not counts[one]:
            continue  # an empty map has no twin
        others = order[place + 1 : ends[place]]
        others = others[splits[others] != splits[one]]
        for blocks, least in ((occupied, OCCUPIED_IOU), (observed, OBSERVED_IOU)):
            common = np.minimum(blocks[others], blocks[one]).sum(axis=1)
            union = np.maximum(blocks[others], blocks[one]).sum(axis=1)
            others = others[common >= (least - 1e-9) * union]
        pairs += [(one, other) for other in others.tolist()]
        if len(pairs) > MOST_COMPARED:
            return np.array(pairs[:MOST_COMPARED]), False
    return np.array(pairs, np.int64).reshape(-1, 2), True


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


def world_digests(contract: Manifest, page: Page) -> Iterator[tuple[str, bytes]]:
    """The split and the digest of every world that was examined."""
    for number, digests, _ in page.kept:
        for first in range(0, len(digests), DIGEST_BYTES):
            yield contract.shards[number].split, digests[first : first + DIGEST_BYTES]


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
    if (sample.shard.first_place + sample.row) % sample.shard.task.twins_of:
        return
    occupancy, observed = sample.fields["occupancy"], sample.fields["observed"]
    place = sample.shard.task.number, sample.row
    page.kept.append((place, signature(occupancy), signature(observed)))


def _compare(contract: Manifest, page: Page) -> None:
    if not page.kept:
        return
    places, occupied, observed = zip(*page.kept, strict=True)
    page.count(samples=len(places))
    splits = np.array([SPLITS.index(contract.shards[number].split) for number, _ in places])
    pairs, complete = candidates(np.array(occupied), np.array(observed), splits)
    page.count(**{"pairs alike enough to compare": len(pairs)})
    shards = {
        number: (contract.folder / entry.file, entry.samples, contract.layout)
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
