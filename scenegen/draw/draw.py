"""One unit of work: a world is drawn, flown through and scanned, and its samples come out. The
whole method is here.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from lidarsim import AnalyticEngine, Pose, Scan, Sensor, cast, fuse
from lidarsim.engines import ENGINES, Caster, EngineFactory
from lidarsim.grid import Floats
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Motion
from lidarsim.noise.returns import Returns
from scenegen import SPLITS
from scenegen.base.errors import GenerationError, RecipeError, raised_as
from scenegen.draw.parts import PARTS
from scenegen.draw.sample import Sample, earlier_fields
from scenegen.draw.source import Source
from scenegen.truth import distance_field
from scenegen.worlds.flight import Route, fly, viewpoints
from scenegen.worlds.place import Place
from scenegen.worlds.recipe import Recipe
from scenegen.worlds.tables import named_noise
from scenegen.worlds.world import AnyWorld, World

Truth = dict[str, np.ndarray]
"""What is there in a viewpoint's map, and what of it is known, by the names of fields."""
View = tuple[Sequence[Scan], Truth]
"""What one viewpoint gave: its own clean scan, those before it, the last one first, and the truth
of its map."""
WORLD, FLIGHT, NOISE = 0, 1, 2
"""The streams of random numbers of a unit."""
ADVICE = {
    "no_flight": "no flight fits between the solids: {fewer}, or lower flight.robot_radius_m",
    "few_solids": "worlds are too empty: {more}, or lower accept.min_solids",
    "few_viewpoints": "flights give too few viewpoints: lower flight.viewpoints, flight.spacing_m, "
    "accept.min_occupied_share or accept.min_returned_share; in a map of a real place, "
    "known.least_share, or raise known.most_marked_share",
}
"""What to change where no draw is kept, by the reason."""


class UnitKey(NamedTuple):
    """Which unit: all that its random numbers depend on."""

    seed: int
    """The seed of the dataset."""
    split: str
    """ "train", "val" or "test"."""
    unit: int
    """The unit's number in the split."""

    def rng(self, stream: int, attempt: int, *part: int) -> Generator:
        """What the world of a draw, its flights, or a part of its noise come from."""
        key = SPLITS.index(self.split), self.unit, attempt, stream, *part
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))


Rejections = Mapping[str, Counter[str]]
"""How many draws were not kept, by reason: of `worlds`, and of `viewpoints`."""


def none_rejected() -> Rejections:
    """The counts where none was drawn yet."""
    return {"worlds": Counter(), "viewpoints": Counter()}


@dataclass(frozen=True, eq=False)
class Unit:
    """What one flight gave."""

    number: int
    """The world's number within its split."""
    world: AnyWorld
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
    """Draw a world, fly through it, and scan it. A draw that is rejected is made again under the
    same number.

    Args:
        source: Where the world comes from.
        recipe: Everything else that decides what a sample holds.
        seed: The seed of the dataset.
        split: "train", "val" or "test".
        unit: The unit's number in its split. Its samples depend on these five alone, not on what
            was drawn before.
        derived: Whether samples have `tudf`; an empty array stands in for it otherwise.
        engine: Makes what casts the rays of a world.

    Raises:
        GenerationError: None of `recipe.accept.max_draws` draws was kept.
    """
    rejected, key = none_rejected(), UnitKey(seed, split, unit)
    number, turn = source.number(split, unit)
    for attempt in range(recipe.accept.max_draws):
        world = source.world(split, number, rng=key.rng(WORLD, attempt))
        caster = world.caster(engine)
        views = _fly(world, caster, recipe, rejected, rng=key.rng(FLIGHT, attempt))
        if views:
            names = number, turn * recipe.flight.viewpoints
            samples = samples_of(views, recipe, world, caster, key, names, derived)
            return Unit(number, world, samples, rejected)
    counted = ", ".join(f"{count} {reason}" for reason, count in rejected["worlds"].items())
    advice = "; ".join(ADVICE[reason] for reason, _ in rejected["worlds"].most_common())
    crowded = () if recipe.world is None else recipe.world.crowded_by
    fewer, more = _turned(crowded, "lower", "raise"), _turned(crowded, "raise", "lower")
    raise GenerationError(
        f"{split} world {number}: all {recipe.accept.max_draws} draws rejected ({counted}); "
        f"{advice.format(fewer=fewer, more=more)}"
    )


def compile_truth(source: Source, recipe: Recipe, split: str) -> None:
    """Have the kernels compiled that come last in `draw_unit`: those of the truth and of maps."""
    world = source.world(split, 0, rng=np.random.default_rng(0))
    pose = Pose(world.flight_bounds.mean(axis=0), np.array([1.0, 0.0, 0.0, 0.0]))
    scan = Scan(np.full(recipe.lidar.shape, np.inf, np.float32), pose, recipe.lidar)
    truth = truth_of(world, scan, recipe)
    distance_field(truth["occupancy"], recipe.grid)
    fuse([scan], recipe.grid, recipe.mapping.origin(recipe.grid, pose), recipe.mapping)


