"""Checks of the manifest, and of files as a whole: can they be read, and are they what the manifest
lists?"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from scenegen.dataset import manifest
from scenegen.dataset.trust import Manifest
from scenegen.files import sha256_in, world_digest
from scenegen.verification.report import Page
from scenegen.verification.stages import Check, Shard, SignedFile, Worlds


def _written_for_these_parameters(shard: Shard, page: Page) -> None:
    page.kept.append(shard.rejected)
    page.expect(
        shard.file.attributes["parameters"] == shard.task.contract.fingerprint,
        f"{shard.task.entry.file}: was written for other parameters than the manifest's: one of "
        "the two was edited, or the shard is another dataset's",
    )


def _rejections_add_up(contract: Manifest, page: Page) -> None:
    if len(page.kept) < len(contract.shards):
        return  # a shard could not be read: a fault of another check
    for what in ("worlds", "viewpoints"):
        total: Counter[str] = Counter()
        for rejected in page.kept:
            total.update(rejected[what])
        page.expect(
            dict(total) == contract.rejected[what],
            f"{manifest.NAME}: rejected.{what} = {contract.rejected[what]}, the shards count "
            f"{dict(total)}",
        )


MANIFEST = Check(
    name="manifest",
    proves="Every value in `dataset.json` has the type and bounds of the format; its shards have "
    "plain names, follow in order, hold what `counts` asks for, were written for its parameters "
    "and reject what it says; no other `.h5` or `.zip` file lies in the folder.",
    quick=True,
    shard=_written_for_these_parameters,
    folder=_rejections_add_up,
)
"""`read_contract` examines the manifest itself, before all else."""


EXAMINED = Check(
    name="examined",
    proves="Every shard could be examined to the end, within its limits of time and memory.",
    quick=True,
)
"""`verify` counts, and writes the faults: it sees the processes end."""


def _same_sum(signed: SignedFile, page: Page) -> None:
    found = sha256_in(signed.file)
    page.count(files=1)
    page.expect(
        found == signed.sha256,
        f"{signed.name}: SHA-256 {found[:16]}…, the manifest lists {signed.sha256[:16]}…",
    )


CHECKSUMS = Check(
    name="checksums",
    proves="Every shard and every archive has the SHA-256 that the manifest lists.",
    quick=True,
    file=_same_sum,
)


LAYOUT = Check(
    name="layout",
    proves="A shard holds the fields of the format and nothing else, in their types and shapes: "
    "hard links alone, no data in other files, no filter but gzip, shuffle and fletcher32, one "
    "chunk a sample, no byte between; every chunk unpacks to just its size (with `--quick`, every "
    "chunk but those of `tudf` and `free`).",
    quick=True,
)
"""The walk over a shard writes the faults: opening the file and unpacking its samples is the
examination."""


def _expected_worlds(worlds: Worlds, page: Page) -> None:
    task, there = worlds.task, sorted(worlds.documents)
    entry = task.entry
    numbering = task.contract.numbering(entry.split)
    expected = list(numbering.worlds(entry.start, entry.stop - entry.start))
    if entry.cut:  # the shard's samples say which, see below
        expected = [number for number in there if number in set(expected)] or expected
    page.expect(
        there == expected,
        f"{entry.worlds}: holds worlds {_spans(there)}, its samples are of {_spans(expected)}",
    )
    page.expect(
        entry.first_world == expected[0],
        f"{entry.file}: first_world = {entry.first_world}, its samples begin with {expected[0]}",
    )
    if task.contract.scenes is None:
        return
    listed = task.contract.scenes[entry.split]
    for number in worlds.documents:
        page.expect(
            world_digest(*worlds.source(number)).hex()
            == (listed[number].get("sha256") if number < len(listed) else None),
            f"{entry.worlds}: {number:06d}.xml is not the world that the manifest's "
            f"recipe.scenes names",
        )


def _worlds_of_samples(shard: Shard, page: Page) -> None:
    entry = shard.task.entry
    if not entry.cut or shard.worlds is None:
        return
    there, found = sorted(shard.worlds.documents), np.unique(shard.file.column("world")).tolist()
    page.expect(
        there == found,
        f"{entry.worlds}: holds worlds {_spans(there)}, its samples are of {_spans(found)}",
    )


def _spans(numbers: Sequence[int]) -> str:
    return f"{numbers[0]} to {numbers[-1]} ({len(numbers)})" if numbers else "none"


ARCHIVES = Check(
    name="archives",
    proves="An archive has plain member names, bounded sizes and self-contained MJCF, and holds "
    "just the worlds of "
    "its shard's samples; worlds from your own MJCF are those that the recipe names.",
    quick=True,
    archive=_expected_worlds,
    shard=_worlds_of_samples,
)
"""The walk over a shard adds the faults of an archive that cannot be read."""

CHECKS = (MANIFEST, EXAMINED, CHECKSUMS, LAYOUT, ARCHIVES)
