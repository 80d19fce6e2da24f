"""Datasets from what a user asks for: a kind of worlds, a recipe or MJCF files, and how many
samples."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from lidarsim import Sensor
from lidarsim.engines import DEFAULT
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.locate import locate
from scenegen.dataset.mixed import MIXED, is_mixed, plan_mixed, read_components
from scenegen.dataset.read import Dataset
from scenegen.dataset.state import Plan
from scenegen.errors import RecipeError, SceneError
from scenegen.recipe import preset, read_recipe
from scenegen.source import DrawnWorlds, SceneWorlds, read_scenes
from scenegen.stores import folder_of, is_remote
from scenegen.tables import named_lidar
from scenegen.worlds.labels import By, Labels, labels_by


def generate(
    kind: str | None = None,
    n: int = 2500,
    *,
    out: str | Path | None = None,
    workers: int = 1,
    force: bool = False,
    **options: Any,
) -> Dataset:
    """Make a dataset, or go on with one, as `scenegen generate` does.

    Args:
        kind: Name of a kind of random worlds, or a kind of your own as "module:Class".
        n: Training samples.
        out: Folder of the dataset; data/<kind> by default.
        workers: Processes of this machine that write shards.
        force: Replace another dataset in the folder.
        options: Those of `plan_generation`: `val`, `test`, `scene`, `recipe`, `lidar`, `noise`,
            `mapping`, `difficulty`, `labels`, `seed`, `engine`, `compact`, `shard_samples`,
            `allow_unseen`.

    Returns:
        The dataset, opened.

    Raises:
        RecipeError, SceneError: What is asked for cannot be.
        DatasetError: The folder holds something else, or the disk refuses.
        GenerationError: No acceptable world comes out of the recipe's draws.
    """
    plan = plan_generation(kind, n, out=out, **options)
    build(plan, workers=workers, force=force)
    return Dataset(locate(str(plan.folder)))


def plan_generation(
    kind: str | None = None,
    n: int = 2500,
    *,
    val: int | None = None,
    test: int | None = None,
    out: str | Path | None = None,
    scene: str | Path | None = None,
    recipe: str | Path | None = None,
    lidar: str | Sensor | None = None,
    noise: str | None = None,
    mapping: Mapping[str, Any] | None = None,
    difficulty: str | None = None,
    labels: By | None = None,
    seed: int = 0,
    allow_unseen: bool = False,
    tell: Callable[[str], None] = lambda line: None,
    **more: Any,
) -> Plan:
    """The shards of the dataset that is asked for; nothing is written yet.

    Args:
        kind: Name of a kind of random worlds, or "module:Class"; "mixed" for all, or for the
            components of the recipe.
        n: Training samples.
        val: Validation samples; by default a tenth of `n`, and none for a single scene.
        test: Test samples; by default a fifth of `n`, and none for a single scene.
        out: Folder of the dataset; by default data/<kind>, or data/<the scene's name>.
        scene: An MJCF file, a mesh, a map of a real place (.bt, .ot, .npz), or a folder of them, or
            a cloud of points that says where its sensor was, in place
            of random worlds.
        recipe: A TOML file of what differs from the kind's preset.
        lidar: The sensor, or its name; the recipe's by default.
        noise: Stages of noise, such as "range:0.02,dropout:0.05".
        mapping: Parameters of how maps are made.
        difficulty: "easy", "medium" or "hard": which preset of the kind.
        labels: What decides the classes of geoms: "class", "name", "material" or "group".
        seed: The same seed gives the same dataset.
        allow_unseen: Whether scenes may have geoms that rays cannot see.
        tell: Called with a sentence for whatever of the scenes is left out.
        more: `engine`, `compact` and `shard_samples`; see `plan_dataset`.

    Raises:
        RecipeError, SceneError, DatasetError: What is asked for cannot be.
    """
    if kind is None and scene is None and recipe is None:
        raise RecipeError("no worlds are named; give a kind, such as pillar, a scene or a recipe")
    if kind is not None and scene is not None:
        raise RecipeError("a kind draws worlds and a scene has them; give one of the two")
    named, path = ("scene", Path(scene)) if scene is not None else (kind, None)
    sensor = named_lidar(lidar) if isinstance(lidar, str) else lidar
    given: dict[str, Any] = {"lidar": sensor, "noise": noise, "mapping": mapping}
    given["difficulty"] = difficulty
    if named == MIXED or (recipe is not None and is_mixed(Path(recipe))):
        if named not in (None, MIXED):
            raise RecipeError(f"{recipe}: is of several kinds, not of {named}; leave --kind out")
        parts = read_components(None if recipe is None else Path(recipe), **given)
        if labels is not None:
            parts = [
                (dataclasses.replace(one, labels=_labels(labels, DrawnWorlds(one))), weight)
                for one, weight in parts
            ]
        counts = _counts(n, val, test, alone=False)
        return plan_mixed(_folder(out, MIXED), parts, seed=seed, counts=counts, **more)
    if recipe is not None:
        asked = read_recipe(Path(recipe), named, **given)
    else:
        assert named is not None
        asked = preset(named, **given)
    alone = path is not None and not path.is_dir()
    counts = _counts(n, val, test, alone=alone)
    source: DrawnWorlds | SceneWorlds
    if path is not None:
        source = read_scenes(
            path,
            counts,
            seed=seed,
            allow_unseen=allow_unseen,
            materials=labels in ("class", "material"),
        )
        for line in source.notes:
            tell(line)
    elif asked.world is None:
        raise RecipeError(f'{recipe}: kind "scene" needs the worlds, too: give a scene')
    else:
        source = DrawnWorlds(asked)
    if labels is not None:
        asked = dataclasses.replace(asked, labels=_labels(labels, source))
    if isinstance(source, SceneWorlds):
        asked = source.suited(asked)
        if source.maps and more.get("engine", DEFAULT) != DEFAULT:
            raise SceneError(
                f"{source.maps[0]}: is a map of voxels, which has no engine but its own; leave "
                "--engine out"
            )
    # data/Towers for my_worlds:Towers
    name = path.stem if path is not None else asked.kind.rpartition(":")[2]
    return plan_dataset(_folder(out, name), asked, source, seed=seed, counts=counts, **more)


def _counts(n: int, val: int | None, test: int | None, *, alone: bool) -> dict[str, int]:
    """Samples of each split; those of a single scene are all for training unless asked for."""
    return {
        "train": n,
        "val": val if val is not None else 0 if alone else max(n // 10, 1),
        "test": test if test is not None else 0 if alone else max(n // 5, 1),
    }


def _labels(by: By, source: DrawnWorlds | SceneWorlds) -> Labels:
    return labels_by(by, source.class_names(by))


def _folder(out: str | Path | None, name: str) -> Path:
    if out is None:
        return Path("data", name)
    return folder_of(str(out)) if is_remote(out) else Path(out)
