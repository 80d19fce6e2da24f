"""What a stream draws from: a recipe and where its worlds come from, found from a name, a file or a
folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarsim.engines import MUJOCO
from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.shard import find_engine
from scenegen.draw import Unit, draw_unit
from scenegen.errors import DatasetError, RecipeError, SceneError, short
from scenegen.recipe import Recipe, preset, read_recipe
from scenegen.recipes import KINDS
from scenegen.source import DrawnWorlds, SceneWorlds, Source, read_scenes

LEAST_SCENES = 3
"""Worlds that a folder holds at least: one a split."""


@dataclass(frozen=True, kw_only=True)
class Component:
    """All that one dataset's samples depend on, but for their number; small, and can be pickled.

    Raises DatasetError for another split, an engine that is not to be had, and a split without
    worlds.
    """

    label: str
    """What it is called, for people: a kind, or a file."""
    recipe: Recipe
    source: Source
    seed: int = 0
    split: str = "train"
    engine: str = MUJOCO
    """Name of the engine that casts the rays; see `lidarsim.engines.ENGINES`."""

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise DatasetError(
                f"stream: has no split {short(self.split)}; expected one of {', '.join(SPLITS)}"
            )
        find_engine(self.engine)
        if isinstance(self.source, SceneWorlds) and not self.source.scenes[self.split]:
            raise SceneError(
                f"{self.label}: no world of it is in the {self.split} split; give a folder of "
                f"{LEAST_SCENES} worlds or "
                "more"
            )

    @property
    def viewpoints(self) -> int:
        """Samples of a unit."""
        return self.recipe.flight.viewpoints

    def draw(self, unit: int) -> Unit:
        """Unit `unit` as `generate` draws it, but for `tudf`. Raises GenerationError."""
        engine = find_engine(self.engine)
        return draw_unit(
            self.source,
            self.recipe,
            seed=self.seed,
            split=self.split,
            unit=unit,
            derived=False,
            engine=engine,
        )

    def described(self, *, software: bool) -> dict[str, Any]:
        """What decides the samples, as plain JSON values: a manifest's parameters without counts,
        and with the split.

        `software` adds the versions of what they are computed with.
        """
        given = manifest.parameters(
            self.recipe,
            self.source,
            seed=self.seed,
            counts=dict.fromkeys(SPLITS, 0),
            compact=True,
            shard_samples=1,
            engine=self.engine,
        )
        left_out = {"counts", "fields", "shard_samples"} | (set() if software else {"software"})
        return {"split": self.split} | {
            name: value for name, value in given.items() if name not in left_out
        }

    def fingerprint(self, *, software: bool) -> str:
        """A digest of `described`."""
        return manifest.fingerprint(self.described(software=software))


def component_of(what: Any, *, seed: int, split: str, engine: str) -> Component:
    """The component that `what` names: a kind, as ``module:Class`` if it is a user's own; a recipe,
    or its TOML file; an MJCF file, or a folder of them, dealt to the splits as `generate` deals it;
    a Component stays as it is.

    Raises RecipeError, SceneError and DatasetError.
    """
    if isinstance(what, Component):
        return what
    if isinstance(what, Recipe):
        label, recipe = what.kind, what
    elif not isinstance(what, str | Path):
        raise RecipeError(
            f"stream of {short(what)}: expected a kind's name, a recipe or its file, an MJCF file "
            f"or a folder of them"
        )
    else:
        label, path = str(what), Path(what)
        named = isinstance(what, str) and (
            what in KINDS.known or (":" in what and not path.exists())
        )
        if not named and path.suffix == ".toml":
            recipe = read_recipe(path)
        elif not named and (isinstance(what, Path) or path.is_dir() or path.suffix == ".xml"):
            source = _scenes(path, seed)
            return Component(
                label=label,
                recipe=preset("scene"),
                source=source,
                seed=seed,
                split=split,
                engine=engine,
            )
        else:
            recipe = preset(label)
    if recipe.world is None:
        raise RecipeError(
            f'stream of {label}: kind "scene" draws no worlds; give the MJCF file or folder, or a '
            "scenegen.streams.component.Component of the recipe and its worlds"
        )
    return Component(
        label=label,
        recipe=recipe,
        source=DrawnWorlds(recipe),
        seed=seed,
        split=split,
        engine=engine,
    )


def _scenes(path: Path, seed: int) -> SceneWorlds:
    """The worlds of a file, all for training, or of a folder, dealt to all three splits."""
    counts = dict.fromkeys(SPLITS, 1)
    if path.is_dir():
        if len(list(path.glob("*.xml"))) < LEAST_SCENES:
            raise SceneError(
                f"{path}: fewer than {LEAST_SCENES} worlds, and a stream deals some to each "
                f"split; add worlds, or "
                "give one file, which is all for train"
            )
    else:
        counts |= {"val": 0, "test": 0}
    return read_scenes(path, counts, seed=seed)
