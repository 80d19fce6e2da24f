"""Where worlds come from: drawn anew by a recipe, or read from MJCF files.

A source answers one question: which world does unit u of a split fly through? A *unit* is one
flight and its samples.
"""

import functools
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.random import Generator

from scenegen import SPLITS
from scenegen.base.errors import BrokenError, RecipeError, SceneError, plural, printable, raised_as
from scenegen.base.files import Json, real_path, world_digest
from scenegen.base.limits import (
    MOST_ARCHIVE_BYTES,
    MOST_GEOMS,
    MOST_MEMBERS,
    SCENE_BYTES,
    SCENE_SECONDS,
)
from scenegen.base.paths import CLOUDS, MAPS, MESHES
from scenegen.base.workers import Limited, run
from scenegen.worlds.classes import By
from scenegen.worlds.labels import class_names
from scenegen.worlds.mapping import Known
from scenegen.worlds.recipe import Acceptance, Recipe, preset
from scenegen.worlds.scene import Reading, Scene, named, read_file
from scenegen.worlds.world import AnyWorld, World, archived_world, solid, write_world

SHARES = {"train": 10, "val": 1, "test": 2}
"""How a folder of worlds is dealt out."""


class Source(Protocol):
    """Worlds by number. A source is small and can be pickled: it travels to worker processes and
    clusters."""

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """(the world's number within its split, how many earlier units of the split flew through
        the same world)."""
        ...

    def world(self, split: str, number: int, *, rng: Generator) -> AnyWorld:
        """The world itself; a source that draws does so from `rng` alone."""
        ...

    def describe(self) -> Json:
        """What identifies the source, for the manifest; nothing where the recipe says all."""
        return {}


@dataclass(frozen=True)
class DrawnWorlds(Source):
    """A new world for every unit, drawn by the recipe's kind."""

    recipe: Recipe

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """A world a unit."""
        return unit, 0

    def world(self, split: str, number: int, *, rng: Generator) -> World:
        """Draw the world from `rng`. Raises RecipeError for what MuJoCo does not take."""
        kind = self.recipe.world
        if kind is None:
            raise RecipeError(
                'kind "scene" draws no worlds; give the MJCF file or folder with --scene'
            )
        bounds = self.recipe.flight.bounds(kind.size_m)
        # a user's own kind may draw what cannot be whatever the values
        advice = "correct it" if ":" in self.recipe.kind else "take values nearer to the preset's"
        with raised_as(
            RecipeError,
            f"[world] of kind {self.recipe.kind!r} draws what cannot be: ",
            f"; {advice}",
            of=(ValueError, BrokenError, SceneError),
        ):
            return write_world(lambda spec: kind.add_to(spec, rng=rng), flight_bounds=bounds)

    def class_names(self, by: By) -> set[str]:
        """Classes of its worlds' geoms, as far as the kind says: its `classes`."""
        return set(getattr(self.recipe.world, "classes", ()))


MAP_DRAWS = 500
"""In building 079, nine of ten draws find no flight."""


@dataclass(frozen=True)
class SceneWorlds:
    """Worlds from files, MJCF or maps. The units of a split visit its worlds in turn, each time
    with another flight, so that any number of samples spreads evenly over them."""

    scenes: Mapping[str, Sequence[Scene]]
    """The worlds of each split."""
    notes: tuple[str, ...] = ()
    """What was left out of the files or taken otherwise than one might expect: a sentence each."""

    def number(self, split: str, unit: int) -> tuple[int, int]:
        """The split's worlds in turn."""
        turn, number = divmod(unit, len(self.scenes[split]))
        return number, turn

    def world(self, split: str, number: int, *, rng: Generator) -> AnyWorld:
        """The world of a file; nothing is drawn."""
        scene = self.scenes[split][number]
        return _compiled(scene.name, scene.mjcf, tuple(scene.assets.items()))

    def describe(self) -> Json:
        """The files and their digests, by split."""
        return {
            split: [
                {"file": scene.name, "sha256": world_digest(scene.mjcf, scene.assets).hex()}
                for scene in scenes
            ]
            for split, scenes in self.scenes.items()
            if scenes
        }

    def class_names(self, by: By) -> set[str]:
        """Classes of its worlds' geoms."""
        rng = np.random.default_rng(0)
        worlds = (
            self.world(split, n, rng=rng)
            for split, of in self.scenes.items()
            for n in range(len(of))
        )
        return {
            name
            for world in worlds
            for name in class_names(solid(world, "--labels: one of the worlds").model, by)
        }

    @property
    def maps(self) -> list[str]:
        """The names of those that are maps of real places."""
        return [scene.name for of in self.scenes.values() for scene in of if scene.is_map]

    def suited(self, recipe: Recipe) -> Recipe:
        """`recipe`; where a world is a map, with `known`, and with more draws of a flight than the
        usual, since many end at unknown space."""
        if not self.maps:
            return recipe
        recipe = replace(recipe, known=recipe.known or Known())
        if recipe.accept.max_draws == Acceptance.max_draws:
            more = replace(recipe.accept, max_draws=MAP_DRAWS)
            with suppress(ValueError):  # of flights that search long, so many may not be drawn
                return replace(recipe, accept=more)
        return recipe