def _fly(
    world: AnyWorld,
    engine: Caster,
    recipe: Recipe,
    rejected: Rejections,
    *,
    rng: Generator,
) -> list[View] | None:
    """The views of one flight, in flight order; None, with the reason counted, if the world yields
    no acceptable flight."""
    flight, reason = recipe.flight, "no_flight"
    for _ in range(flight.flights_per_world):
        path = fly(world, flight, rng=rng)
        if path is None:
            continue
        route, candidates = viewpoints(path, flight.spacing_m, rng=rng)
        if _solids_nearby(world, route, candidates, recipe) < recipe.accept.min_solids:
            reason = "few_solids"
            break
        kept: list[tuple[float, Scan, Truth]] = []
        for flown_m in candidates:
            pose = route.pose(flown_m, recipe.mapping)
            apart = [((pose.position - scan.pose.position) ** 2).sum() for _, scan, _ in kept]
            if all(square >= flight.spacing_m * flight.spacing_m for square in apart):
                view = _look(world, engine, pose, recipe)
                if isinstance(view, str):
                    rejected["viewpoints"][view] += 1
                else:
                    kept.append((flown_m, *view))
            if len(kept) == flight.viewpoints:
                views: list[View] = []
                for flown_m, scan, truth in sorted(kept, key=lambda view: view[0]):
                    before = route.before(flown_m, recipe.mapping)
                    views.append(([scan, *scans_from(before, engine, recipe.lidar)], truth))
                return views
        reason = "few_viewpoints"
    rejected["worlds"][reason] += 1
    return None


def _turned(crowded: tuple[str, ...], verb: str, opposite: str) -> str:
    """What to do to the parameters by which worlds are `crowded`: "lower world.leaves_m, raise
    world.row_m"."""
    said = ", ".join(
        f"{opposite if name[0] == '-' else verb} world.{name.removeprefix('-')}" for name in crowded
    )
    return said or f"{verb} how many solids, or in a map unknown voxels, there are where it flies"


def _look(world: AnyWorld, engine: Caster, pose: Pose, recipe: Recipe) -> tuple[Scan, Truth] | str:
    """The scan and the truth at a viewpoint; the reason not to keep it where there is next to
    nothing, or too little is known."""
    accept, known = recipe.accept, recipe.known
    # first, for most fail here
    if known is not None and not world.is_known(pose, recipe.lidar, known):
        return "rays_unknown"
    (scan,) = scans_from([pose], engine, recipe.lidar)
    returned = np.count_nonzero(np.isfinite(scan.ranges))
    if returned < scan.ranges.size * accept.min_returned_share:
        return "few_returns"
    truth = truth_of(world, scan, recipe)
    occupied = truth["occupancy"]
    if np.count_nonzero(occupied) / occupied.size < accept.min_occupied_share:
        return "few_occupied"
    if known is not None and truth["known"].mean() < known.least_share:
        return "few_known"
    return scan, truth


def truth_of(world: AnyWorld, scan: Scan, recipe: Recipe) -> Truth:
    """The fields of a sample that say what is there at its own `scan`, and what of it is known."""
    truth = world.truth(recipe.grid, recipe.mapping.origin(recipe.grid, scan.pose))
    if recipe.known is not None:
        truth.setdefault("known", np.ones(recipe.grid.shape, bool))
        truth["ray_known"] = world.unknown_m(scan) <= recipe.known.most_unknown_m
    return truth


def _solids_nearby(world: AnyWorld, route: Route, candidates: Floats, recipe: Recipe) -> float:
    """Solids whose bounding boxes reach into the map, averaged over the maps of a flight's
    candidate viewpoints; no end of them in a map of voxels."""
    if not len(candidates):
        return 0.0
    if isinstance(world, Place):
        return math.inf
    half, (middles, _) = recipe.grid.extent_m / 2, route.at(candidates)
    if not recipe.mapping.centred:
        poses = map(route.pose, candidates)
        middles = np.array([recipe.mapping.origin(recipe.grid, pose) for pose in poses]) + half
    lower, upper = world.solids.boxes
    # one after the other, so that long flights over many solids fit in memory
    inside = (((lower < here + half) & (upper > here - half)).all(axis=1) for here in middles)
    return sum(map(np.count_nonzero, inside)) / len(middles)


