"""Draw one unit: draw a world, fly through it, scan it, and make its samples. This file holds the
whole method.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from lidarsim import AnalyticEngine, Pose, Scan, Sensor, cast, fuse
from lidarsim.engines import ENGINES, Caster, EngineFactory
from lidarsim.grid import Floats
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Motion
from lidarsim.noise.returns import Returns
from scenegen import SPLITS
from scenegen.base.errors import GenerationError, RecipeError, reraise_as
from scenegen.draw.movers import mover_voxels, ray_times
from scenegen.draw.parts import PARTS
from scenegen.draw.sample import Sample, earlier_fields
from scenegen.draw.source import Source
from scenegen.truth import distance_field
from scenegen.worlds.flight import Route, plan_flight, viewpoints
from scenegen.worlds.place import Place
from scenegen.worlds.recipe import Recipe
from scenegen.worlds.tables import named_noise
from scenegen.worlds.world import AnyWorld, World, populated

WORLD, FLIGHT, NOISE, MOVERS = 0, 1, 2, 3
"""Streams of random numbers of a unit."""


class UnitKey(NamedTuple):
    """Key of a unit's random numbers."""

    seed: int
    """Seed of the dataset."""
    split: str
    """ "train", "val" or "test"."""
    unit: int
    """Number of the unit in its split."""

    def rng(self, stream: int, attempt: int, *part: int) -> Generator:
        """Random numbers of one purpose.

        Args:
            stream: `WORLD`, `FLIGHT`, `NOISE` or `MOVERS`.
            attempt: Number of the draw.
            part: Further parts of the key, such as the number of a view.
        """
        # in the order that docs/format.md lays down
        key = SPLITS.index(self.split), self.unit, attempt, stream, *part
        # a stream for each purpose: more noise, for example, must not change the worlds
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))


Rejections = Mapping[str, Counter[str]]
"""Number of rejected draws by reason, of `worlds` and of `viewpoints`."""


def none_rejected() -> Rejections:
    """Empty counts of rejected draws."""
    return {"worlds": Counter(), "viewpoints": Counter()}


@dataclass(frozen=True, eq=False)
class Unit:
    """One flight: its world and samples."""

    number: int
    """Number of the world in its split."""
    world: AnyWorld
    samples: tuple[Sample, ...]
    rejected: Rejections


Truth = dict[str, np.ndarray]
"""Fields with the true content of a viewpoint's map, and which of it is known, by name."""


class ViewpointData(NamedTuple):
    """Data of one viewpoint."""

    scans: Sequence[Scan]
    """Its clean scan, then the earlier ones, latest first."""
    times_s: Floats
    """When each scan began, seconds; 0 where nothing moves."""
    truth: Truth
    """The truth of its map when its own scan began."""


ADVICE = {
    "no_flight": "no flight fits between the solids: {fewer}, or lower flight.robot_radius_m",
    "few_movers": "movers find no room: lower the least numbers or the speeds of people, "
    "vehicles or drones, or {fewer}",
    "few_solids": "worlds are too empty: {more}, or lower accept.min_solids",
    "few_viewpoints": "flights give too few viewpoints: lower flight.viewpoints, flight.spacing_m, "
    "accept.min_occupied_share or accept.min_returned_share; in a map of a real place, "
    "known.least_share, or raise known.most_marked_share",
}
"""Advice when all draws of a world are rejected, by the reason."""


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
    """Draw a world, fly through it, and scan it. A rejected world is drawn again under the same
    number.

    The samples depend only on the recipe, the source, the seed, the split and the unit's number.

    Args:
        source: Where the world comes from.
        recipe: All other settings of samples.
        seed: Seed of the dataset.
        split: "train", "val" or "test".
        unit: Number of the unit in its split.
        derived: Whether samples have `tudf`; otherwise it is an empty array.
        engine: Makes the engine that casts rays in the world.

    Raises:
        GenerationError: if all `recipe.accept.max_draws` draws are rejected.
    """
    rejected, key = none_rejected(), UnitKey(seed, split, unit)
    number, turn = source.number(split, unit)
    for attempt in range(recipe.accept.max_draws):
        drawn = source.world(split, number, rng=key.rng(WORLD, attempt))
        world = _populated(drawn, recipe, rng=key.rng(MOVERS, attempt))
        if world is None:
            rejected["worlds"]["few_movers"] += 1
            continue
        views = _fly(world, engine, recipe, rejected, rng=key.rng(FLIGHT, attempt))
        if views:
            # a world from a file is visited several times: its viewpoints are numbered on
            names = number, turn * recipe.flight.viewpoints
            samples = samples_of(views, recipe, world, engine, key, names, derived)
            return Unit(number, world, samples, rejected)
    counted = ", ".join(f"{count} {reason}" for reason, count in rejected["worlds"].items())
    # advice on the most common reason comes first
    advice = "; ".join(ADVICE[reason] for reason, _ in rejected["worlds"].most_common())
    crowded = () if recipe.world is None else recipe.world.crowded_by
    for_fewer, for_more = _turned(crowded, "lower", "raise"), _turned(crowded, "raise", "lower")
    raise GenerationError(
        f"{split} world {number}: all {recipe.accept.max_draws} draws rejected ({counted}); "
        f"{advice.format(fewer=for_fewer, more=for_more)}"
    )


