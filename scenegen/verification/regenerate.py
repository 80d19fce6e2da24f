"""Samples made again from the seed, to be compared bit for bit."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim import Pose
from lidarsim.engines import ENGINES
from scenegen import GENERATOR
from scenegen.dataset.manifest import differences
from scenegen.draw import Unit, draw_unit
from scenegen.errors import GenerationError, RecipeError, SceneError
from scenegen.recipe import Recipe
from scenegen.rescan import scan_again
from scenegen.run.software import software
from scenegen.source import DrawnWorlds, SceneWorlds
from scenegen.verification.archive import Archive, archived_world
from scenegen.verification.contract import Contract
from scenegen.verification.report import BrokenError
from scenegen.worlds.world import World, compile_world


@dataclass(frozen=True, eq=False, kw_only=True)
class ArchivedWorlds(SceneWorlds):
    """Worlds from MJCF files, as they lie in a shard's archive; `scenes` only counts them."""

    archive: Archive

    def world(self, split: str, number: int, *, rng: np.random.Generator) -> World:
        """See `Source.world`."""
        return compile_world(*self.archive.world(number))


def regenerate(
    contract: Contract,
    archive: Archive,
    split: str,
    unit: int,
    poses: Callable[[], list[list[Pose]]],
) -> Unit:
    """One flight of a dataset whose engine and noise are ours, flown again; or, where the dataset
    is one that was scanned again, scanned so from its stored `poses`. Raises BrokenError where
    nothing comes of it."""
    if lacking := _lacking(contract.engine):
        raise BrokenError(
            f"{split} flight {unit} cannot be made again: the engine {contract.engine} {lacking}"
        )
    recipe: Recipe = contract.recipe
    scenes: Any = contract.scenes
    engine = ENGINES.find(contract.engine).of
    try:
        if contract.rescan is not None:
            names = contract.numbering(split).name(unit * contract.viewpoints)
            world, seed = archived_world(archive, names[0]), contract.seed
            return scan_again(
                world,
                poses(),
                recipe,
                seed=seed,
                split=split,
                unit=unit,
                names=names,
                engine=engine,
            )
        source = (
            DrawnWorlds(recipe)
            if scenes is None
            else ArchivedWorlds(scenes=scenes, archive=archive)
        )
        return draw_unit(
            source, recipe, seed=contract.seed, split=split, unit=unit, derived=True, engine=engine
        )
    except (GenerationError, RecipeError, SceneError) as error:
        raise BrokenError(f"{split} flight {unit} cannot be made again: {error}") from None


def why_not_comparable(contract: Contract) -> str:
    """Why samples made here need not have the dataset's bits; empty where they must."""
    if not contract.drawn and contract.scenes is None and contract.rescan is None:
        advice = "; if it is yours, give --kind with its name" if ":" in contract.kind else ""
        return f"kind {contract.kind!r} is none of scenegen's own: its worlds cannot be drawn again{advice}"
    return why_not_scanned(contract)


def why_not_scanned(contract: Contract) -> str:
    """Why scans made here of the archived worlds need not have the dataset's bits; empty where they
    must."""
    if not contract.noise_is_ours:
        return "made with noise that is not scenegen's own, so it is not imported"
    if contract.engine not in ENGINES.known:
        return f"made with the engine {contract.engine!r}, which is not scenegen's own, so it is not imported"
    if lacking := _lacking(contract.engine):
        return f"made with the engine {contract.engine!r}, which {lacking}"
    if contract.generator != GENERATOR:
        return f"made by generator {contract.generator}, here is generator {GENERATOR}"
    differing = differences(contract.software, software())
    named = ", ".join(line.replace(" asked for", " here") for line in differing)
    return f"made with other software: {named}" if differing else ""


def _lacking(engine: str) -> str:
    """What this machine lacks to run an engine of ours, as the end of a sentence; mostly
    nothing."""
    return getattr(ENGINES.find(engine), "missing", str)()
