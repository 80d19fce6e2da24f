"""The check that no sample shows next to the same map, seen next to the same way, as a sample of another split."""

from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from scenegen import SPLITS
from scenegen.dataset.layout import ShardFile, open_file, open_shard
from scenegen.verify import twins
from scenegen.verify.check import Check
from scenegen.verify.contract import Contract
from scenegen.verify.report import Page
from scenegen.verify.stages import Sample

MOST_OPEN = 100
"""Shards that are open at once."""


def _keep_signature(sample: Sample, page: Page) -> None:
    occupancy, observed = sample.fields["occupancy"], sample.fields["observed"]
    signs = twins.signature(occupancy), twins.fold(observed), int(np.count_nonzero(observed))
    page.kept.append(((sample.shard.task.number, sample.row), *signs))


def _compare(contract: Contract, page: Page) -> None:
    if not page.kept:
        return
    places, signatures, folds, observed = zip(*page.kept, strict=True)
    page.count(samples=len(places))
    splits = np.array([SPLITS.index(contract.shards[number].split) for number, _ in places])
    pairs, complete = twins.candidates(np.array(signatures), np.array(folds), np.array(observed), splits)
    page.count(compared=len(pairs))
    found = 0
    with _Maps(contract) as maps:
        for a, b in pairs:
            one, other = places[int(a)], places[int(b)]
            seen = twins.overlap(maps.of("observed", *one), maps.of("observed", *other))
            if seen < twins.OBSERVED_IOU:
                continue
            truths = maps.of("occupancy", *one), maps.of("occupancy", *other)
            occupied = twins.overlap(*truths)
            if occupied >= twins.OCCUPIED_IOU and twins.standing_overlap(*truths) >= twins.STANDING_IOU:
                found += 1
                page.fault(
                    f"{contract.shards[one[0]].file}: sample {one[1]} shows the map of "
                    f"{contract.shards[other[0]].file}: sample {other[1]} (occupied IoU {occupied:.3f}, observed "
                    f"{seen:.3f}), expected another world"
                )
    if not complete and not found:
        page.skipped = f"too many maps are alike: {len(pairs)} pairs were compared, not all"


class _Maps:
    """Grids of any samples of a folder; its files stay open."""

    def __init__(self, contract: Contract):
        self._contract = contract
        self._files = ExitStack()
        self._shards: dict[int, ShardFile] = {}

    def __enter__(self) -> "_Maps":
        return self

    def __exit__(self, *error: object) -> None:
        self._files.close()

    def of(self, field: str, number: int, row: int) -> NDArray[np.bool_]:
        """A grid of sample `row` of shard `number`. Raises BrokenError."""
        if number not in self._shards:
            if len(self._shards) >= MOST_OPEN:
                self._files.close()
                self._shards.clear()
            entry = self._contract.shards[number]
            path = self._contract.folder / entry.file
            file = self._files.enter_context(open_file(path))
            self._shards[number] = open_shard(file, path, entry.samples, self._contract.layout)
        return self._shards[number].value(field, row)


NEAR_TWINS = Check(
    name="near-twins",
    proves="No two samples of different splits show nearly the same map, seen nearly the same way: their occupied voxels "
    "agree to less than 90 % (intersection over union), or their observed voxels to less than 50 %, or what stands on "
    "the floor to less than 50 %.",
    sample=_keep_signature,
    folder=_compare,
)

CHECKS = (NEAR_TWINS,)
