"""Checks that repeat randomly chosen samples: their scans, and everything from the seed on."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from lidarsim import Scan
from lidarsim.engines import ENGINES, Caster
from lidarsim.grid import Floats, Ints
from lidarsim.noise import VERSION
from scenegen import GENERATOR
from scenegen.base.errors import (
    CorruptFileError,
    GenerationError,
    RecipeError,
    SceneError,
    reraise_as,
)
from scenegen.base.executors import software
from scenegen.dataset.like import scan_again
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.parameters import differences
from scenegen.draw.draw import Unit, UnitKey, draw_unit, scans_from, with_noise
from scenegen.draw.movers import ray_times
from scenegen.draw.sample import FIELDS, rng_of
from scenegen.draw.source import DrawnWorlds, SceneWorlds
from scenegen.verification.check import Check, RawSample, Shard, Worlds, auditor, scans_of, times_of
from scenegen.verification.rays import audit, disagrees
from scenegen.verification.report import Page
from scenegen.worlds.place import Place
from scenegen.worlds.recipe import Recipe
from scenegen.worlds.world import AnyWorld


@dataclass(frozen=True, eq=False, kw_only=True)
class ArchivedWorlds(SceneWorlds):
    """Worlds from files, read from a shard's archive; `scenes` only counts them."""

    worlds: Worlds

    def world(self, split: str, number: int, *, rng: np.random.Generator) -> AnyWorld:
        """Read a world; see `Source.world`.

        Returns:
            The world.
        """
        return self.worlds.world(number)


Views = list[tuple[int, int]]
"""Samples of one flight: row in the shard, and position on the flight."""


def _flown_again(shard: Shard, unit: int, views: Views) -> Unit:
    """Draw a flight again; or, if the dataset was scanned again from another one, scan it from its
    stored poses.

    Call it only if `why_not_made` is empty. Raises CorruptFileError if it fails.
    """
    contract, split, worlds = shard.task.contract, shard.task.entry.split, shard.worlds
    assert worlds is not None
    recipe: Recipe = contract.recipe
    scenes: Any = contract.scenes
    key, engine = UnitKey(contract.seed, split, unit), ENGINES.find(contract.engine).of
    errors = (GenerationError, RecipeError, SceneError)
    with reraise_as(CorruptFileError, f"{split} flight {unit} cannot be made again: ", of=errors):
        if contract.like is not None:
            with reraise_as(CorruptFileError, f"{shard.task.entry.file}: "):
                stored = [partial(shard.file.value, row=row) for row, _ in views]
                poses = [[scan.pose for scan in scans_of(contract, fields)] for fields in stored]
                times = [times_of(contract, fields) for fields in stored]
            names = contract.numbering(split).name(unit * recipe.flight.viewpoints)
            world = worlds.world(names[0])
            return scan_again(world, poses, times, recipe, key, names=names, engine=engine)
        source = (
            DrawnWorlds(recipe) if scenes is None else ArchivedWorlds(scenes=scenes, worlds=worlds)
        )
        return draw_unit(source, recipe, **key._asdict(), engine=engine)


def why_not_made(contract: Manifest) -> str:
    """Why flights cannot be made again here; "" if they can."""
    if not contract.is_drawn and contract.scenes is None and contract.like is None:
        advice = "; if it is yours, give --kind with its name" if ":" in contract.kind else ""
        return (
            f"kind {contract.kind!r} is none of scenegen's own: its worlds cannot be drawn again"
            f"{advice}"
        )
    return why_not_scanned(contract)


def why_not_scanned(contract: Manifest) -> str:
    """Why archived worlds cannot be scanned again here; "" if they can."""
    if not contract.noise_is_ours:
        return "made with noise that is not scenegen's own, so it is not imported"
    if contract.engine not in ENGINES.builtin:
        return (
            f"made with the engine {contract.engine!r}, which is not scenegen's own, so it is not "
            "imported"
        )
    lacking = getattr(ENGINES.find(contract.engine), "missing", str)()
    return f"made with the engine {contract.engine!r}, which {lacking}" if lacking else ""


def why_other(contract: Manifest) -> str:
    """Why repeated samples may differ in bits from the dataset; "" if they must be equal."""
    if contract.generator != GENERATOR:
        return f"made by generator {contract.generator}, here is generator {GENERATOR}"
    if contract.noise is not None and (noise_version := contract.noise.version) != VERSION:
        return f"made with noise of version {noise_version}, here is version {VERSION}"
    differing = differences(dict(contract.software), software(), ("there", "here"))
    stored_version, version = contract.tables.version, contract.recipe.version
    if contract.is_drawn and stored_version != version:
        differing.append(f"recipe.version is {stored_version} there, {version} here")
    return f"made with other software: {', '.join(differing)}" if differing else ""


