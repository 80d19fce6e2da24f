"""What a stream draws from: components, each a recipe and where its worlds come from, and which of
them takes an index."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from scenegen import GENERATOR, SPLITS
from scenegen.dataset.build import recipe_entry
from scenegen.dataset.shard import Units, find_engine
from scenegen.errors import DatasetError, RecipeError, SceneError, short
from scenegen.files import Json, sha256_of
from scenegen.limits import MOST_UNITS_IN_ROUND
from scenegen.mixture import fraction
from scenegen.paths import WORLD_FILES
from scenegen.recipe import Recipe, preset, read_recipe
from scenegen.recipes import KINDS, graded
from scenegen.source import DrawnWorlds, SceneWorlds, read_scenes, world_files
from scenegen.streams.ahead import Slot

LEAST_SCENES = 3
"""Worlds that a folder holds at least: one a split."""


@dataclass(frozen=True, kw_only=True)
class Component(Units):
    """All that one dataset's samples depend on, but for their number; `tudf` is not among them.

    Raises DatasetError for another split, an engine that is not to be had, and a split without
    worlds.
    """

    label: str
    """What it is called, for people: a kind, or a file."""

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise DatasetError(
                f"stream: has no split {short(self.split)}; expected one of {', '.join(SPLITS)}"
            )
        find_engine(self.engine)
        if isinstance(self.source, SceneWorlds) and not self.source.scenes[self.split]:
            raise SceneError(
                f"{self.label}: no world of it is in the {self.split} split; give a folder of "
                f"{LEAST_SCENES} worlds or more"
            )

    @property
    def viewpoints(self) -> int:
        """Samples of a unit."""
        return self.recipe.flight.viewpoints

    def described(self) -> Json:
        """What decides the samples, as plain JSON values."""
        return {
            "split": self.split,
            "seed": self.seed,
            "generator": GENERATOR,
            "recipe": msgspec.to_builtins(recipe_entry(self.recipe)),
            "scenes": self.source.describe(),
        }

    def fingerprint(self) -> str:
        """A digest of `described`."""
        return sha256_of(json.dumps(self.described(), sort_keys=True).encode())


def component_of(what: Any, *, seed: int, split: str, engine: str) -> Component:
    """The component that `what` names: a kind, as ``module:Class`` if it is a user's own; a recipe,
    or its TOML file; an MJCF file, or a folder of them, dealt to the splits as `generate` deals it;
    a Component stays as it is.

    Raises RecipeError, SceneError and DatasetError.
    """
    if isinstance(what, Component):
        return what
    source: SceneWorlds | None = None
    if isinstance(what, Recipe):
        label, recipe = graded(what.kind, what.difficulty), what
    elif isinstance(what, str | Path):
        label, path = str(what), Path(what)
        is_file = isinstance(what, Path) or path.is_dir() or path.suffix in (".toml", *WORLD_FILES)
        is_own = isinstance(what, str) and ":" in what and not path.exists()
        if what in KINDS.builtin or is_own or not is_file:
            recipe = preset(label)
        elif path.suffix == ".toml":
            recipe = read_recipe(path)
        else:
            source = _scenes(path, seed)
            recipe = source.suited(preset("scene"))
    else:
        raise RecipeError(
            f"stream of {short(what)}: expected a kind's name, a recipe or its file, an MJCF file "
            f"or a folder of them"
        )
    if source is None and recipe.world is None:
        raise RecipeError(
            f'stream of {label}: kind "scene" draws no worlds; give the MJCF file or folder, or a '
            "scenegen.streams.mixture.Component of the recipe and its worlds"
        )
    return Component(
        label=label,
        recipe=recipe,
        source=source or DrawnWorlds(recipe),
        seed=seed,
        split=split,
        engine=engine,
    )


def _scenes(path: Path, seed: int) -> SceneWorlds:
    """The worlds of a file, all for training, or of a folder, dealt to all three splits."""
    counts = dict.fromkeys(SPLITS, 1)
    if path.is_dir():
        if len(world_files(path)) < LEAST_SCENES:
            raise SceneError(
                f"{path}: fewer than {LEAST_SCENES} worlds, and a stream deals some to each split; "
                "add worlds, or give one file, which is all for train"
            )
    else:
        counts |= {"val": 0, "test": 0}
    return read_scenes(path, counts, seed=seed)


class Mixture:
    """Components by weight, whose units come in a fixed order."""

    def __init__(self, components: Sequence[Component], weights: Sequence[Any]):
        """Raises RecipeError for no component, one that is there twice, ones of different grids,
        and weights that are no proportions."""
        if not components:
            raise RecipeError(
                "stream: nothing to draw from; name a kind of world, such as 'pillar'"
            )
        bounds = [one.recipe.known for one in components if one.recipe.known is not None]
        if bounds:  # drawn worlds beside maps of real places say that they know all
            components = [
                replace(one, recipe=replace(one.recipe, known=one.recipe.known or bounds[0]))
                for one in components
            ]
        self.components = tuple(components)
        _check_alike(self.components)
        # weights are of samples, of which a component's units hold `viewpoints` each
        shares = [
            fraction(weight, component.label) / component.viewpoints
            for weight, component in zip(weights, components, strict=True)
        ]
        total = sum(shares)
        shares = [share / total for share in shares]
        denominator = math.lcm(*(share.denominator for share in shares))
        self.units = tuple(int(share * denominator) for share in shares)
        """Units of each component in a round."""
        if sum(self.units) > MOST_UNITS_IN_ROUND:
            named = ", ".join(
                f"{component.label} {short(weight)}"
                for component, weight in zip(components, weights, strict=True)
            )
            raise RecipeError(
                f"stream: weights {named} come round after {short(sum(self.units))} flights, "
                f"expected {MOST_UNITS_IN_ROUND} at most; give proportions such as 2 and 1"
            )
        # the units of each component lie evenly spread in the round
        places = sorted(
            (Fraction(2 * unit + 1, 2 * count), number, unit)
            for number, count in enumerate(self.units)
            for unit in range(count)
        )
        self._round = [(number, unit) for _, number, unit in places]
        """A component's number, and that of one of its units, in the order of samples."""
        self._start = np.cumsum([0, *(components[number].viewpoints for number, _ in self._round)])
        """The first sample of each of these in a round; at last, how many it has."""

    @property
    def row(self) -> int:
        """Samples of a world that come one after the other, whichever component they are of: the
        greatest number that divides every unit."""
        return math.gcd(*(component.viewpoints for component in self.components))

    def place(self, index: int) -> tuple[Slot, int]:
        """(which unit of which component, the sample's place in it) of a sample of the mixture."""
        turn, rest = divmod(index, int(self._start[-1]))
        within = int(np.searchsorted(self._start, rest, side="right")) - 1
        component, number = self._round[within]
        return (component, turn * self.units[component] + number), rest - int(self._start[within])


def parts_of(worlds: Any) -> list[tuple[Any, Any]]:
    """(what, weight) of every part of a mixture: a mapping of weights, a list of parts or of pairs,
    or one part."""
    if isinstance(worlds, Mapping):
        return list(worlds.items())
    if isinstance(worlds, list | tuple):
        return [
            part if isinstance(part, tuple) and len(part) == 2 else (part, 1) for part in worlds
        ]
    return [(worlds, 1)]


def _check_alike(components: Sequence[Component]) -> None:
    first, seen = components[0], dict[str, str]()
    for component in components:
        for what in ("grid", "known"):
            theirs, ours = getattr(component.recipe, what), getattr(first.recipe, what)
            if theirs != ours:
                raise RecipeError(
                    f"stream: the {what} of {component.label} is {theirs}, that of {first.label} "
                    f"is {ours}; a stream has one {what}: mix recipes that share it"
                )
        digest = component.fingerprint()
        if digest in seen:
            raise RecipeError(
                f"stream: {component.label} is there twice, as {seen[digest]}; name it once, and "
                f"give a weight"
            )
        seen[digest] = component.label
