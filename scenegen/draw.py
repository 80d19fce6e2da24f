"""One unit of work: a world is drawn, flown through and scanned, and its samples come out; or one
scan of one world."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lidarsim import AnalyticEngine, Engine, Pose, Scan, Sensor, cast, fuse
from lidarsim.engines import EngineFactory
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import Returns, albedo_of
from scenegen import SPLITS
from scenegen.errors import GenerationError, SceneError
from scenegen.recipe import Recipe
from scenegen.sample import Sample, earlier_fields, whole
from scenegen.source import Source, read_scenes
from scenegen.truth import distance_field, rasterize
from scenegen.worlds.flight import Flight, Viewpoints, plan, viewpoints
from scenegen.worlds.labels import labelled
from scenegen.worlds.noise import with_noise
from scenegen.worlds.world import World


@dataclass(frozen=True, eq=False)
class Rejections:
    """How many draws were not kept, by reason."""

    worlds: Counter[str] = field(default_factory=Counter)
    viewpoints: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, eq=False)
class Unit:
    """What one flight gave."""

    number: int
    """The world's number within its split."""
    world: World
    samples: tuple[Sample, ...]
    rejected: Rejections


def draw_unit(
    source: Source,
    recipe: Recipe,
    *,
    seed: int,
    split: str,
    unit: int,
    derived: bool = True,
    engine: EngineFactory = AnalyticEngine.of,
) -> Unit:
    """Samples of unit `unit` of `split`: they depend on the arguments alone, not on what was drawn
    before.

    `engine` makes what casts the rays of a world, which a world from an MJCF file shares among its
    flights. A draw that is rejected is made again under the same number. `derived` False leaves
    `tudf` out (an empty array stands in); `free` comes with `observed` anyway. Raises
    GenerationError after `recipe.accept.max_draws` draws.
    """
    rejected = Rejections()
    number, turn = source.number(split, unit)
    for attempt in range(recipe.accept.max_draws):
        world = source.world(split, number, rng=_stream(0, seed, split, unit, attempt))
        caster = engine_of(engine, world)
        views = _fly(world, caster, recipe, rejected, rng=flight_rng(seed, split, unit, attempt))
        if views:
            first = turn * recipe.flight.viewpoints
            samples = tuple(
                sample_of(
                    with_noise(
                        scans,
                        recipe.noise,
                        world,
                        caster,
                        seed=seed,
                        split=split,
                        unit=unit,
                        view=n,
                    ),
                    occupancy,
                    recipe,
                    world,
                    number=number,
                    viewpoint=first + n,
                    derived=derived,
                )
                for n, (scans, occupancy) in enumerate(views)
            )
            return Unit(number, world, samples, rejected)
    raise GenerationError(_hopeless(recipe, rejected, split, number))


def flight_rng(seed: int, split: str, unit: int, attempt: int) -> np.random.Generator:
    """What the flights of a draw of a unit are planned by."""
    return _stream(1, seed, split, unit, attempt)


def _stream(number: int, seed: int, split: str, unit: int, attempt: int) -> np.random.Generator:
    """One of the two streams of a draw: the world's, 0, and the flight's, 1."""
    spawned = np.random.SeedSequence(seed, spawn_key=(SPLITS.index(split), unit, attempt)).spawn(2)
    return np.random.default_rng(spawned[number])


@functools.lru_cache(maxsize=8)
def engine_of(engine: EngineFactory, world: World) -> Engine:
    """What casts the rays of `world`."""
    return engine(world.model, world.data)