def read_world(path: str | Path, tell: Callable[[str], None] | None = None) -> AnyWorld:
    """The world of an MJCF file, or of a map of a real place; `tell` hears its `notes`. Raises
    SceneError for a file that cannot serve."""
    if Path(path).is_dir():
        raise SceneError(f"{path}: is a folder; expected one MJCF file, or a map")
    source = read_scenes(Path(path), {"train": 1, "val": 0, "test": 0}, seed=0, allow_unseen=True)
    if tell:
        for line in source.notes:
            tell(line)
    return source.world("train", 0, rng=np.random.default_rng(0))


def named_world(
    name: str,
    seed: int,
    difficulty: str | None = None,
    tell: Callable[[str], None] | None = None,
) -> AnyWorld:
    """The world of a file, see `read_world`, or one of the kind called `name`, as its preset of
    that difficulty draws it by `seed`."""
    if Path(name).exists() or (":" not in name and not name.isidentifier()):
        return read_world(name, tell)
    drawn = DrawnWorlds(preset(name, difficulty=difficulty))
    return drawn.world("train", 0, rng=np.random.default_rng(seed))


@functools.lru_cache(maxsize=8)
def _compiled(name: str, mjcf: bytes, assets: tuple[tuple[str, bytes], ...]) -> AnyWorld:
    return archived_world(mjcf, dict(assets), name=name)


