"""A flight that was flown before, scanned again: the same world and the same poses, another sensor, engine or noise."""

from collections.abc import Sequence

from lidarsim import Pose, Scan, Sensor, cast
from lidarsim.engines import Engine, EngineFactory
from scenegen.draw import Rejections, Unit, engine_of, sample_of
from scenegen.errors import GenerationError
from scenegen.noise import with_noise
from scenegen.recipe import Recipe
from scenegen.truth import rasterize
from scenegen.world import World


def clean_scan(engine: Engine, lidar: Sensor, pose: Pose) -> Scan:
    """What `cast` gives. Raises GenerationError where the engine fails."""
    try:
        return cast(engine, lidar, pose)
    except ValueError as error:
        raise GenerationError(f"the engine fails: {error}") from None


def scan_again(
    world: World,
    poses: Sequence[Pose],
    recipe: Recipe,
    *,
    seed: int,
    split: str,
    unit: int,
    names: tuple[int, int],
    derived: bool = True,
    engine: EngineFactory,
) -> Unit:
    """The unit whose flight through `world` had these sensor `poses`, as the recipe's sensor and noise see it.

    `names` are the world's number and the first sample's viewpoint. Nothing is drawn but the noise, and nothing is
    rejected. With what the unit was drawn with, the same samples come out, bit for bit. Raises GenerationError.
    """
    caster = engine_of(engine, world)
    number, first = names
    samples = tuple(
        sample_of(
            with_noise(
                clean_scan(caster, recipe.lidar, pose),
                recipe.noise,
                world,
                caster,
                seed=seed,
                split=split,
                unit=unit,
                view=n,
            ),
            rasterize(world.solids, recipe.grid, recipe.grid.origin_at(pose.position)),
            recipe,
            world,
            number=number,
            viewpoint=first + n,
            derived=derived,
        )
        for n, pose in enumerate(poses)
    )
    return Unit(number, world, samples, Rejections())
