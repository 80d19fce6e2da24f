"""A dataset of several kinds of worlds: its components, by weight, and the shards of each."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lidarsim import Sensor
from scenegen import SPLITS
from scenegen.dataset.build import plan_dataset
from scenegen.dataset.gather import gathered, unlike
from scenegen.dataset.shard import ShardTask
from scenegen.dataset.state import Plan
from scenegen.errors import RecipeError, printable, short
from scenegen.limits import MOST_SOURCES
from scenegen.recipe import Recipe, beside_file, make_recipe
from scenegen.recipes import kind_names
from scenegen.source import DrawnWorlds
from scenegen.tables import read_toml

MIXED = "mixed"
"""The kind that stands for several."""
MOST_WEIGHT = 1e6
Component = tuple[Recipe, float]
"""A recipe, and its weight: samples come in proportion to it."""


def is_mixed(path: Path) -> bool:
    """Whether a recipe file is one of several kinds. Raises RecipeError."""
    tables = read_toml(path)
    return tables.get("kind") == MIXED or "component" in tables


def read_components(
    path: Path | None = None,
    *,
    lidar: Sensor | None = None,
    noise: str | None = None,
    mapping: Mapping[str, Any] | None = None,
    difficulty: str | None = None,
) -> list[Component]:
    """The components of a mixture.

    Args:
        path: A recipe file with ``kind = "mixed"`` and tables ``[[component]]`` of a `kind`, a
            `weight`, and tables of their own, such as ``[component.world]``. Tables of the file
            itself are common to all. Without a file, or without components, every kind that comes
            with scenegen has the same weight.
        lidar: The sensor of all.
        noise: The stages of noise of all.
        mapping: Parameters of how all maps are made.
        difficulty: That of all.

    Raises:
        RecipeError: A component is none, or only some have weights.
    """
    common, where = ({}, "") if path is None else (read_toml(path), printable(path))
    common.pop("kind", None)
    every = [{"kind": name} for name in kind_names()]
    listed = common.pop("component", every)
    if not isinstance(listed, list) or not 0 < len(listed) <= MOST_SOURCES:
        raise RecipeError(
            f"{where}: component: expected up to {MOST_SOURCES} tables [[component]], each with a "
            f"kind"
        )
    weighed = [isinstance(one, dict) and "weight" in one for one in listed]
    given = beside_file(where, common, lidar, noise, mapping, difficulty)
    found = []
    for n, one in enumerate(listed, start=1):
        at = f"{where}: component {n}" if where else f"component {n}"
        if not isinstance(one, dict) or not isinstance(one.get("kind"), str):
            raise RecipeError(f'{at}: names no kind; add a line such as kind = "rooms"')
        own = dict(one)
        kind, weight = own.pop("kind"), own.pop("weight", 1)
        if any(weighed) and not weighed[n - 1]:
            raise RecipeError(f"{at} ({short(kind)}): has no weight, and others have; give it one")
        plain = isinstance(weight, int | float) and not isinstance(weight, bool)
        if not plain or not 0 < weight <= MOST_WEIGHT:
            raise RecipeError(
                f"{at} ({short(kind)}): weight = {short(weight)}: expected a number above 0, up "
                f"to {MOST_WEIGHT:.0f}"
            )
        tables = {
            name: common.get(name, {}) | own[name]
            if isinstance(own.get(name), dict) and isinstance(common.get(name, {}), dict)
            else own.get(name, common.get(name))
            for name in dict.fromkeys((*common, *own))
        }
        folder = Path() if path is None else path.parent
        made = make_recipe(kind, tables | given, where=at, folder=folder, sensor=lidar)
        found.append((made, float(weight)))
    return found


def plan_mixed(
    folder: Path, components: Sequence[Component], *, counts: Mapping[str, int], **options: Any
) -> Plan:
    """Divide `counts` (samples a split) among the components, and into shards of each.

    The component's samples are those of the dataset that it would be by itself, with as many
    samples. `options` are those of `plan_dataset`. Raises DatasetError, and RecipeError where the
    components differ in more than their worlds and flights.
    """
    shares = {
        split: _shares(counts[split], [weight for _, weight in components]) for split in SPLITS
    }
    plans = [
        plan_dataset(
            folder,
            recipe,
            DrawnWorlds(recipe),
            counts={split: shares[split][n] for split in SPLITS},
            **options,
        )
        for n, (recipe, _) in enumerate(components)
    ]
    for plan, (recipe, _) in zip(plans, components, strict=True):
        if said := unlike(plans[0].parameters, plan.parameters):
            raise RecipeError(
                f"mixed: {said[0]} of {recipe.kind} is {said[2]}, and of {components[0][0].kind} "
                f"{said[1]}; give all components the same"
            )
    shards: list[ShardTask] = []
    for split in SPLITS:
        index = 0
        for n, plan in enumerate(plans):
            stop = 0
            for shard in (one for one in plan.shards if one.split == split):
                start, stop = stop, stop + shard.samples
                more = {"source": n, "start": start, "stop": stop}
                shards.append(dataclasses.replace(shard, index=index, more=more))
                index += 1
    each = [(plan.parameters, None, [""]) for plan in plans]
    given = gathered(each, counts, plans[0].parameters["shard_samples"])
    return Plan(folder=folder, parameters=given, shards=tuple(shards), lidar=plans[0].lidar)


def _shares(count: int, weights: Sequence[float]) -> list[int]:
    """`count` in parts by weight: whole numbers, the largest remainders rounded up."""
    exact = [count * weight / sum(weights) for weight in weights]
    found = [int(part) for part in exact]
    order = sorted(range(len(exact)), key=lambda n: found[n] - exact[n])
    for n in order[: count - sum(found)]:
        found[n] += 1
    return found
