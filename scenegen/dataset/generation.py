"""`generate`: from the user's options (a kind of worlds, a mixture, a recipe, or files) to plans of
datasets."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidarsim import Sensor
from lidarsim.engines import DEFAULT
from lidarsim.noise.chain import Noise
from scenegen import SPLITS
from scenegen.base.errors import (
    DatasetError,
    RecipeError,
    SceneError,
    UsageError,
    check_int,
    reraise_as,
)
from scenegen.base.files import Json, disk_errors
from scenegen.base.limits import MAX_SAMPLES
from scenegen.base.stores import Location, Store, location_of
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.collection import COLLECTION, members_of, open_data, write_collection
from scenegen.dataset.like import plan_like
from scenegen.dataset.read import AnyDataset
from scenegen.dataset.state import DatasetPlan
from scenegen.draw.mixture import MIXED, Component, is_mixed, read_components, seeds, shares
from scenegen.draw.parts import resolved
from scenegen.draw.source import DrawnWorlds, SceneWorlds, Source, read_scenes
from scenegen.worlds.flight import FlightConfig
from scenegen.worlds.kinds import graded
from scenegen.worlds.recipe import Recipe, preset, read_recipe
from scenegen.worlds.tables import field_names, named_lidar, read_toml


@dataclass(frozen=True, kw_only=True)
class GenerationPlan:
    """Datasets to make: one, or several of a collection."""

    folder: Location
    datasets: tuple[DatasetPlan, ...]
    """One dataset, or several in subfolders of `folder`."""

    @property
    def is_collection(self) -> bool:
        """Whether there are several datasets in subfolders of `folder`."""
        return self.datasets[0].folder != self.folder

    def claim_folder(self, *, force: bool = False) -> None:
        """List the datasets in the folder of a collection, unless it holds something else.

        Args:
            force: Whether another collection is replaced.

        Raises:
            DatasetError: if the folder holds something else.
        """
        if not self.is_collection or isinstance(self.folder, Store):
            return
        members = [plan.name for plan in self.datasets]
        path = self.folder / COLLECTION
        with disk_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            names = {item.name for item in self.folder.iterdir()} - {COLLECTION, *members}
        # temporary files of other runs are ignored
        strangers = {name for name in names if not name.endswith(".tmp")}
        if strangers and not path.exists():
            raise DatasetError(
                f"{self.folder}: holds other files ({min(strangers)}, …); choose another folder "
                "with --out"
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
    """Make a dataset, or continue one, as `scenegen generate` does.

    Args:
        kind: Name of a kind of random worlds, or a kind of your own as "module:Class"; "mixed" for
            a collection of all kinds.
        n: Number of training samples; 2500 by default.
        out: Folder of the dataset; data/<kind> by default.
        workers: Number of processes of this machine.
        force: Whether another dataset in the folder is replaced.
        options: As for `plan_generation`: `val`, `test`, `scene`, `recipe`, `like`, `lidar`,
            `noise`, `mapping`, `difficulty`, `labels`, `normals`, `seed`, `engine`, `compact`,
            `shard_samples`, `allow_unseen`.

    Returns:
        The opened dataset or collection.

    Raises:
        RecipeError: if options contradict each other, or the recipe is invalid.
        SceneError: if a file cannot be used as a world.
        DatasetError: if the folder holds something else, or the disk refuses.
        GenerationError: if all draws of a world are rejected.
    """
    plans = plan_generation(kind, n, out=out, **options)
    # listed first, so that readers know a collection as incomplete if the run is stopped
    plans.claim_folder(force=force)
    for plan in plans.datasets:
        build(plan, workers=workers, force=force)
    return open_data(str(plans.folder))


def plan_generation(
    kind: str | None = None,
    n: int | None = None,
    *,
    val: int | None = None,
    test: int | None = None,
    out: str | Location | None = None,
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
) -> GenerationPlan:
    """Plan the dataset, or datasets, that the options describe. Nothing is written.

    Args:
        kind: Name of a kind of random worlds, or "module:Class"; "mixed" for all kinds, or for the
            components of the recipe.
        n: Number of training samples; 2500 by default.
        val: Number of validation samples; by default a tenth of `n`, or 0 if there is only one
            world.
        test: Number of test samples; by default a fifth of `n`, or 0 if there is only one world.
        out: Folder of the dataset; by default data/<kind> or data/<name of the scene>.
        scene: Worlds from files instead of random ones: an MJCF file, a mesh, a map of a real place
            (.bt, .ot, .npz), a folder of these, or a point cloud that records the sensor's
            position.
        recipe: A TOML file with changes to the kind's preset, or a complete `Recipe`.
        like: A dataset or its manifest; see `scenegen.dataset.like.plan_like`.
        lidar: The sensor or its name; by default the recipe's.
        noise: Stages of noise, such as "range:0.02,dropout:0.05"; "none" for clean ranges.
        mapping: Parameters of the mapper.
        difficulty: Preset of the kind: "easy", "medium" or "hard".
        seed: Seed of all random numbers; 0 by default.
        allow_unseen: Whether scenes may have geoms that rays cannot see.
        report: Called with a sentence about each part of the scenes that is left out.
        engine: Name of the engine that casts rays; see `lidarsim.engines.ENGINES`.
        compact: Whether derived fields are left out.
        shard_samples: Approximate number of samples of a shard.
        parts: Optional parts of samples, by their names in `PARTS`: `labels` is "class", "name",
            "material" or "group"; `normals` is True.

    Returns:
        The plans.

    Raises:
        RecipeError: if options contradict each other, or the recipe is invalid.
        SceneError: if a file cannot be used as a world.
        DatasetError: if a number is out of range, or `like` is no dataset.
    """
    if kind is None and scene is None and recipe is None and like is None:
        raise UsageError(
            "no worlds are named; give a kind, such as --kind pillar, a --scene, a --recipe, or a "
            "dataset with --like"
        )
    if kind is not None and scene is not None:
        raise UsageError("a kind draws worlds and a scene has them; give one of the two")
    mapping = mapping or None  # without parameters, the recipe's mapping stays
    sensing: Json = {"lidar": lidar, "noise": noise, "mapping": mapping}
    storage: Json = {"compact": compact}
    if shard_samples is not None:
        storage["shard_samples"] = shard_samples
    if like is not None:
        world_options = {
            "scene": scene,
            "recipe": recipe,
            "difficulty": difficulty,
            "seed": seed,
            **parts,
        }
        if conflicts := [name for name, value in world_options.items() if value]:
            raise UsageError(f"--like says all of worlds; leave out {', '.join(conflicts)}")
        numbers = None
        # without numbers, those of the original are kept
        if (n, val, test) != (None, None, None):
            numbers = _counts(2500 if n is None else n, val, test, single_world=False)
        return _plan_like(like, out, kind, sensing, engine, numbers, compact=compact)
    storage["engine"] = engine or DEFAULT
    preset_options: Json = sensing | {"difficulty": difficulty}
    kind_name = kind if scene is None else "scene"
    recipe_file = None if isinstance(recipe, Recipe | None) else Path(recipe)
    number, seed = 2500 if n is None else n, seed or 0
    if isinstance(recipe, Recipe):
        if kind_name not in (None, recipe.kind) or any(preset_options.values()):
            raise UsageError(
                f"a whole Recipe, of kind {recipe.kind}, says all but worlds from files; leave "
                f"out a kind, {', '.join(preset_options)}"
            )
        base_recipe = recipe
    elif kind_name == MIXED or (recipe_file is not None and is_mixed(recipe_file)):
        if kind_name not in (None, MIXED):
            raise RecipeError(
                f"{recipe}: is of several kinds, not of {kind_name}; leave --kind out"
            )
        components = [
            (with_parts(part_recipe, parts, DrawnWorlds(part_recipe)), weight)
            for part_recipe, weight in read_components(recipe_file, seed=seed, **preset_options)
        ]
        counts = _counts(number, val, test, single_world=False)
        folder = _folder(out, MIXED)
        return plan_mixed(folder, components, seed=seed, counts=counts, **storage)
    elif recipe_file is not None:
        base_recipe = read_recipe(recipe_file, kind_name, **preset_options)
    else:
        assert kind_name is not None
        base_recipe = preset(kind_name, **preset_options)
    source: DrawnWorlds | SceneWorlds
    if scene is not None:
        source = read_scenes(
            Path(scene),
            {"train": number, "val": val, "test": test},
            seed=seed,
            allow_unseen=allow_unseen,
            # labels by class or material need the names of materials
            materials=parts.get("labels") in ("class", "material"),
            voxel_m=base_recipe.grid.voxel_m,
        )
        if source.maps and storage["engine"] != DEFAULT:
            raise SceneError(
                f"{source.maps[0]}: is a map of voxels, which has no engine but its own; leave "
                "--engine out"
            )
        name = Path(scene).stem
    elif base_recipe.world is None:
        raise RecipeError('a recipe of kind "scene" needs the worlds, too: give a scene')
    else:
        source = DrawnWorlds(base_recipe)
        name = base_recipe.kind.rpartition(":")[2]  # data/Towers for my_worlds:Towers
    base_recipe = with_parts(base_recipe, parts, source)
    if base_recipe.parts and isinstance(source, SceneWorlds) and source.maps:
        raise SceneError(
            f"{source.maps[0]}: is a map of voxels, which has no geoms; leave out "
            f"--{', --'.join(base_recipe.parts)}"
        )
    single_world = False
    if isinstance(source, SceneWorlds):
        settled: Collection[str] = ()
        if isinstance(recipe, Recipe):
            # what the user settled is kept: all of a whole Recipe, of a file what it names
            settled = field_names(FlightConfig)
        elif recipe_file is not None:
            settled = read_toml(recipe_file).get("flight", ())
        source, base_recipe = source.suited(base_recipe, settled)
        for line in source.notes:
            report(line)
        # after `suited`, which may take a map whole that was cut into regions
        single_world = sum(map(len, source.scenes.values())) == 1
        # after `with_parts`, by which the recipe has its movers
        source = source.moving(base_recipe, seed)
    if base_recipe.world is not None and not base_recipe.world.for_training:
        # by default, as many test samples as beside 2500 for training, and no others
        number, val, test = n or 0, val or 0, number // 5 if test is None else test
    counts = _counts(number, val, test, single_world=single_world)
    folder = _folder(out, name)
    plan = plan_dataset(folder, base_recipe, source, seed=seed, counts=counts, **storage)
    return GenerationPlan(folder=folder, datasets=(plan,))


def _plan_like(
    like: str | Path,
    out: str | Location | None,
    kind: str | None,
    sensing: Json,
    engine: str | None,
    counts: Mapping[str, int] | None,
    *,
    compact: bool,
) -> GenerationPlan:
    """Plan a dataset like another one; see `plan_generation`."""
    if out is None:
        raise UsageError("a dataset like another one needs a folder of its own; give --out")
    folder, lidar = _folder(out, ""), sensing["lidar"]
    sensor = None if lidar is None else named_lidar(lidar)
    noise_text = sensing["noise"]
    with reraise_as(RecipeError):
        noise = None if noise_text is None else Noise.parse(noise_text, sensor)
    changes: Json = {} if counts is None else {"counts": counts}
    changes |= {"compact": True} if compact else {}
    plan = plan_like(
        like,
        folder,
        kind=kind,
        lidar=sensor,
        noise=noise,
        mapping=sensing["mapping"],
        engine=engine,
        **changes,
    )
    return GenerationPlan(folder=folder, datasets=(plan,))


def _counts(n: int, val: int | None, test: int | None, *, single_world: bool) -> dict[str, int]:
    """Number of samples of each split. All samples of a single world are for training by default.
    Raises DatasetError for numbers out of range."""
    n = check_int("--n", n, 0, MAX_SAMPLES)
    usual = {
        "val": 0 if single_world else max(n // 10, 1),
        "test": 0 if single_world else max(n // 5, 1),
    }
    return {"train": n} | {
        split: usual[split] if count is None else check_int(f"--{split}", count, 0, MAX_SAMPLES)
        for split, count in (("val", val), ("test", test))
    }


def with_parts(recipe: Recipe, parts: Mapping[str, Any], source: Source) -> Recipe:
    """Add the optional parts of samples that the user chose to a recipe.

    Args:
        recipe: The recipe.
        parts: Value of each part's option, by its name in `PARTS`.
        source: The worlds.

    Returns:
        The recipe with their settings.

    Raises:
        RecipeError: if they do not go with it, or with each other.
        UsageError: if there is no such part.
    """
    chosen = resolved(parts, source.class_names)
    for name in chosen.keys() & recipe.parts.keys():
        raise RecipeError(
            f"the recipe has [{name}], and --{name} is given beside it; leave one out"
        )
    with reraise_as(RecipeError):
        return replace(recipe, parts={**recipe.parts, **chosen})


def _folder(out: str | Location | None, name: str) -> Location:
    if out is None:
        return Path("data", name)
    return location_of(out) if isinstance(out, str) else out


def plan_mixed(
    folder: Location,
    components: Sequence[Component],
    *,
    counts: Mapping[str, int],
    seed: int,
    **options: Any,
) -> GenerationPlan:
    """Divide samples among the components of a mixture. Each becomes a dataset in its own
    subfolder.

    A component's samples equal those of a dataset of its own with the same number of samples and
    its seed from `seeds`.

    Args:
        folder: Folder of the collection.
        components: Recipes and weights.
        counts: Number of samples of each split.
        seed: Seed of the mixture.
        options: As for `plan_dataset`.

    Returns:
        The plans.

    Raises:
        DatasetError: if `folder` is a store.
        RecipeError: if the components have different grids.
    """
    if isinstance(folder, Store):
        raise DatasetError(
            f"{folder}: several datasets go to a folder; make each by itself for a store"
        )
    weights = [weight for _, weight in components]
    by_split = {split: shares(counts[split], weights) for split in SPLITS}
    recipes = [recipe for recipe, _ in components]
    component_seeds = seeds([recipe.kind for recipe in recipes], seed)
    names = folder_names([graded(recipe.kind, recipe.difficulty) for recipe in recipes])
    plans = []
    for n, recipe in enumerate(recipes):
        if recipe.grid != recipes[0].grid:
            raise RecipeError(
                f"mixed: component {recipe.kind}: its grid is {recipe.grid}, that of "
                f"{recipes[0].kind} is {recipes[0].grid}; give all components the same"
            )
        component_counts = {split: divided[n] for split, divided in by_split.items()}
        # a component with a small weight may get no sample
        if any(component_counts.values()):
            source, component_folder = DrawnWorlds(recipe), folder / names[n]
            plan = plan_dataset(
                component_folder,
                recipe,
                source,
                counts=component_counts,
                seed=component_seeds[n],
                **options,
            )
            plans.append(plan)
    return GenerationPlan(folder=folder, datasets=tuple(plans))


def folder_names(kinds: Sequence[str]) -> list[str]:
    """Names of the components' folders. Components of the same kind are numbered."""
    plain = [kind.rpartition(":")[2] for kind in kinds]
    before: Counter[str] = Counter()
    names = []
    for name in plain:
        # three digits, as a collection has MAX_SOURCES = 1000 datasets at most
        names.append(f"{name}-{before[name]:03d}" if plain.count(name) > 1 else name)
        before[name] += 1
    return names
