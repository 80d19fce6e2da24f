"""Checks that splits share nothing: no world, and no map that looks nearly the same."""

import functools

import numpy as np

from scenegen import SPLITS
from scenegen.dataset.layout import ShardFile, open_file, open_shard
from scenegen.verification import twins
from scenegen.verification.check import Check
from scenegen.verification.contract import Contract
from scenegen.verification.report import BrokenError, Page
from scenegen.verification.stages import Sample, Worlds
from scenegen.worlds.geometry import geometry_digest

DIGEST_BYTES = 32
"""Length of a world's digest."""
MOST_OPEN = 100
"""This many shards are open at once at most."""


def _digest_worlds(worlds: Worlds, page: Page) -> None:
    digests, numbers = list[bytes](), list[int]()
    for number in sorted(worlds.archive.documents):
        page.count(worlds=1)
        try:
            digest = (
                worlds.archive.outlines[number]
                if worlds.task.quick
                else geometry_digest(worlds.compile(number))
            )
        except BrokenError as error:
            page.fault(str(error))
            continue
        digests.append(digest)
        numbers.append(number)
    page.kept.append(
        (worlds.task.number, b"".join(digests), np.array(numbers, np.int32))
    )  # there may be millions


def _shared(contract: Contract, page: Page) -> list[tuple[int, bytes, int]]:
    """(shard, digest, number) of all worlds whose digest is in more than one split, in the order of
    shards."""
    digests = np.frombuffer(b"".join(some for _, some, _ in page.kept), f"S{DIGEST_BYTES}")
    numbers = np.concatenate([of for _, _, of in page.kept])
    shards = np.repeat([shard for shard, _, _ in page.kept], [len(of) for _, _, of in page.kept])
    splits = np.array([SPLITS.index(entry.split) for entry in contract.shards])[shards]
    _, first, same = np.unique(digests, return_index=True, return_inverse=True)
    apart = np.zeros(len(first), np.bool_)
    apart[same[splits != splits[first][same]]] = True
    return [
        (int(shards[n]), bytes(digests[n]), int(numbers[n])) for n in np.flatnonzero(apart[same])
    ]


def _in_one_split(contract: Contract, page: Page) -> None:
    owner: dict[bytes, tuple[str, int]] = {}
    found = _shared(contract, page) if page.kept else []
    first = {
        (shard, digest): world for shard, digest, world in reversed(found)
    }  # told once a shard
    for shard, digest, world in found:
        if first[shard, digest] != world:
            continue
        split = contract.shards[shard].split
        other, theirs = owner.setdefault(digest, (split, world))
        page.expect(
            other == split,
            f"world {world} of {split} has the same solids as world {theirs} of {other}, expected "
            f"another one",
        )


def _keep_signature(sample: Sample, page: Page) -> None:
    if sample.shard.places[sample.row] % sample.shard.task.twins_of:
        return
    occupancy, observed = sample.fields["occupancy"], sample.fields["observed"]
    signs = twins.signature(occupancy), twins.fold(observed), int(np.count_nonzero(observed))
    page.kept.append(((sample.shard.task.number, sample.row), *signs))


def _compare(contract: Contract, page: Page) -> None:
    if not page.kept:
        return
    places, signatures, folds, observed = zip(*page.kept, strict=True)
    page.count(samples=len(places))
    splits = np.array([SPLITS.index(contract.shards[number].split) for number, _ in places])
    pairs, complete = twins.candidates(
        np.array(signatures), np.array(folds), np.array(observed), splits
    )
    page.count(compared=len(pairs))
    found = 0

    @functools.lru_cache(maxsize=MOST_OPEN)
    def opened(number: int) -> ShardFile:
        entry = contract.shards[number]
        path = contract.folder / entry.file
        return open_shard(open_file(path), path, entry.samples, contract.layout)

    for one, other in ((places[a], places[b]) for a, b in pairs):
        seen = twins.overlap(
            *(opened(number).value("observed", row) for number, row in (one, other))
        )
        if seen < twins.OBSERVED_IOU:
            continue
        truths = [opened(number).value("occupancy", row) for number, row in (one, other)]
        occupied = twins.overlap(*truths)
        if occupied >= twins.OCCUPIED_IOU and twins.standing_overlap(*truths) >= twins.STANDING_IOU:
            found += 1
            page.fault(
                f"{contract.shards[one[0]].file}: sample {one[1]} shows the map of "
                f"{contract.shards[other[0]].file}: sample {other[1]} (occupied IoU "
                f"{occupied:.3f}, observed "
                f"{seen:.3f}), expected another world"
            )
    if not complete and not found:
        page.skipped = f"too many maps are alike: {len(pairs)} pairs were compared, not all"


CHECKS = (
    Check(
        name="splits",
        proves="No two splits share a world, however its solids are named, grouped in bodies and "
        "ordered (with "
        "`--quick`: however the elements of its MJCF are named, coloured and ordered).",
        quick=True,
        archive=_digest_worlds,
        folder=_in_one_split,
    ),
    Check(
        name="near-twins",
        proves="No two samples of different splits show nearly the same map, seen nearly the same "
        "way: their occupied "
        "voxels agree to less than 90 % (intersection over union), or their observed voxels to "
        "less than 50 %, or "
        "what stands on the floor to less than 50 %; of more than 200,000 samples, so many, "
        "evenly spread, are "
        "compared.",
        sample=_keep_signature,
        folder=_compare,
    ),
)
