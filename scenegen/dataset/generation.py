"""Datasets from what a user asks for: a kind of worlds, several by weight, a recipe or MJCF files,
and how many samples."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidarsim import Sensor
from lidarsim.engines import DEFAULT
from lidarsim.noise.chain import Noise
from scenegen import SPLITS
from scenegen.base.errors import (
    AskedError,
    DatasetError,
    RecipeError,
    SceneError,
    raised_as,
    short,
    whole_number,
)
from scenegen.base.files import Json, disk_told
from scenegen.base.limits import MOST_SAMPLES
from scenegen.base.stores import Place, Store, place_of
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.collection import COLLECTION, members_of, open_data, write_collection
from scenegen.dataset.like import plan_like
from scenegen.dataset.read import AnyDataset
from scenegen.dataset.state import Plan
from scenegen.draw.mixture import MIXED, Component, is_mixed, read_components, seeds, shares
from scenegen.draw.parts import PARTS, resolved
from scenegen.draw.source import DrawnWorlds, SceneWorlds, read_scenes
from scenegen.worlds.kinds import graded
from scenegen.worlds.recipe import Recipe, preset, read_recipe
from scenegen.worlds.tables import named_lidar


@dataclass(frozen=True, kw_only=True)
class Plans:
    """What is to be made: a dataset, or a collection of several."""

    folder: Place
    datasets: tuple[Plan, ...]
    """The dataset; or several, in folders of `folder`."""

    @property
    def is_collection(self) -> bool:
        """Whether `folder` is to hold several datasets."""
        return self.datasets[0].folder != self.folder

    def open(self, *, force: bool = False) -> None:
        """Have the folder of a collection list its datasets. Raises DatasetError where it holds
        something else, unless `force` is given."""
        if not self.is_collection or isinstance(self.folder, Store):
            return
        members = [plan.name for plan in self.datasets]
        path = self.folder / COLLECTION
        with disk_told(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            others = {item.name for item in self.folder.iterdir()} - {COLLECTION, *members}
        others = {name for name in others if not name.endswith(".tmp")}
        if others and not path.exists():
            raise DatasetError(
                f"{self.folder}: holds other files ({min(others)}, …); choose another folder with "
                "--out"
            )
        if path.exists() and not force:
            before = [member.name for member in members_of(self.folder)]
            if before != members:
                raise DatasetError(
                    f"{self.folder}: holds another collection, of {', '.join(before)[:200]}; "
                    "choose another folder with --out, or replace it with --force"
                )
        write_collection(self.folder, members)


def generate(
    kind: str | None = None,
    n: int | None = None,
    *,
    out: str | Path | None = None,
    workers: int = 1,
    force: bool = False,
    **options: Any,
) -> AnyDataset:
    """Make a dataset, or go on with one, as `scenegen generate` does.

    Args:
        kind: Name of a kind of random worlds, or a kind of your own as "module:Class"; "mixed" for
            a collection of all kinds.
        n: Training samples; 2500 by default.
        out: Folder of the dataset; data/<kind> by default.
        workers: Processes of this machine that write shards.
        force: Replace another dataset in the folder.
        options: Those of `scenegen.dataset.generation.plan_generation`, whose help says more:
            `val`, `test`, `scene`, `recipe`, `like`, `lidar`, `noise`, `mapping`, `difficulty`,
            `labels`, `normals`, `seed`, `engine`, `compact`, `shard_samples`, `allow_unseen`.

    Returns:
        The dataset, or the collection, opened.

    Raises:
        RecipeError, SceneError: What is asked for cannot be.
        DatasetError: The folder holds something else, or the disk refuses.
        GenerationError: No acceptable world comes out of the recipe's draws.
    """
    plans = plan_generation(kind, n, out=out, **options)
    plans.open(force=force)
    for plan in plans.datasets:
        build(plan, workers=workers, force=force)
    return open_data(str(plans.folder))


def plan_generation(
    kind: str | None = None,
    n: int | None = None,
    *,
    val: int | None = None,
    test: int | None = None,
    out: str | Place | None = None,
    scene: str | Path | None = None,
    recipe: str | Path | Recipe | None = None,
    like: str | Path | None = None,
    lidar: str | Sensor | None = None,
    noise: str | None = None,
    mapping: Mapping[str, Any] | None = None,
    difficulty: str | None = None,
    seed: int | None = None,
    allow_unseen: bool = False,
    report: Callable[[str], None] = lambda line: None,
    engine: str | None = None,
    compact: bool = False,
    shard_samples: int | None = None,
    **parts: Any,
) -> Plans:
    """The shards of the dataset that is asked for, or of several; nothing is written yet.

    Args:
        kind: Name of a kind of random worlds, or "module:Class"; "mixed" for all, or for the
            components of the recipe.
        n: Training samples; 2500 by default.
        val: Validation samples; by default a tenth of `n`, and none where there is one world.
        test: Test samples; by default a fifth of `n`, and none where there is one world.
        out: Folder of the dataset; by default data/<kind>, or data/<the scene's name>.
        scene: An MJCF file, a mesh, a map of a real place (.bt, .ot, .npz), or a folder of them, or
            a point cloud that says where its sensor was, in place of random worlds.
        recipe: A TOML file of what differs from the kind's preset, or a whole `Recipe`.
        like: A dataset, or its manifest: see `scenegen.dataset.like.plan_like`.
        lidar: The sensor, or its name; the recipe's by default.
        noise: Stages of noise, such as "range:0.02,dropout:0.05"; "none" for none.
        mapping: Parameters of how maps are made.
        difficulty: "easy", "medium" or "hard": which preset of the kind.
        seed: The same seed gives the same dataset; 0 by default.
        allow_unseen: Whether scenes may have geoms that rays cannot see.
        report: Called with a sentence for whatever of the scenes is left out.
        engine: Names what casts the rays; see `lidarsim.engines.ENGINES`.
        compact: Whether fields that follow from others are left out.
        shard_samples: About how many samples a shard has.
        parts: Parts of samples that are stored besides, by their names in `PARTS`:
            `labels`, "class", "name", "material" or "group"; `normals`, True.

    Raises:
        RecipeError, SceneError, DatasetError: What is asked for cannot be.
    """
    if kind is None and scene is None and recipe is None and like is None:
        raise AskedError(
            "no worlds are named; give a kind, such as --kind pillar, a --scene, a --recipe, or a "
            "dataset with --like"
        )
    if kind is not None and scene is not None:
        raise AskedError("a kind draws worlds and a scene has them; give one of the two")
    for name in parts.keys() - PARTS.keys():
        raise AskedError(f"unknown option {short(name)}; expected {', '.join(PARTS)}")
    mapping = mapping or None  # of no parameters, it is none
    sensing: Json = {"lidar": lidar, "noise": noise, "mapping": mapping}
    written: Json = {"compact": compact}
    if shard_samples is not None:
        written["shard_samples"] = shard_samples
    if like is not None:
        own = {"scene": scene, "recipe": recipe, "difficulty": difficulty, "seed": seed, **parts}
        if odd := [name for name, value in own.items() if value]:
            raise AskedError(f"--like says all of worlds; leave out {', '.join(odd)}")
        numbers = None
        if (n, val, test) != (None, None, None):
            numbers = _counts(2500 if n is None else n, val, test, alone=False)
        return _plan_like(like, out, kind, sensing, engine, numbers, compact=compact)
    written["engine"] = engine or DEFAULT
    beside: Json = sensing | {"difficulty": difficulty}
    named = kind if scene is None else "scene"
    file = None if isinstance(recipe, Recipe | None) else Path(recipe)
    number, seed = 2500 if n is None else n, seed or 0
    if isinstance(recipe, Recipe):
        if named not in (None, recipe.kind) or any(beside.values()):
            raise AskedError(
                f"a whole Recipe, of kind {recipe.kind}, says all but worlds from files; leave "
                f"out a kind, {', '.join(beside)}"
            )
        asked = recipe
    elif named == MIXED or (file is not None and is_mixed(file)):
        if named not in (None, MIXED):
            raise RecipeError(f"{recipe}: is of several kinds, not of {named}; leave --kind out")
        components = [
            (_with_parts(one, parts, DrawnWorlds(one)), weight)
            for one, weight in read_components(file, seed=seed, **beside)
        ]
        counts = _counts(number, val, test, alone=False)
        folder = _folder(out, MIXED)
        return plan_mixed(folder, components, seed=seed, counts=counts, **written)
    elif file is not None:
        asked = read_recipe(file, named, **beside)
    else:
        assert named is not None
        asked = preset(named, **beside)
    source: DrawnWorlds | SceneWorlds
    if scene is not None:
        source = read_scenes(
            Path(scene),
            {"train": number, "val": val, "test": test},
            seed=seed,
            allow_unseen=allow_unseen,
            materials=parts.get("labels") in ("class", "material"),
        )
        for line in source.notes:
            report(line)
        if source.maps and written["engine"] != DEFAULT:
            raise SceneError(
                f"{source.maps[0]}: is a map of voxels, which has no engine but its own; leave "
                "--engine out"
            )
        asked, name = source.suited(asked), Path(scene).stem
        alone = sum(map(len, source.scenes.values())) == 1
    elif asked.world is None:
        raise RecipeError('a recipe of kind "scene" needs the worlds, too: give a scene')
    else:
        source, alone = DrawnWorlds(asked), False
        name = asked.kind.rpartition(":")[2]  # data/Towers for my_worlds:Towers
    asked = _with_parts(asked, parts, source)
    if asked.parts and isinstance(source, SceneWorlds) and source.maps:
        raise SceneError(
            f"{source.maps[0]}: is a map of voxels, which has no geoms; leave out "
            f"--{', --'.join(asked.parts)}"
        )
    counts = _counts(number, val, test, alone=alone)
    folder = _folder(out, name)
    plan = plan_dataset(folder, asked, source, seed=seed, counts=counts, **written)
    return Plans(folder=folder, datasets=(plan,))


def _plan_like(
    like: str | Path,
    out: str | Place | None,
    kind: str | None,
    sensing: Json,
    engine: str | None,
    counts: Mapping[str, int] | None,
    *,
    compact: bool,
) -> Plans:
    """A dataset like another one; see `plan_generation`."""
    if out is None:
        raise AskedError("a dataset like another one needs a folder of its own; give --out")
    folder, lidar = _folder(out, ""), sensing["lidar"]
    sensor = None if lidar is None else named_lidar(lidar)
    text = sensing["noise"]
    with raised_as(RecipeError):
        noise = None if text is None else Noise.parse(text, sensor)
    options: Json = {} if counts is None else {"counts": counts}
    options |= {"compact": True} if compact else {}
    plan = plan_like(
        like,
        folder,
        kind=kind,
        lidar=sensor,
        noise=noise,
        mapping=sensing["mapping"],
        engine=engine,
        **options,
    )
    return Plans(folder=folder, datasets=(plan,))


def _counts(n: int, val: int | None, test: int | None, *, alone: bool) -> dict[str, int]:
    """Samples of each split; those of the only world are all for training unless asked for. Raises
    DatasetError for numbers beyond those that readers take."""
    n = whole_number("--n", n, 0, MOST_SAMPLES)
    usual = {"val": 0 if alone else max(n // 10, 1), "test": 0 if alone else max(n // 5, 1)}
    return {"train": n} | {
        split: usual[split] if count is None else whole_number(f"--{split}", count, 0, MOST_SAMPLES)
        for split, count in (("val", val), ("test", test))
    }


def _with_parts(
    recipe: Recipe, parts: Mapping[str, Any], source: DrawnWorlds | SceneWorlds
) -> Recipe:
    """`recipe` with the `parts` of samples that the user chose."""
    return replace(recipe, parts={**recipe.parts, **resolved(parts, source.class_names)})


def _folder(out: str | Place | None, name: str) -> Place:
    if out is None:
        return Path("data", name)
    return place_of(out) if isinstance(out, str) else out


def plan_mixed(
    folder: Place,
    components: Sequence[Component],
    *,
    counts: Mapping[str, int],
    seed: int,
    **options: Any,
) -> Plans:
    """Divide `counts` (samples a split) among the components, each a dataset in a folder of its
    own.

    The component's samples are those of the dataset with as many samples and its own of the
    `seeds`. `options` are those of `plan_dataset`. Raises DatasetError, and RecipeError where the
    components have different grids.
    """
    if isinstance(folder, Store):
        raise DatasetError(
            f"{folder}: several datasets go to a folder; make each by itself for a store"
        )
    weights = [weight for _, weight in components]
    by_split = {split: shares(counts[split], weights) for split in SPLITS}
    recipes = [recipe for recipe, _ in components]
    own_seeds = seeds([recipe.kind for recipe in recipes], seed)
    names = folder_names([graded(one.kind, one.difficulty) for one in recipes])
    plans = []
    for n, recipe in enumerate(recipes):
        if recipe.grid != recipes[0].grid:
            raise RecipeError(
                f"mixed: component {recipe.kind}: its grid is {recipe.grid}, that of "
                f"{recipes[0].kind} is {recipes[0].grid}; give all components the same"
            )
        own_counts = {split: part[n] for split, part in by_split.items()}
        if any(own_counts.values()):
            source, own_folder = DrawnWorlds(recipe), folder / names[n]
            plan = plan_dataset(
                own_folder, recipe, source, counts=own_counts, seed=own_seeds[n], **options
            )
            plans.append(plan)
    return Plans(folder=folder, datasets=tuple(plans))


def folder_names(kinds: Sequence[str]) -> list[str]:
    """A folder's name for each component of these kinds; those of one kind are numbered."""
    plain = [kind.rpartition(":")[2] for kind in kinds]
    before: Counter[str] = Counter()
    names = []
    for name in plain:
        names.append(f"{name}-{before[name]:03d}" if plain.count(name) > 1 else name)
        before[name] += 1
    return names
