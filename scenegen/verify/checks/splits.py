"""The check that no world is in two splits."""

from scenegen.geometry import geometry_digest
from scenegen.verify.check import Check
from scenegen.verify.contract import Contract
from scenegen.verify.report import Page
from scenegen.verify.stages import World


def _digest_world(world: World, page: Page) -> None:
    page.count(worlds=1)
    worlds = world.worlds
    outline = worlds.archive.outlines[world.number] if worlds.task.quick else None
    digest = outline or geometry_digest(worlds.compile(world.number))
    page.kept.append((worlds.task.number, digest, world.number))


def _in_one_split(contract: Contract, page: Page) -> None:
    owner: dict[bytes, tuple[str, int]] = {}
    first = {(shard, digest): world for shard, digest, world in reversed(page.kept)}  # told once a shard
    for shard, digest, world in page.kept:
        if first[shard, digest] != world:
            continue
        split = contract.shards[shard].split
        other, theirs = owner.setdefault(digest, (split, world))
        page.expect(
            other == split,
            f"world {world} of {split} has the same solids as world {theirs} of {other}, expected another one",
        )


SPLITS = Check(
    name="splits",
    proves="No two splits share a world, however its solids are named, grouped in bodies and ordered (with `--quick`: "
    "however the elements of its MJCF are named, coloured and ordered).",
    quick=True,
    world=_digest_world,
    folder=_in_one_split,
)

CHECKS = (SPLITS,)