def _fly(
    world: World, engine: Engine, recipe: Recipe, rejected: Rejections, *, rng: np.random.Generator
) -> list[tuple[list[Scan], np.ndarray]] | None:
    """Scans and occupancies from one flight's viewpoints, in flight order; None, with the reason
    counted, if the world yields no acceptable flight. Of a viewpoint's scans, the first is its own;
    the others were made before it."""
    reason = "no_flight"
    for _ in range(recipe.flight.flights_per_world):
        path = plan(world.clearance, world.flight_bounds, recipe.flight, rng=rng)
        if path is None:
            continue
        candidates = viewpoints(path, recipe.flight.spacing_m, rng=rng)
        if _solids_nearby(world, _middles(candidates, recipe), recipe) < recipe.accept.min_solids:
            reason = "few_solids"
            break
        kept: list[tuple[int, Scan, np.ndarray]] = []
        for n in range(len(candidates)):
            if _apart(candidates.positions[n], kept, recipe.flight.spacing_m):
                view = _look(world, engine, candidates.pose(n, recipe.mapping), recipe, rejected)
                if view is not None:
                    kept.append((n, *view))
            if len(kept) == recipe.flight.viewpoints:
                kept.sort(key=lambda view: candidates.flown_m[view[0]])
                return [
                    (
                        [scan, *scans_from(candidates.before(n, recipe.mapping), engine, recipe)],
                        occupancy,
                    )
                    for n, scan, occupancy in kept
                ]
        reason = "few_viewpoints"
    rejected.worlds[reason] += 1
    return None


def _look(
    world: World, engine: Engine, pose: Pose, recipe: Recipe, rejected: Rejections
) -> tuple[Scan, np.ndarray] | None:
    """The scan and the occupancy at a viewpoint; None, with the reason counted, where there is next
    to nothing."""
    (scan,) = scans_from([pose], engine, recipe)
    if (
        np.count_nonzero(np.isfinite(scan.ranges))
        < scan.ranges.size * recipe.accept.min_returned_share
    ):
        rejected.viewpoints["few_returns"] += 1
        return None
    occupancy = rasterize(world.solids, recipe.grid, recipe.mapping.origin(recipe.grid, pose))
    if np.count_nonzero(occupancy) < occupancy.size * recipe.accept.min_occupied_share:
        rejected.viewpoints["few_occupied"] += 1
        return None
    return scan, occupancy


def scans_from(poses: Sequence[Pose], engine: Engine, recipe: Recipe) -> list[Scan]:
    """The clean scans of the recipe's sensor from `poses`. Raises GenerationError where the engine
    fails."""
    try:
        return [cast(engine, recipe.lidar, pose) for pose in poses]
    except ValueError as error:
        raise GenerationError(f"the engine fails: {error}") from None


def sample_of(
    scans: Sequence[Scan],
    occupancy: np.ndarray,
    recipe: Recipe,
    world: World,
    *,
    number: int,
    viewpoint: int,
    derived: bool,
) -> Sample:
    """The record of one view: what its scans, its own first, show of the grid, and the truth."""
    own, *earlier = scans
    seen = fuse(
        scans[::-1], recipe.grid, recipe.mapping.origin(recipe.grid, own.pose), recipe.mapping
    )
    sample = whole(
        {
            "observed": seen.observed,
            "free": seen.free,
            "occupancy": occupancy,
            "tudf": distance_field(occupancy, recipe.grid) if derived else np.empty(0, np.float32),
            "ranges": own.ranges,
            "position": own.pose.position,
            "quaternion": own.pose.quaternion,
            "origin": seen.origin,
            "world": number,
            "viewpoint": viewpoint,
            **earlier_fields(earlier),
        }
    )
    return labelled(sample, world, recipe.lidar, recipe.grid, recipe.labels)


def _middles(candidates: Viewpoints, recipe: Recipe) -> np.ndarray:
    """The middles (m, 3) of the candidates' maps, world metres."""
    if recipe.mapping.centred:
        return candidates.positions
    corners = [
        recipe.mapping.origin(recipe.grid, candidates.pose(n)) for n in range(len(candidates))
    ]
    return np.array(corners).reshape(-1, 3) + recipe.grid.extent_m / 2


def _apart(
    position: np.ndarray, kept: list[tuple[int, Scan, np.ndarray]], spacing_m: float
) -> bool:
    """Whether a position keeps the least distance from all kept ones."""
    return all(
        ((position - scan.pose.position) ** 2).sum() >= spacing_m * spacing_m for _, scan, _ in kept
    )


def _solids_nearby(world: World, positions: np.ndarray, recipe: Recipe) -> float:
    """Solids whose bounding boxes reach into the map, averaged over the maps of a flight's
    candidate viewpoints, whose middles are `positions` (m, 3)."""
    if not len(positions):
        return 0.0
    half = recipe.grid.extent_m / 2
    lower, upper = world.solids.boxes
    several = max(
        1_000_000 // max(len(lower), 1), 1
    )  # at a time, so that long flights over many solids fit in memory
    total = 0
    for begin in range(0, len(positions), several):
        here = positions[begin : begin + several, None]
        inside = (lower < here + half) & (upper > here - half)
        total += int(np.count_nonzero(inside.all(axis=2)))
    return total / len(positions)