def read_scenes(
    path: Path,
    counts: Mapping[str, int | None],
    *,
    seed: int,
    allow_unseen: bool = False,
    materials: bool = False,
) -> SceneWorlds:
    """Worlds from files, MJCF or maps, dealt to the splits as `SHARES` says.

    Which world goes to which split depends on the files' names, the seed, and which splits are
    asked for, never on how many samples.

    Args:
        path: An MJCF file, a mesh, a map of a real place, or a folder of them; or a cloud of
            points.
        counts: How many samples each split shall have; None for some if there are several worlds.
        seed: What the worlds are dealt by.
        allow_unseen: Whether worlds may have geoms that rays cannot see.
        materials: Whether worlds keep the names of their materials.

    Raises:
        SceneError: A file cannot serve, two are the same world, or there are fewer worlds than
            splits.
    """
    if not path.exists():
        raise SceneError(f"{path}: no such file or folder; expected MJCF, or a map")
    files = sorted(world_files(path)) if path.is_dir() else [path]
    scenes, parts = _read_files(files, materials)
    if not scenes:
        raise SceneError(
            f"{path}: holds no world, or parts alone, which other files include; expected MJCF, "
            "meshes or maps (scenegen map makes one of point clouds)"
        )
    _check(scenes, allow_unseen)
    notes = [f"{path}: {named(parts)} left out: parts, which other files include"] if parts else []
    notes += [note for scene in scenes.values() for note in scene.notes]
    several = len(scenes) > 1
    splits = [split for split in SPLITS if (several if counts[split] is None else counts[split])]
    if len(scenes) < len(splits):
        raise SceneError(
            f"{path}: {plural(len(scenes), 'worlds')} for {len(splits)} splits, and no two splits "
            "share one; add worlds, or set --val and --test to 0 and measure on the training "
            "samples (bench --split train)"
        )
    order = np.random.default_rng(seed).permutation(len(scenes)).tolist()
    shares = sum(SHARES[split] for split in splits)
    sizes = {split: max(1, len(scenes) * SHARES[split] // shares) for split in splits}
    sizes[splits[0]] = len(scenes) - sum(sizes[split] for split in splits[1:])
    by_number = list(scenes.values())
    dealt = iter([by_number[number] for number in order])
    worlds = {split: tuple(itertools.islice(dealt, sizes.get(split, 0))) for split in SPLITS}
    return SceneWorlds(worlds, tuple(notes))


def world_files(folder: Path) -> list[Path]:
    """The files in a folder that may be worlds. Meshes are where no MJCF file is there, which may
    refer to them; clouds are not: several may be of one place."""
    there = list(folder.iterdir())
    mjcf = [path for path in there if path.suffix == ".xml"]
    others = MAPS if mjcf else (*MAPS, *MESHES)
    return mjcf + [path for path in there if path.suffix in others]


def _read_files(files: Sequence[Path], materials: bool) -> tuple[dict[Path, Scene], list[str]]:
    """The worlds among `files`, and the names of those that are parts of others.

    MJCF and meshes are read one after the other in a process of their own, which a file that never
    ends, or takes all memory, cannot outlive; it costs about a second, in which kernels are loaded
    that this process loads again. Maps and clouds are read here, by code that is bounded itself.
    """
    read = Limited(
        functools.partial(_read_alone, materials=materials),
        lambda _: SCENE_SECONDS,
        SCENE_BYTES,
        _given_up,
    )
    maps = [path for path in files if path.suffix in (*MAPS, *CLOUDS)]
    readings = [read_file(path) for path in maps]
    readings += run(read, [path for path in files if path not in maps], 1)
    readings.sort(key=lambda reading: reading.path)
    included = {path for reading in readings for path in reading.includes}
    scenes, parts = dict[Path, Scene](), list[str]()
    for reading in readings:
        if real_path(reading.path) in included or reading.outcome is None:
            parts.append(reading.path.name)
        elif isinstance(reading.outcome, SceneError):
            raise reading.outcome
        else:
            scenes[reading.path] = reading.outcome
    return scenes, parts


def _read_alone(path: Path, *, materials: bool) -> Reading:
    """`read_file` in a process of its own, where Qhull may print: MuJoCo tells what is wrong."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    return read_file(path, materials=materials)


def _given_up(path: Path, reason: str) -> Reading:
    allowed = f"{SCENE_SECONDS:g} s and {SCENE_BYTES >> 30} GB"
    fault = f"{path}: reading it {reason}; {allowed} are allowed: give a simpler world, of "
    fault += f"{MOST_GEOMS} geoms at most"
    return Reading(path, SceneError(fault))


def _check(scenes: Mapping[Path, Scene], allow_unseen: bool) -> None:
    """Raise SceneError for geoms that rays cannot see, for two files of the same solids, which
    could come to lie in two splits, and for more than an archive may hold."""
    owner, files, total = dict[bytes, Path](), set[str](), 0
    for path, scene in scenes.items():
        if scene.unseen and not allow_unseen:
            raise SceneError(
                f"{path}: rays cannot see geom {printable(named(scene.unseen))} (alpha 0); give it "
                "an alpha above 0, remove it, or pass --allow-unseen to leave it out of the truth"
            )
        first = owner.setdefault(scene.geometry, path)
        if first is not path:
            raise SceneError(
                f"{path}: the same world as {first.name}, whatever its geoms are called; remove "
                "one of the two"
            )
        total += len(scene.mjcf)
        total += sum(len(scene.assets[name]) for name in scene.assets.keys() - files)
        files |= {path.name, *scene.assets}
        if total > MOST_ARCHIVE_BYTES or len(files) > MOST_MEMBERS:
            raise SceneError(
                f"{path.parent}: the worlds take more than {MOST_ARCHIVE_BYTES} bytes or "
                f"{MOST_MEMBERS} files; use coarser meshes, or fewer worlds"
            )
