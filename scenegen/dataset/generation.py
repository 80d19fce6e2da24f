"""Datasets from what a user asks for: a kind of worlds, several by weight, a recipe or MJCF files,
and how many samples."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from lidarsim import Sensor
from lidarsim.engines import DEFAULT
from scenegen import SPLITS
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.gather import gathered, unlike
from scenegen.dataset.locate import locate
from scenegen.dataset.read import Dataset
from scenegen.dataset.shard import ShardTask
from scenegen.dataset.state import Plan
from scenegen.errors import AskedError, RecipeError, SceneError, printable, short, whole_number
from scenegen.files import Json
from scenegen.limits import MOST_SAMPLES, MOST_SOURCES, MOST_WEIGHT
from scenegen.recipe import Recipe, make_recipe, preset, read_recipe
from scenegen.recipes import kind_names
from scenegen.sample import rng_of
from scenegen.source import DrawnWorlds, SceneWorlds, read_scenes
from scenegen.stores import Place, place_of
from scenegen.tables import combinations, read_toml
from scenegen.worlds.labels import By, Labels, labels_by

MIXED = "mixed"
"""The kind that stands for several."""
Component = tuple[Recipe, Fraction]
"""A recipe, and its weight: samples come in proportion to it."""


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
        options: Those of `scenegen.dataset.generation.plan_generation`, whose help says more:
            `val`, `test`, `scene`, `recipe`, `lidar`, `noise`, `mapping`, `difficulty`, `labels`,
            `seed`, `engine`, `compact`, `shard_samples`, `allow_unseen`.

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
    out: str | Place | None = None,
    scene: str | Path | None = None,
    recipe: str | Path | Recipe | None = None,
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
        val: Validation samples; by default a tenth of `n`, and none where there is one world.
        test: Test samples; by default a fifth of `n`, and none where there is one world.
        out: Folder of the dataset; by default data/<kind>, or data/<the scene's name>.
        scene: An MJCF file, a mesh, a map of a real place (.bt, .ot, .npz), or a folder of them, or
            a point cloud that says where its sensor was, in place
            of random worlds.
        recipe: A TOML file of what differs from the kind's preset, or a whole `Recipe`.
        lidar: The sensor, or its name; the recipe's by default.
        noise: Stages of noise, such as "range:0.02,dropout:0.05".
        mapping: Parameters of how maps are made.
        difficulty: "easy", "medium" or "hard": which preset of the kind.
        labels: What decides the classes of geoms: "class", "name", "material" or "group".
        seed: The same seed gives the same dataset.
        allow_unseen: Whether scenes may have geoms that rays cannot see.
        tell: Called with a sentence for whatever of the scenes is left out.
        more: `engine`, `compact` and `shard_samples`; see
            `scenegen.dataset.manifest.parameters`.

    Raises:
        RecipeError, SceneError, DatasetError: What is asked for cannot be.
    """
    if kind is None and scene is None and recipe is None:
        raise AskedError(
            "no worlds are named; give a kind, such as --kind pillar, a --scene or a --recipe"
        )
    if kind is not None and scene is not None:
        raise AskedError("a kind draws worlds and a scene has them; give one of the two")
    named = kind if scene is None else "scene"
    mapping = mapping or None  # of no parameters, it is none
    given: Json = {"lidar": lidar, "noise": noise, "mapping": mapping, "difficulty": difficulty}
    file = None if isinstance(recipe, Recipe | None) else Path(recipe)
    if isinstance(recipe, Recipe):
        if named not in (None, recipe.kind) or any(given.values()):
            raise AskedError(
                f"a whole Recipe, of kind {recipe.kind}, says all but worlds from files; leave "
                f"out a kind, {', '.join(given)}"
            )
        asked = recipe
    elif named == MIXED or (file is not None and is_mixed(file)):
        if named not in (None, MIXED):
            raise RecipeError(f"{recipe}: is of several kinds, not of {named}; leave --kind out")
        parts = [
            (replace(one, labels=_labels(labels, DrawnWorlds(one))), weight)
            for one, weight in read_components(file, seed=seed, **given)
        ]
        counts = _counts(n, val, test, alone=False)
        return plan_mixed(_folder(out, MIXED), parts, seed=seed, counts=counts, **more)
    elif file is not None:
        asked = read_recipe(file, named, **given)
    else:
        assert named is not None
        asked = preset(named, **given)
    source: DrawnWorlds | SceneWorlds
    if scene is not None:
        source = read_scenes(
            Path(scene),
            {"train": n, "val": val, "test": test},
            seed=seed,
            allow_unseen=allow_unseen,
            materials=labels in ("class", "material"),
        )
        for line in source.notes:
            tell(line)
        if source.maps and more.get("engine", DEFAULT) != DEFAULT:
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
    asked = replace(asked, labels=_labels(labels, source) or asked.labels)
    counts = _counts(n, val, test, alone=alone)
    return plan_dataset(_folder(out, name), asked, source, seed=seed, counts=counts, **more)


