"""A flight that was flown before, scanned again: the same world and the same poses, another sensor, engine or noise."""

from collections.abc import Sequence

from lidarsim import Pose
from lidarsim.engines import EngineFactory
from scenegen.draw import Rejections, Unit, engine_of, sample_of, scans_from
from scenegen.noise import with_noise
from scenegen.recipe import Recipe
from scenegen.truth import rasterize
from scenegen.world import World


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
    """The unit whose flight through `world` had these sensor `poses`, as the recipe's sensor and noise see it: of each
    sample its own, and then those of its earlier scans, the last one first.

    `names` are the world's number and the first sample's viewpoint. Nothing is drawn but the noise, and nothing is
    rejected. With what the unit was drawn with, the same samples come out, bit for bit. Raises GenerationError.
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