def _cast_again(sample: RawSample, page: Page) -> None:
    if (world := sample.audited) is None:
        return
    lidar, scans = sample.contract.lidar, sample.scans
    if sample.contract.noise is not None:
        if why := why_not_scanned(sample.contract):
            page.skipped = f"the noise cannot be made again, {why}"
            return
        # noise hides the clean ranges: make them again, and audit these
        scans = _scanned_again(sample, world, page)
    page.count(samples=1)
    for number, scan in enumerate(scans):
        begin_s = float(sample.times_s[number])
        times_s = np.broadcast_to(
            ray_times(sample.contract.recipe.traffic, lidar, begin_s), lidar.shape
        )
        rays, ranges_again, gap = audit(
            scan.ranges,
            scan.pose.position,
            scan.pose.quaternion,
            partial(_auditor, sample, world, times_s),
            lidar,
            solids=_effort(world, lidar.max_range_m),
            rng=sample.shard.rng,
            times_s=times_s,
        )
        wrong = disagrees(gap, ranges_again, lidar.max_range_m)
        page.count(rays=len(rays))
        page.note_greatest("greatest difference in m", float(gap[~wrong].max(initial=0.0)))
        if wrong.any():
            # the worst ray is reported
            n = int(np.flatnonzero(wrong)[np.argmax(gap[wrong])])
            ray = tuple(int(at) for at in np.unravel_index(rays[n], lidar.shape))
            scan_name = f", earlier scan {number}" if number else ""
            page.fault(
                f"{sample.where}{scan_name}: {np.count_nonzero(wrong)} of {len(rays)} rays differ; "
                f"ray {ray} has {scan.ranges[ray]} m, the solids of world {sample.world} are "
                f"{ranges_again[n]:.7g} m away"
            )


def _auditor(sample: RawSample, world: AnyWorld, times_s: Floats, rays: Ints) -> Caster:
    """Auditor of rays (n,) of a scan whose rays have times (*lidar.shape)."""
    return auditor(world, sample.contract.engine, times_s.reshape(-1)[rays])


def _effort(world: AnyWorld, max_range_m: float) -> int:
    """Number of solids that the auditor tries for a ray; for a map, a number that takes the same
    time."""
    if isinstance(world, Place):
        return math.ceil(300 * max_range_m / world.voxels.voxel_m)
    return len(world.solids.shape) + len(world.solids.triangles)


def _scanned_again(sample: RawSample, world: AnyWorld, page: Page) -> list[Scan]:
    """Clean scans of a noisy sample by the dataset's own engine. With noise added, they must equal
    the stored scans if the software is the same. Raises CorruptFileError."""
    task, contract = sample.shard.task, sample.contract
    engine = ENGINES.find(contract.engine).of  # one of ours
    unit, view = divmod(sample.shard.first_place + sample.row, contract.recipe.flight.viewpoints)
    errors = (GenerationError, ValueError)
    with reraise_as(CorruptFileError, f"{sample.where}: cannot be scanned again: ", of=errors):
        poses, times_s = [scan.pose for scan in sample.scans], sample.times_s
        clean = scans_from(poses, times_s, world, engine, contract.recipe)
        key = UnitKey(contract.seed, task.entry.split, unit)
        seen = with_noise(clean, times_s, world, engine, contract.recipe, key, view)
    # compared by bits, so that inf equals inf and NaN itself
    wrong = sum(
        np.count_nonzero(again.ranges.view("<u4") != stored.ranges.view("<u4"))
        for again, stored in zip(seen, sample.scans, strict=True)
    )
    if wrong and (why := why_other(contract)):
        page.differ(why, samples=1)
    elif wrong:
        noise = contract.recipe.noise
        page.fault(f"{sample.where}: {wrong} ranges are not what its noise {noise} gives")
    return clean


def _fly_again(shard: Shard, page: Page) -> None:
    task = shard.task
    if shard.worlds is None:
        return
    if why := why_not_made(task.contract):
        page.skipped = why
        return
    # not `Shard.rng`, whose next numbers depend on the checks that are made
    rng = rng_of(task.seed, task.number, 1)
    try:
        flights = _flights(shard)
        # one flight for each shard, as drawing takes as long as it did at first
        _compare_flight(shard, *flights[int(rng.permutation(len(flights))[0])], page)
    except CorruptFileError as error:
        page.fault(str(error))
    # with other software, differences prove nothing
    if page.faults and (why := why_other(task.contract)):
        page.faults, page.listed = 0, []
        page.differ(why, flights=1)


def _flights(shard: Shard) -> list[tuple[int, Views]]:
    """Units with samples in the shard, and (row, view) of each sample. Raises CorruptFileError."""
    task = shard.task
    by_unit: dict[int, Views] = {}
    for row in range(task.entry.samples):
        unit, view = divmod(shard.first_place + row, task.contract.recipe.flight.viewpoints)
        by_unit.setdefault(unit, []).append((row, view))
    return list(by_unit.items())


def _compare_flight(shard: Shard, unit: int, views: Views, page: Page) -> None:
    """Make a unit again, and compare its world and samples, (row, view), bit for bit."""
    task = shard.task
    assert shard.worlds is not None
    again = _flown_again(shard, unit, views)
    page.count(worlds=1)
    page.expect(
        shard.worlds.documents.get(again.number) == again.world.mjcf,
        f"{task.entry.worlds}: {again.number:06d}.xml is not the world that the seed gives",
    )
    for row, view in views:
        page.count(samples=1)
        for name in task.contract.fields:
            expected = np.asarray(getattr(again.samples[view], name), FIELDS[name]["dtype"])
            if not page.expect(
                shard.file.value(name, row).tobytes() == expected.tobytes(),
                f"{task.entry.file}: sample {row}: {name} is not what the seed gives",
            ):
                break


CHECKS = (
    Check(name="rays", sample=_cast_again),
    Check(name="regenerated", shard=_fly_again),
)
