"""A flight that was flown before, scanned again: the same world and the same poses, another sensor,
engine or noise."""

from collections.abc import Sequence

import numpy as np

from lidarsim import Pose
from lidarsim.engines import EngineFactory
from scenegen.draw import Rejections, Unit, engine_of, flight_rng, sample_of, scans_from
from scenegen.errors import GenerationError
from scenegen.recipe import Recipe
from scenegen.truth import rasterize
from scenegen.worlds.flight import plan, viewpoints
from scenegen.worlds.noise import with_noise
from scenegen.worlds.world import World


def fly_again(
    world: World, poses: Sequence[Pose], recipe: Recipe, *, seed: int, split: str, unit: int
) -> list[list[Pose]]:
    """The poses of the scans that the recipe's mapping asks for of samples with these `poses`, each
    its own first: the unit's flight is planned again, and known by its passing all of them, to the
    bit.

    Raises GenerationError where no draw's flight does.
    """
    for attempt in range(recipe.accept.max_draws):
        rng = flight_rng(seed, split, unit, attempt)
        for _ in range(recipe.flight.flights_per_world):
            path = plan(world.clearance, world.flight_bounds, recipe.flight, rng=rng)
            if path is None:
                continue
            passed = viewpoints(path, recipe.flight.spacing_m, rng=rng)
            places = [
                np.flatnonzero((passed.positions == pose.position).all(axis=1)) for pose in poses
            ]
            if all(len(place) == 1 for place in places):
                return [
                    [pose, *passed.before(int(place[0]), recipe.mapping)]
                    for pose, place in zip(poses, places, strict=True)
                ]
    raise GenerationError(
        f"{split} flight {unit} comes out otherwise here, so that nobody knows where earlier "
        f"scans were made; generate "
        "the dataset with --scans, or scan it again with the software that made it"
    )


def scan_again(
    world: World,
    poses: Sequence[Sequence[Pose]],
    recipe: Recipe,
    *,
    seed: int,
    split: str,
    unit: int,
    names: tuple[int, int],
    derived: bool = True,
    engine: EngineFactory,
) -> Unit:
    """The unit whose flight through `world` had these sensor `poses`, as the recipe's sensor and
    noise see it: of each sample its own, and then those of its earlier scans, the last one first.

    `names` are the world's number and the first sample's viewpoint. Nothing is drawn but the noise,
    and nothing is rejected. With what the unit was drawn with, the same samples come out, bit for
    bit. Raises GenerationError.
    """
    caster = engine_of(engine, world)
    number, first = names
    samples = tuple(
        sample_of(
            with_noise(
                scans_from(views, caster, recipe),
                recipe.noise,
                world,
                caster,
                seed=seed,
                split=split,
                unit=unit,
                view=n,
            ),
            rasterize(world.solids, recipe.grid, recipe.mapping.origin(recipe.grid, views[0])),
            recipe,
            world,
            number=number,
            viewpoint=first + n,
            derived=derived,
        )
        for n, views in enumerate(poses)
    )
    return Unit(number, world, samples, Rejections())