def compile_truth(source: Source, recipe: Recipe, split: str) -> None:
    """Compile the kernels that `draw_unit` uses last: those of the truth and of maps.

    Args:
        source: Where worlds come from.
        recipe: Settings of samples.
        split: "train", "val" or "test".
    """
    world = source.world(split, 0, rng=np.random.default_rng(0))
    # any pose will do: kernels are compiled for types
    pose = Pose(world.flight_bounds.mean(axis=0), np.array([1.0, 0.0, 0.0, 0.0]))
    scan = Scan(np.full(recipe.lidar.shape, np.inf, np.float32), pose, recipe.lidar)
    truth = truth_of(world, scan, recipe)
    distance_field(truth["occupancy"], recipe.grid)
    fuse([scan], recipe.grid, recipe.mapping.origin(recipe.grid, pose), recipe.mapping)


def _populated(world: AnyWorld, recipe: Recipe, *, rng: Generator) -> AnyWorld | None:
    """Add the recipe's movers to a drawn world; None if they find no room. Raises GenerationError
    if the world has movers already, and the recipe has none."""
    if isinstance(world, Place):
        return world
    if world.movers is None and recipe.traffic is not None:
        zones = recipe.mover_zones(world.flight_bounds)
        return populated(world, zones, recipe.traffic, rng=rng)
    if world.movers is not None and recipe.traffic is None:
        raise GenerationError("the world's document has movers; give --movers, which keeps them")
    return world


def caster_at(world: AnyWorld, engine: EngineFactory, recipe: Recipe, time_s: float) -> Caster:
    """Caster of a world for a scan.

    Args:
        world: The world.
        engine: Makes engines.
        recipe: Tells whether rays meet movers at their own times.
        time_s: When the scan begins, seconds.
    """
    if recipe.traffic is None or isinstance(world, Place):
        return world.caster(engine)
    if world.movers is None:
        raise GenerationError("the world's document has no movers; verify the dataset")
    return world.caster_at(engine, ray_times(recipe.traffic, recipe.lidar, time_s))


def times_of_scans(time_s: float, recipe: Recipe) -> Floats:
    """When the scans of a viewpoint begin.

    Args:
        time_s: When its own scan begins, seconds after the flight did.
        recipe: Gives the number and distance of scans, and the sensor's speed.

    Returns:
        Seconds, the viewpoint's own scan first; 0 where nothing moves.
    """
    back_m = recipe.mapping.scan_spacing_m * np.arange(recipe.mapping.scans)
    if recipe.traffic is None:
        return np.zeros(len(back_m))
    # not before the flight began: earlier scans are taken at its start, see `Route.before`
    return np.maximum(time_s - back_m / recipe.traffic.sensor_mps, 0.0)


def times_of(fields: Any, recipe: Recipe) -> Floats:
    """When the scans of a sample began; see `times_of_scans`.

    Args:
        fields: The sample.
        recipe: Gives the number of scans.

    Returns:
        Seconds, the sample's own scan first; 0 where nothing moves.
    """
    stored = fields.scan_times
    return np.zeros(recipe.mapping.scans) if stored is None else stored


