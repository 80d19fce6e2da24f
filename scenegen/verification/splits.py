"""Checks that splits share no world, and no nearly equal maps; and the search for such
near-duplicates."""

import functools
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.engines.voxels import VoxelMap
from lidarsim.grid import Floats, Ints, Mask
from scenegen import SPLITS
from scenegen.base.errors import CorruptFileError, GuardError, printable, reraise_as
from scenegen.base.limits import GUARD_BYTES, GUARD_S
from scenegen.base.workers import guarded
from scenegen.dataset.layout import Layout, ShardFile, open_shard
from scenegen.dataset.manifest import Manifest
from scenegen.verification.check import Check, RawSample, Worlds
from scenegen.verification.report import Page
from scenegen.worlds.place import map_digest
from scenegen.worlds.world import geometry_digest

OCCUPIED_IOU = 0.9
"""Minimum intersection over union of the occupied voxels of near-duplicates."""
OBSERVED_IOU = 0.5
"""Minimum intersection over union of the observed voxels of near-duplicates. Occupied voxels alone
do not decide: two nearly empty worlds have the same flat floor, but from another height and
heading, rays hit other parts of it."""
STANDING_IOU, FLOOR_SHARE = 0.5, 0.95
"""Near-duplicates also need this intersection over union of what stands on the floor; a layer is
floor if both maps fill at least the second number of it. Nearly empty floors may by chance be
observed alike; what stands on them then distinguishes them."""
MAX_COMPARED = 5_000
"""Maximum number of pairs that are compared voxel by voxel."""
MAX_TWINS = 20_000
"""Maximum number of samples in the search, evenly spread. Each takes 2.5 KB of memory until the
end, and is compared with thousands of others."""
BLOCKS = (8, 8, 5)
"""Number of blocks of a map along x, y and z."""