def _counts(n: int, val: int | None, test: int | None, *, alone: bool) -> dict[str, int]:
    """Samples of each split; those of the only world are all for training unless asked for. Raises
    DatasetError for numbers beyond those that readers take."""
    n = whole_number("--n", n, 0, MOST_SAMPLES)
    usual = {"val": 0 if alone else max(n // 10, 1), "test": 0 if alone else max(n // 5, 1)}
    return {"train": n} | {
        split: usual[split] if count is None else whole_number(f"--{split}", count, 0, MOST_SAMPLES)
        for split, count in (("val", val), ("test", test))
    }


def _labels(by: By | None, source: DrawnWorlds | SceneWorlds) -> Labels | None:
    return labels_by(by, source.class_names(by)) if by else None


def _folder(out: str | Place | None, name: str) -> Place:
    if out is None:
        return Path("data", name)
    return place_of(out) if isinstance(out, str) else out


def is_mixed(path: Path) -> bool:
    """Whether a recipe file is one of several kinds. Raises RecipeError."""
    tables = read_toml(path)
    return tables.get("kind") == MIXED or bool({"component", "domain"} & set(tables))


def read_components(path: Path | None = None, *, seed: int = 0, **given: Any) -> list[Component]:
    """The components of a mixture.

    Args:
        path: A recipe file with ``kind = "mixed"`` and tables ``[[component]]`` of a `kind`, a
            `weight`, and tables of their own, such as ``[component.world]``. Tables of the file
            itself are common to all. Without a file, or without components, every kind that comes
            with scenegen has the same weight. A table ``[domain.TABLE]`` beside them gives
            parameters of that table lists of values: a component is then as many, one for every
            combination, which share its weight. Where values have intervals, ``[domain] draws``
            says how often each combination is taken, every time with other numbers.
        seed: What the numbers of intervals are drawn by.
        given: What all have in common, as for `scenegen.preset`.

    Raises:
        RecipeError: A component is none, or only some have weights.
    """
    common, where, folder = {}, "", Path()
    if path is not None:
        common, where, folder = read_toml(path), printable(path), path.parent
    kind = common.pop("kind", MIXED)
    every = [{"kind": name} for name in (kind_names() if kind == MIXED else [kind])]
    listed = common.pop("component", every)
    if not isinstance(listed, list) or not 0 < len(listed) <= MOST_SOURCES:
        raise RecipeError(
            f"{where}: component: expected up to {MOST_SOURCES} tables [[component]], each with a "
            f"kind"
        )
    weighed = any(isinstance(one, dict) and "weight" in one for one in listed)
    components = []
    for n, one in enumerate(listed, start=1):
        at = f"{where}: component {n}" if where else f"component {n}"
        if not isinstance(one, dict) or not isinstance(one.get("kind"), str):
            raise RecipeError(f'{at}: names no kind; add a line such as kind = "rooms"')
        own = dict(one)
        kind, weight = own.pop("kind"), own.pop("weight", 1)
        if weighed and "weight" not in one:
            raise RecipeError(f"{at} ({short(kind)}): has no weight, and others have; give it one")
        share = fraction(weight, short(kind), at)
        tables = _over(common, own)
        # a seed below 0 is refused later, with the rest
        drawn = combinations(tables.pop("domain", {}), at, rng_of(abs(seed), n))
        for values in drawn:
            _check_domain(tables, values, at)
            recipe = make_recipe(kind, _over(tables, values), where=at, folder=folder, **given)
            components.append((recipe, share / len(drawn)))
    return components


def _check_domain(tables: Json, values: Json, at: str) -> None:
    """Raise RecipeError where a component's `tables` have a parameter that its domain, too, gives
    `values` of."""
    for name, row in values.items():
        table = tables.get(name)
        if isinstance(table, dict) and (common := table.keys() & row.keys()):
            raise RecipeError(
                f"{at}: {name}.{min(common)} has a value and a domain; leave one of them out"
            )


def _over(below: Json, above: Json) -> Json:
    """The tables `below` with the values of those `above` on top."""
    found = dict(below)
    for name, table in above.items():
        both = isinstance(table, dict) and isinstance(below.get(name), dict)
        found[name] = below[name] | table if both else table
    return found


def fraction(weight: Any, label: str, what: str = "stream") -> Fraction:
    """A weight, exactly as it is written. Raises RecipeError, which says of `what` it is."""
    with suppress(ValueError, ZeroDivisionError):
        exact = Fraction("" if isinstance(weight, str) else str(weight))
        if 0 < exact <= MOST_WEIGHT:
            return exact
    raise RecipeError(
        f"{what}: weight of {label} = {short(weight)}: expected a number above 0, up to "
        f"{MOST_WEIGHT}"
    )


def plan_mixed(
    folder: Place,
    components: Sequence[Component],
    *,
    counts: Mapping[str, int],
    seed: int,
    **options: Any,
) -> Plan:
    """Divide `counts` (samples a split) among the components, and into shards of each.

    The component's samples are those of the dataset that it would be by itself, with as many
    samples and its own of the `seeds`. `options` are those of `plan_dataset`. Raises DatasetError,
    and RecipeError where the components differ in more than their worlds and flights.
    """
    weights = [weight for _, weight in components]
    parts = {split: shares(counts[split], weights) for split in SPLITS}
    recipes = [recipe for recipe, _ in components]
    own_seeds = seeds([recipe.kind for recipe in recipes], seed)
    plans = [
        plan_dataset(
            folder,
            recipe,
            DrawnWorlds(recipe),
            counts={split: part[n] for split, part in parts.items()},
            seed=own_seeds[n],
            **options,
        )
        for n, recipe in enumerate(recipes)
    ]
    first = plans[0].parameters
    for plan, recipe in zip(plans, recipes, strict=True):
        if difference := unlike(first, plan.parameters):
            raise RecipeError(
                f"mixed: component {recipe.kind}: {difference} by {recipes[0].kind}; give all "
                "components the same"
            )
    shards: list[ShardTask] = []
    for split in SPLITS:
        index = 0
        for source, plan in enumerate(plans):
            stop = 0
            for shard in (one for one in plan.shards if one.split == split):
                start, stop = stop, stop + shard.samples
                more = {"source": source, "start": start, "stop": stop}
                shards.append(replace(shard, index=index, more=more))
                index += 1
    sources = [(plan.parameters, None, [""]) for plan in plans]
    given = gathered(sources, counts, first["shard_samples"])
    lidars = tuple(recipe.lidar for recipe in recipes)
    return Plan(folder=folder, parameters=given, shards=tuple(shards), lidars=lidars)


def seeds(kinds: Iterable[str], seed: int) -> list[int]:
    """The seeds of components of these kinds: `seed` for the first of a kind, others for those that
    follow, so that no two draw the same worlds."""
    before: Counter[str] = Counter()
    found = []
    for kind in kinds:
        digest = hashlib.sha256(f"{kind} {before[kind]} {seed}".encode()).digest()
        found.append(int.from_bytes(digest[:4]) if before[kind] else seed)
        before[kind] += 1
    return found


def shares(count: int, weights: Sequence[Fraction]) -> list[int]:
    """`count` in parts by weight: whole numbers, the largest remainders rounded up."""
    exact = [count * weight / sum(weights) for weight in weights]
    found = [int(part) for part in exact]
    order = sorted(range(len(exact)), key=lambda n: found[n] - exact[n])
    for n in order[: count - sum(found)]:
        found[n] += 1
    return found