def _fly(
    world: AnyWorld,
    engine: EngineFactory,
    recipe: Recipe,
    rejected: Rejections,
    *,
    rng: Generator,
) -> list[ViewpointData] | None:
    """Fly through a world. Returns the views in flight order, or None, with the reason counted in
    `rejected`, if no flight is accepted."""
    flight, reason = recipe.flight, "no_flight"
    for _ in range(flight.flights_per_world):
        path = plan_flight(world, flight, rng=rng, sees=recipe.sees(world))
        if path is None:
            continue
        route, candidates = viewpoints(path, flight.spacing_m, rng=rng)
        if _solids_nearby(world, route, candidates, recipe) < recipe.accept.min_solids:
            # another flight through the same sparse world would fail as well
            reason = "few_solids"
            break
        accepted: list[tuple[float, Scan, Truth]] = []
        for flown_m in candidates:
            pose = route.pose(flown_m, recipe.mapping)
            distances_m2 = [
                ((pose.position - scan.pose.position) ** 2).sum() for _, scan, _ in accepted
            ]
            # candidates are this far apart along the path, but the path may return to a place
            if min(distances_m2, default=math.inf) >= flight.spacing_m * flight.spacing_m:
                times_s = times_of_scans(_time_s(flown_m, recipe), recipe)
                view = _look(world, engine, pose, float(times_s[0]), recipe)
                if isinstance(view, str):
                    rejected["viewpoints"][view] += 1
                else:
                    accepted.append((flown_m, *view))
            if len(accepted) == flight.viewpoints:
                # candidates are tried in random order, and samples are numbered in flight order
                views: list[ViewpointData] = []
                for flown_m, scan, truth in sorted(accepted, key=lambda view: view[0]):
                    # earlier scans are cast only for views that are accepted
                    before = route.before(flown_m, recipe.mapping)
                    times_s = times_of_scans(_time_s(flown_m, recipe), recipe)
                    earlier = scans_from(before, times_s[1:], world, engine, recipe)
                    views.append(ViewpointData([scan, *earlier], times_s, truth))
                return views
        reason = "few_viewpoints"
    rejected["worlds"][reason] += 1
    return None


def _time_s(flown_m: float, recipe: Recipe) -> float:
    """When the sensor is at a place of its flight, seconds; 0 where nothing moves."""
    return 0.0 if recipe.traffic is None else flown_m / recipe.traffic.sensor_mps


def _turned(crowded: tuple[str, ...], verb: str, opposite: str) -> str:
    """Advice on parameters that make worlds crowded, such as "lower world.leaves_m, raise
    world.row_m".

    A minus sign before a name says that raising it makes worlds emptier.
    """
    advice = ", ".join(
        f"{opposite if name[0] == '-' else verb} world.{name.removeprefix('-')}" for name in crowded
    )
    return advice or f"{verb} how many solids, or in a map unknown voxels, there are where it flies"


def _look(
    world: AnyWorld, engine: EngineFactory, pose: Pose, time_s: float, recipe: Recipe
) -> tuple[Scan, Truth] | str:
    """Scan a viewpoint. Returns the scan and the truth, or the reason to reject it: too few returns
    or solids, a mover that is too near, or too little known space."""
    accept, known = recipe.accept, recipe.known
    # checked first: most viewpoints in maps of real places fail here, and it needs no scan
    if known is not None and not world.is_known(pose, recipe.lidar, known):
        return "rays_unknown"
    if isinstance(world, World) and world.movers is not None:
        room_m = recipe.flight.robot_radius_m
        if world.movers.distances_m(pose.position[None], time_s, recipe.scan_s)[0] < room_m:
            return "mover_near"
    # a clean scan decides, so that a noisy dataset has the viewpoints of the clean one
    (scan,) = scans_from([pose], [time_s], world, engine, recipe)
    returned = np.count_nonzero(np.isfinite(scan.ranges))
    if returned < scan.ranges.size * accept.min_returned_share:
        return "few_returns"
    truth = truth_of(world, scan, recipe, time_s)
    occupied = truth["occupancy"]
    if np.count_nonzero(occupied) / occupied.size < accept.min_occupied_share:
        return "few_occupied"
    if known is not None and truth["known"].mean() < known.least_share:
        return "few_known"
    return scan, truth