def signature(mask: Mask) -> NDArray[np.int32]:
    """Count the true voxels in each of 8 x 8 x 5 blocks of a map. Returns a flat array (320,)."""
    sums, blocks = mask, np.zeros(BLOCKS, np.int32)
    for axis in (2, 1, 0):  # contiguous axis first: it is the fastest, and shrinks the array
        count, parts = mask.shape[axis], BLOCKS[axis]
        # rounded up, so that there are `parts` blocks at most
        begins = range(0, count, -(-count // parts))
        sums = np.add.reduceat(sums, begins, axis=axis, dtype=np.int32)
    # small maps have fewer blocks; the others stay 0
    blocks[tuple(map(slice, sums.shape))] = sums
    return blocks.reshape(-1)


def candidates(
    occupied: NDArray[np.int32], observed: NDArray[np.int32], splits: Ints
) -> tuple[Ints, bool]:
    """Find pairs of samples in different splits that may be near-duplicates.

    The common voxels of two maps are at most the smaller count of each block, which bounds their
    intersection over union. Samples are sorted by the number of occupied voxels, so that only
    neighbours are compared.

    Args:
        occupied: `signature` of each sample's occupied voxels, (n, 320).
        observed: The same of its observed voxels, (n, 320).
        splits: Number of each sample's split, (n,).

    Returns:
        Pairs (P, 2), and whether all were found.
    """
    counts = occupied.sum(axis=1, dtype=np.int64)
    order = np.argsort(counts, kind="stable")
    ends = np.searchsorted(OCCUPIED_IOU * counts[order], counts[order], side="right")
    pairs = list[tuple[int, int]]()
    for place, sample in enumerate(order.tolist()):
        if not counts[sample]:
            continue  # an empty map has no twin
        # `ends`: maps with many more occupied voxels cannot reach the IoU
        neighbours = order[place + 1 : ends[place]]
        neighbours = neighbours[splits[neighbours] != splits[sample]]
        for blocks, min_iou in ((occupied, OCCUPIED_IOU), (observed, OBSERVED_IOU)):
            common = np.minimum(blocks[neighbours], blocks[sample]).sum(axis=1)
            union = np.maximum(blocks[neighbours], blocks[sample]).sum(axis=1)
            # 1e-9: rounding must not exclude a pair
            neighbours = neighbours[common >= (min_iou - 1e-9) * union]
        pairs += [(sample, neighbour) for neighbour in neighbours.tolist()]
        if len(pairs) > MAX_COMPARED:
            return np.array(pairs[:MAX_COMPARED]), False
    return np.array(pairs, np.int64).reshape(-1, 2), True


def overlap(a: Mask, b: Mask) -> float:
    """Intersection over union of two maps; 0 if both are empty.

    Args:
        a: Mask of the first map.
        b: Mask of the second map, of the same shape.
    """
    return float(np.count_nonzero(a & b)) / max(float(np.count_nonzero(a | b)), 1.0)


def standing_overlap(a: Mask, b: Mask) -> float:
    """`overlap` of two maps without the layers that are floor in both; 1 if both are empty then.

    Args:
        a: Mask of the first map.
        b: Mask of the second map, of the same shape.
    """
    floor = np.minimum(a.mean(axis=(0, 1)), b.mean(axis=(0, 1))) >= FLOOR_SHARE
    a, b = a[:, :, ~floor], b[:, :, ~floor]
    return overlap(a, b) if a.any() or b.any() else 1.0


DIGEST_BYTES = 32
"""Length of a world's digest, bytes."""
MAX_OPEN = 100
"""Maximum number of open shards."""
SECONDS_A_PAIR = 1.0
"""Additional time for the comparison of a pair, seconds."""
SampleKey = tuple[int, int]
"""A sample: number of its shard, and its row."""


def _digest_worlds(worlds: Worlds, page: Page) -> None:
    digests, numbers, boxes = list[bytes](), list[int](), dict[int, Floats]()
    for number in sorted(worlds.documents):
        page.count(worlds=1)
        try:
            if worlds.task.quick:
                # quick checks compile no world
                digests.append(worlds.outlines[number])
            elif isinstance(solids := worlds.compile(number), VoxelMap):
                digests.append(map_digest(solids))
                boxes[number] = solids.bounds
            else:
                digests.append(geometry_digest(solids))
            numbers.append(number)
        except CorruptFileError as error:
            page.fault(str(error))
    # joined to one value: there may be millions of worlds
    page.kept.append((worlds.task.number, b"".join(digests), np.array(numbers, np.int32), boxes))


def world_digests(contract: Manifest, page: Page) -> Iterator[tuple[str, bytes]]:
    """Digests of all examined worlds.

    Args:
        contract: Manifest of the dataset.
        page: Page of the check `splits`.

    Yields:
        The split and the digest of each world.
    """
    for number, digests, *_ in page.kept:
        for first in range(0, len(digests), DIGEST_BYTES):
            yield contract.shards[number].split, digests[first : first + DIGEST_BYTES]


def _in_one_split(contract: Manifest, page: Page) -> None:
    if not page.kept:
        return
    # as texts, which NumPy sorts whole; it drops trailing zeros, but of all alike
    digests = np.frombuffer(
        b"".join(shard_digests for _, shard_digests, *_ in page.kept), f"S{DIGEST_BYTES}"
    )
    worlds = np.concatenate([numbers for _, _, numbers, _ in page.kept])
    shards = np.repeat(
        [shard for shard, *_ in page.kept], [len(numbers) for _, _, numbers, _ in page.kept]
    )
    splits = [entry.split for entry in contract.shards]
    order = np.argsort(digests, kind="stable")  # equal digests stay in the order of shards
    # equal digests are neighbours in this order
    for n in np.flatnonzero(digests[order[1:]] == digests[order[:-1]]):
        first, second = order[n : n + 2]
        split, first_split = splits[shards[second]], splits[shards[first]]
        page.expect(
            split == first_split,
            f"world {worlds[second]} of {split} has the same solids as world {worlds[first]} of "
            f"{first_split}, expected another one",
        )
    _regions_apart(contract, page)


def _regions_apart(contract: Manifest, page: Page) -> None:
    """Compare maps of one file in different splits: no voxel of a sample may reach into both."""
    boxes = {
        (listed[number].file, contract.shards[shard].split): box
        for shard, _, _, shard_boxes in page.kept
        for listed in ((contract.scenes or {}).get(contract.shards[shard].split, []),)
        for number, box in shard_boxes.items()
        if number < len(listed)
    }
    for (first, second), (box, other) in zip(
        itertools.combinations(boxes, 2), itertools.combinations(boxes.values(), 2), strict=True
    ):
        gap_m = np.maximum(box[0] - other[1], other[0] - box[1]).max()
        page.expect(
            first[0] != second[0] or gap_m > contract.grid.voxel_m * (1 - 1e-9),
            f"the regions of {printable(first[0])} in {first[1]} and {second[1]} are {gap_m:.6g} m "
            f"apart, expected at least a voxel of {contract.grid.voxel_m:g} m",
        )


def _keep_signature(sample: RawSample, page: Page) -> None:
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
    with reraise_as(CorruptFileError, "comparing samples voxel by voxel ", of=GuardError):
        twins = guarded(
            _find_twins,
            (shards, named_pairs),
            seconds=GUARD_S + SECONDS_A_PAIR * len(pairs),
            memory_bytes=GUARD_BYTES,
        )
    for first, second, occupied_iou, seen_iou in twins:
        page.fault(
            f"{contract.shards[first[0]].file}: sample {first[1]} shows the map of "
            f"{contract.shards[second[0]].file}: sample {second[1]} (occupied IoU "
            f"{occupied_iou:.3f}, observed {seen_iou:.3f}), expected another world"
        )
    if not complete and not twins:
        page.skipped = f"too many maps are alike: {len(pairs)} pairs were compared, not all"


def _find_twins(
    task: tuple[dict[int, tuple[Path, int, Layout]], list[tuple[SampleKey, SampleKey]]],
) -> list[tuple[SampleKey, SampleKey, float, float]]:
    """Compare pairs of samples. Returns near-duplicates with the overlap of their occupied and
    observed voxels.

    It opens untrusted shards, which the process of `verify` must not do.
    """
    shards, pairs = task

    @functools.lru_cache(maxsize=MAX_OPEN)
    def opened(number: int) -> ShardFile:
        return open_shard(*shards[number])

    def maps(name: str, *places: SampleKey) -> Any:
        return [opened(number).value(name, row) for number, row in places]

    twins = []
    for pair in pairs:
        # observed voxels first: maps of flat floor agree in what is occupied, and seldom in these
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
