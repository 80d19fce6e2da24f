"""Where worlds come from: drawn anew by a recipe, or from MJCF files drawn by hand.

A source answers one question: which world does unit u of a split fly through? A *unit* is one flight and its samples.
"""

import functools
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from scenegen import SPLITS
from scenegen.errors import RecipeError, SceneError
from scenegen.geometry import geometry_digest
from scenegen.recipe import Recipe
from scenegen.truth import Solids
from scenegen.world import World, compile_world, load_scene, write_world

SHARES = {"train": 10, "val": 1, "test": 2}
"""How a folder of worlds is dealt out."""


class Source(Protocol):
    """Worlds by number. A source is small and can be pickled: it travels to worker processes and clusters."""

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """(the world's number within its split, how many earlier units of the split flew through the same world)."""
        ...

    def world(self, split: str, number: int, *, rng: np.random.Generator) -> World:
        """The world itself; a source that draws does so from `rng` alone."""
        ...

    def describe(self) -> dict[str, Any]:
        """What identifies the source, for the manifest."""
        ...


@dataclass(frozen=True)
class DrawnWorlds:
    """A new world for every unit, drawn by the recipe's kind."""

    recipe: Recipe

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """See `Source.number`."""
        return unit, 0

    def world(self, split: str, number: int, *, rng: np.random.Generator) -> World:
        """See `Source.world`."""
        kind = self.recipe.world
        if kind is None:
            raise RecipeError('kind "scene" draws no worlds; give the MJCF file or folder with --scene')
        bounds = self.recipe.flight.bounds(kind.size_m)
        try:
            return write_world(lambda spec: kind.add_to(spec, rng=rng), flight_bounds=bounds)
        except ValueError as error:
            raise RecipeError(f"[world] of kind {self.recipe.kind!r} draws what cannot be: {error}") from None

    def describe(self) -> dict[str, Any]:
        """See `Source.describe`."""
        return {}


@dataclass(frozen=True)
class Scene:
    """One MJCF file, made self-contained."""

    name: str
    mjcf: bytes
    assets: Mapping[str, bytes]


@dataclass(frozen=True)
class SceneWorlds:
    """Worlds drawn by hand. The units of a split visit its worlds in turn, each time with another flight, so that any
    number of samples spreads evenly over them."""

    scenes: Mapping[str, tuple[Scene, ...]]
    """The worlds of each split."""

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """See `Source.number`."""
        turn, number = divmod(unit, len(self.scenes[split]))
        return number, turn

    def world(self, split: str, number: int, *, rng: np.random.Generator) -> World:
        """See `Source.world`."""
        scene = self.scenes[split][number]
        return _compiled(scene.name, scene.mjcf, tuple(scene.assets.items()))

    def describe(self) -> dict[str, Any]:
        """See `Source.describe`."""
        return {
            split: [{"file": scene.name, "sha256": _content_digest(scene)} for scene in scenes]
            for split, scenes in self.scenes.items()
            if scenes
        }


@functools.lru_cache(maxsize=8)
def _compiled(name: str, mjcf: bytes, assets: tuple[tuple[str, bytes], ...]) -> World:
    return compile_world(mjcf, dict(assets), name=name)


def _content_digest(scene: Scene) -> str:
    digest = hashlib.sha256(scene.mjcf)
    for name, content in sorted(scene.assets.items()):
        digest.update(name.encode() + hashlib.sha256(content).digest())
    return digest.hexdigest()


def read_scenes(path: Path, counts: Mapping[str, int], *, seed: int, allow_unseen: bool = False) -> SceneWorlds:
    """The MJCF file at `path`, all for training, or the folder of them, split by world as `SHARES` says.

    Which world goes to which split depends on the files' names, the seed, and which splits `counts` asks for, never on
    how many samples. Raises SceneError for a file that cannot serve, for one with geoms that rays cannot see (unless
    `allow_unseen`), for two of the same world, and for a folder with fewer worlds than splits.
    """
    if not path.exists():
        raise SceneError(f"{path}: no such file or folder; expected an MJCF file or a folder of them")
    files = sorted(path.glob("*.xml")) if path.is_dir() else [path]
    if not files:
        raise SceneError(f"{path}: holds no .xml file; expected MJCF worlds")
    worlds = [_read_scene(file, allow_unseen) for file in files]
    _check_twins(files, [solids for _, solids in worlds])
    scenes = [scene for scene, _ in worlds]
    if len(scenes) == 1:
        for split in ("val", "test"):
            if counts[split]:
                raise SceneError(f"{path}: one world cannot be split; leave --{split} out, or give a folder of worlds")
        return SceneWorlds({"train": (scenes[0],), "val": (), "test": ()})
    wanted = [split for split in SPLITS if counts[split]]
    if len(scenes) < len(wanted):
        raise SceneError(
            f"{path}: {len(scenes)} worlds for {len(wanted)} splits; add worlds, or set --val or --test to 0"
        )
    order = np.random.default_rng(np.random.SeedSequence(seed)).permutation(len(scenes))
    whole = sum(SHARES[split] for split in wanted)
    share = {split: max(1, len(scenes) * SHARES[split] // whole) for split in wanted}
    share[wanted[0]] = len(scenes) - sum(share[split] for split in wanted[1:])
    dealt = iter(order)
    return SceneWorlds({split: tuple(scenes[next(dealt)] for _ in range(share.get(split, 0))) for split in SPLITS})


def _check_twins(files: Sequence[Path], worlds: Sequence[Solids]) -> None:
    """Raise SceneError where two files hold the same solids: they could come to lie in two splits."""
    owner: dict[bytes, Path] = {}
    for path, solids in zip(files, worlds, strict=True):
        first = owner.setdefault(geometry_digest(solids), path)
        if first is not path:
            raise SceneError(
                f"{path}: the same world as {first.name}, whatever its geoms are called; remove one of the two"
            )


def _read_scene(path: Path, allow_unseen: bool) -> tuple[Scene, Solids]:
    mjcf, assets = load_scene(path)
    world = compile_world(mjcf, assets, name=str(path))
    unseen = world.unseen
    if unseen and not allow_unseen:
        named = ", ".join(unseen[:3]) + (f" and {len(unseen) - 3} more" if len(unseen) > 3 else "")
        raise SceneError(
            f"{path}: rays cannot see geom {named} (alpha 0); give it an alpha above 0, remove it, or pass "
            "--allow-unseen to leave it out of the truth"
        )
    return Scene(path.name, mjcf, assets), world.solids