def truth_of(world: AnyWorld, scan: Scan, recipe: Recipe, time_s: float = 0.0) -> Truth:
    """Compute the true content of the map of a clean scan.

    Args:
        world: The world.
        scan: The scan.
        recipe: Gives the map.
        time_s: When the scan began, seconds.

    Returns:
        `occupancy`; with movers also `static_occupancy` and `voxel_mover`; in maps of real places
        also `known` and `ray_known`.
    """
    origin = recipe.mapping.origin(recipe.grid, scan.pose)
    truth: Truth = {**world.truth(recipe.grid, origin)}
    if isinstance(world, World) and world.movers is not None:
        standing = truth["occupancy"]
        mover = mover_voxels(world.movers, recipe.grid, origin, time_s)
        occupied = mover >= 0
        occupied |= standing
        truth = {
            "occupancy": occupied,
            "static_occupancy": standing,
            "voxel_mover": mover,
        }
    if recipe.known is not None:
        # a world of solids is known everywhere
        truth.setdefault("known", np.ones(recipe.grid.shape, bool))
        truth["ray_known"] = world.unknown_m(scan) <= recipe.known.most_unknown_m
    return truth


def _solids_nearby(world: AnyWorld, route: Route, candidates: Floats, recipe: Recipe) -> float:
    """Mean number of solids whose bounding boxes reach into the map of a candidate viewpoint;
    infinite for a map of voxels."""
    if not len(candidates):
        return 0.0
    if isinstance(world, Place):
        # `accept.min_solids` does not apply to maps of voxels
        return math.inf
    half_m, (middles, _) = recipe.grid.extent_m / 2, route.at(candidates)
    if not recipe.mapping.centred:
        poses = map(route.pose, candidates)
        middles = np.array([recipe.mapping.origin(recipe.grid, pose) for pose in poses]) + half_m
    lower, upper = world.solids.boxes
    # one viewpoint at a time, as all together might not fit in memory
    inside = (
        ((lower < middle + half_m) & (upper > middle - half_m)).all(axis=1) for middle in middles
    )
    return sum(map(np.count_nonzero, inside)) / len(middles)


def samples_of(
    views: Sequence[ViewpointData],
    recipe: Recipe,
    world: AnyWorld,
    engine: EngineFactory,
    key: UnitKey,
    names: tuple[int, int],
    derived: bool,
) -> tuple[Sample, ...]:
    """Make the samples of a unit from its views, with the recipe's noise and optional parts.

    Args:
        names: Number of the world, and number of the first sample's viewpoint.
        derived: Whether samples have `tudf`; otherwise it is an empty array.

    Raises:
        GenerationError: if noise fails, or a part needs geoms in a map of voxels.
    """
    number, first = names
    samples = []
    for view, (clean, times_s, truth) in enumerate(views):
        scans = with_noise(clean, times_s, world, engine, recipe, key, view)
        scan, *earlier = scans
        origin = recipe.mapping.origin(recipe.grid, scan.pose)
        # oldest first, as a robot receives them
        seen = fuse(scans[::-1], recipe.grid, origin, recipe.mapping)
        values: dict[str, Any] = {
            "observed": seen.observed,
            "free": seen.free,
            "tudf": distance_field(truth["occupancy"], recipe.grid)
            if derived
            else np.empty(0, "<f4"),
            **truth,
            "ranges": scan.ranges,
            "position": scan.pose.position,
            "quaternion": scan.pose.quaternion,
            "origin": seen.origin,
            "world": number,
            "viewpoint": first + view,
            **earlier_fields(earlier),
            **({} if recipe.traffic is None else {"scan_times": times_s}),
        }
        # labels need the numbers of movers
        for name in sorted(recipe.parts, key="movers".__ne__):
            if not isinstance(world, World):
                raise GenerationError(f"--{name}: a map of a real place has no geoms; leave it out")
            values |= PARTS[name].compute(values, world, recipe, recipe.parts[name])
        samples.append(Sample(**values, lidar=recipe.lidar, grid=recipe.grid))
    return tuple(samples)


def in_motion(pace: Any, chain: Noise) -> Noise:
    """Add motion during a scan to a chain of noise.

    Args:
        pace: The `Motion`.
        chain: Other stages, which follow the motion.

    Raises:
        GenerationError: if `chain` has a motion already.
    """
    if any(isinstance(stage, Motion) for stage in chain.stages):
        raise GenerationError("noise: the stage motion moves a sensor that moves; leave it out")
    # motion comes first: later stages change ranges, which motion casts anew
    return Noise((pace, *chain.stages))