def _hopeless(recipe: Recipe, rejected: Rejections, split: str, number: int) -> str:
    """Why no draw was kept, and what to change."""
    counted = ", ".join(f"{count} {name}" for name, count in rejected.worlds.items())
    thinner, fuller = (
        "give the scene other <numeric flight_bounds>",
        "fly where there are more solids",
    )
    if recipe.world is not None:
        given = ", ".join(
            f"world.{name} = {getattr(recipe.world, name)}" for name in recipe.world.crowded_by
        )
        thinner, fuller = (
            f"{verb} {given or 'how many solids are drawn'}" for verb in ("lower", "raise")
        )
    advice = {
        "no_flight": f"no flight fits between the solids: {thinner}, or lower "
        f"flight.robot_radius_m = "
        f"{recipe.flight.robot_radius_m}",
        "few_solids": f"worlds are too empty: {fuller}, or lower accept.min_solids = "
        f"{recipe.accept.min_solids}",
        "few_viewpoints": f"flights give too few viewpoints: lower flight.viewpoints = "
        f"{recipe.flight.viewpoints}, "
        f"flight.spacing_m = {recipe.flight.spacing_m}, "
        f"accept.min_occupied_share = {recipe.accept.min_occupied_share} or "
        f"accept.min_returned_share = {recipe.accept.min_returned_share}",
    }
    total = sum(rejected.worlds.values())
    advised = "; ".join(advice[reason] for reason, _ in rejected.worlds.most_common())
    return f"{split} world {number}: all {total} draws rejected ({counted}); {advised}"


TRIES = 50
"""Flights tried before a world counts as too narrow."""


def read_world(path: Path) -> World:
    """The world of an MJCF file. Raises SceneError for one that cannot serve."""
    if path.is_dir():
        raise SceneError(f"{path}: is a folder; expected one MJCF file")
    source = read_scenes(path, {"train": 1, "val": 0, "test": 0}, seed=0, allow_unseen=True)
    return source.world("train", 0, rng=np.random.default_rng(0))


def pose_in_flight(world: World, *, seed: int, flight: Flight | None = None) -> Pose:
    """A random viewpoint of a random flight through the world. Raises GenerationError where none
    fits."""
    return _flown(world, flight or Flight(), seed).pose(0)


def poses_in_flight(
    world: World, *, seed: int, every_m: float | None = None, flight: Flight | None = None
) -> list[Pose]:
    """The viewpoints of a random flight through the world, every `every_m` metres (the flight's own
    spacing unless given), in the order in which they are passed. Raises GenerationError where none
    fits."""
    flight = flight or Flight()
    found = _flown(world, dataclasses.replace(flight, spacing_m=every_m or flight.spacing_m), seed)
    return [found.pose(int(n)) for n in np.argsort(found.flown_m)]


def _flown(world: World, flight: Flight, seed: int) -> Viewpoints:
    rng = np.random.default_rng(seed)
    for _ in range(TRIES):
        path = plan(world.clearance, world.flight_bounds, flight, rng=rng)
        if path is not None and len(found := viewpoints(path, flight.spacing_m, rng=rng)):
            return found
    raise GenerationError(f"no flight fits between the solids in {TRIES} tries; give --pose")


def scan_world(
    world: World,
    lidar: Sensor,
    pose: Pose,
    noise: Noise | None = None,
    *,
    seed: int | Sequence[int],
    engine: EngineFactory = AnalyticEngine.of,
) -> Returns:
    """What `lidar` on a body at `pose` returns of the world; the noise is drawn by `seed`.

    Raises GenerationError where a stage needs what the engine does not know.
    """
    caster = engine(world.model, world.data)
    clean = cast(caster, lidar, pose)
    try:
        return (noise or Noise()).observe(
            clean, caster, rng=np.random.default_rng(seed), albedo=albedo_of(world.model)
        )
    except ValueError as error:
        raise GenerationError(str(error)) from None