def samples_of(
    views: Sequence[View],
    recipe: Recipe,
    world: AnyWorld,
    engine: Caster,
    key: UnitKey,
    names: tuple[int, int],
    derived: bool,
) -> tuple[Sample, ...]:
    """The samples of a unit's views, with the recipe's noise and parts. `names` are the world's
    number and the first sample's viewpoint. Raises GenerationError."""
    number, first = names
    found = []
    for view, (clean, truth) in enumerate(views):
        scans = with_noise(clean, recipe.noise, world, engine, key, view)
        own, *earlier = scans
        origin = recipe.mapping.origin(recipe.grid, own.pose)
        seen = fuse(scans[::-1], recipe.grid, origin, recipe.mapping)
        values: dict[str, Any] = {
            "observed": seen.observed,
            "free": seen.free,
            "tudf": distance_field(truth["occupancy"], recipe.grid)
            if derived
            else np.empty(0, "<f4"),
            **truth,
            "ranges": own.ranges,
            "position": own.pose.position,
            "quaternion": own.pose.quaternion,
            "origin": seen.origin,
            "world": number,
            "viewpoint": first + view,
            **earlier_fields(earlier),
        }
        for name, settings in recipe.parts.items():
            if not isinstance(world, World):
                raise GenerationError(f"--{name}: a map of a real place has no geoms; leave it out")
            values |= PARTS[name].compute(values, world, recipe, settings)
        found.append(Sample(**values, lidar=recipe.lidar, grid=recipe.grid))
    return tuple(found)


def in_motion(pace: Any, chain: Noise) -> Noise:
    """The noise of a sensor that moves on while it scans, at a `pace`, which is a `Motion`. Raises
    GenerationError where `chain` moves it already."""
    if any(isinstance(stage, Motion) for stage in chain.stages):
        raise GenerationError("noise: the stage motion moves a sensor that moves; leave it out")
    return Noise((pace, *chain.stages))


def scan_world(
    world: AnyWorld,
    lidar: Sensor,
    pose: Pose,
    noise: Noise | str | None = None,
    *,
    seed: int | Sequence[int],
    engine: EngineFactory | str = AnalyticEngine.of,
) -> Returns:
    """What a sensor returns of a world.

    Args:
        world: The world, or the map of a real place.
        lidar: The sensor.
        pose: The pose of the body that holds the sensor.
        noise: What becomes of the clean ranges, as a chain or as text such as
            "range:0.02,dropout:0.05"; nothing by default.
        seed: What the noise is drawn by.
        engine: The name of the engine for a world of solids, such as "mujoco", or what makes it,
            such as `lidarsim.MujocoEngine.of`.

    Returns:
        Ranges and intensities; its `points()` are the returns (M, 3), metres, in the world.

    Raises:
        GenerationError: A stage of the noise needs what the engine does not know.
        RecipeError: The text describes no noise, or there is no such engine.
    """
    with raised_as(RecipeError):
        made = ENGINES.find(engine).of if isinstance(engine, str) else engine
    rng = np.random.default_rng(seed)
    caster = world.caster(made)
    return observed(cast(caster, lidar, pose), named_noise(noise, lidar), world.albedo, caster, rng)


def scans_from(poses: Sequence[Pose], engine: Caster, lidar: Sensor) -> list[Scan]:
    """The clean scans of `lidar` from `poses`. Raises GenerationError where the engine fails."""
    with raised_as(GenerationError, "the engine fails: "):
        return [cast(engine, lidar, pose) for pose in poses]


def with_noise(
    scans: Sequence[Scan],
    noise: Noise,
    world: AnyWorld,
    engine: Caster,
    key: UnitKey,
    view: int,
) -> list[Scan]:
    """The scans of view `view` of a unit as the sensor has them: the view's own, and those before
    it, the last one first.

    What is scanned again from the same pose has the same noise, whichever draw was kept. Without
    stages, the scans are `scans` themselves. Raises GenerationError where a stage fails, or gives
    what a dataset's `ranges` cannot hold: several echoes, intensities, or returns told to lie
    elsewhere than along the rays.
    """
    if not noise.stages:
        return list(scans)
    found = []
    for before, scan in enumerate(scans):
        rng = key.rng(NOISE, 0, view, *([before] if before else []))
        seen = observed(scan, noise, world.albedo, engine, rng)
        if len(seen.ranges) > 1 or seen.intensity is not None:
            raise GenerationError(
                f"noise {noise}: a dataset holds one range a ray and nothing else; leave intensity "
                "out, and two returns"
            )
        moved = (seen.told_origins != scan.pose.position).any()
        if moved or not np.array_equal(seen.told_directions, scan.directions):
            raise GenerationError(
                f"noise {noise}: a dataset's rays begin where the scan does; leave corrected "
                "motion out, or use `scan`"
            )
        found.append(Scan(seen.ranges[0].astype(np.float32), scan.pose, scan.lidar))
    return found


def observed(
    scan: Scan, noise: Noise, albedo: np.ndarray | None, engine: Caster, rng: Generator
) -> Returns:
    """What `noise` makes of a clean scan, see `Noise.observe`. Raises GenerationError where it
    cannot."""
    with raised_as(GenerationError):
        return noise.observe(scan, engine, rng=rng, albedo=albedo)