def scan_world(
    world: AnyWorld,
    lidar: Sensor,
    pose: Pose,
    noise: Noise | str | None = None,
    *,
    seed: int | Sequence[int],
    engine: EngineFactory | str = AnalyticEngine.of,
    time_s: ArrayLike | None = None,
) -> Returns:
    """Scan a world.

    Args:
        world: The world, or the map of a real place.
        lidar: The sensor.
        pose: Pose of the body that carries the sensor, in the world.
        noise: A chain of noise, or text such as "range:0.02,dropout:0.05"; none by default.
        seed: Seed of the noise.
        engine: Name of the engine for a world of solids, such as "mujoco", or a function that makes
            one, such as `lidarsim.MujocoEngine.of`.
        time_s: When rays are cast, seconds, in a world with movers; one number, or one for each
            ray, (*lidar.shape). Without it, nothing moves there.

    Returns:
        Ranges and intensities. `points()` are the returns (M, 3), metres, in the world's frame.

    Raises:
        GenerationError: if a stage of the noise needs something that the engine does not compute.
        RecipeError: if the noise cannot be parsed, or there is no such engine.
    """
    with reraise_as(RecipeError):
        factory = ENGINES.find(engine).of if isinstance(engine, str) else engine
    rng = np.random.default_rng(seed)
    caster: Caster = world.caster(factory)
    if time_s is not None and isinstance(world, World):
        caster = world.caster_at(factory, time_s)
    return observed(cast(caster, lidar, pose), named_noise(noise, lidar), world.albedo, caster, rng)


def scans_from(
    poses: Sequence[Pose],
    times_s: Sequence[float] | Floats,
    world: AnyWorld,
    engine: EngineFactory,
    recipe: Recipe,
) -> list[Scan]:
    """Cast clean scans from poses of the body that carries the sensor.

    Args:
        poses: The poses.
        times_s: When each scan begins, seconds.
        world: The world.
        engine: Makes engines.
        recipe: Gives the sensor.

    Raises:
        GenerationError: if the engine fails.
    """
    with reraise_as(GenerationError, "the engine fails: "):
        return [
            cast(caster_at(world, engine, recipe, float(time_s)), recipe.lidar, pose)
            for pose, time_s in zip(poses, times_s, strict=True)
        ]


def with_noise(
    scans: Sequence[Scan],
    times_s: Floats,
    world: AnyWorld,
    engine: EngineFactory,
    recipe: Recipe,
    key: UnitKey,
    view: int,
) -> list[Scan]:
    """Add the recipe's noise to the scans of a view.

    The random numbers depend on the view, not on the accepted draw, so that scanning the same poses
    again gives the same noise. Without stages, the scans are returned unchanged.

    Args:
        scans: Clean scans: the view's own, then earlier ones, latest first.
        times_s: When each scan began, seconds.
        world: The world.
        engine: Makes engines.
        recipe: Gives the noise.
        key: Key of the unit's random numbers.
        view: Number of the view in its unit.

    Returns:
        Noisy scans in the same order, float32 ranges.

    Raises:
        GenerationError: if a stage fails, or its result does not fit a dataset: several echoes,
            intensities, or returns beside the rays.
    """
    noise = recipe.noise
    if not noise.stages:
        return list(scans)
    noisy = []
    for age, (scan, time_s) in enumerate(zip(scans, times_s, strict=True)):
        # the scan's own noise has the shortest key: it is the same with and without earlier scans
        rng = key.rng(NOISE, 0, view, *([age] if age else []))
        caster = caster_at(world, engine, recipe, float(time_s))
        seen = observed(scan, noise, world.albedo, caster, rng)
        if len(seen.ranges) > 1 or seen.intensity is not None:
            raise GenerationError(
                f"noise {noise}: a dataset holds one range a ray and nothing else; leave intensity "
                "out, and two returns"
            )
        moved = (seen.reported_origins != scan.pose.position).any()
        if moved or not np.array_equal(seen.reported_directions, scan.directions):
            raise GenerationError(
                f"noise {noise}: a dataset's rays begin where the scan does; leave corrected "
                "motion out, or use `scan`"
            )
        noisy.append(Scan(seen.ranges[0].astype(np.float32), scan.pose, scan.lidar))
    return noisy


def observed(
    scan: Scan, noise: Noise, albedo: np.ndarray | None, engine: Caster, rng: Generator
) -> Returns:
    """Apply noise to a clean scan; see `Noise.observe`.

    Raises:
        GenerationError: if a stage cannot be applied.
    """
    with reraise_as(GenerationError):
        return noise.observe(scan, engine, rng=rng, albedo=albedo)
