"""Mixtures: recipes of one kind each, with the share of samples of each."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

from lidarsim.parameters import short_repr
from scenegen.base.errors import RecipeError, printable
from scenegen.base.files import Json
from scenegen.base.limits import MAX_SOURCES, MAX_WEIGHT
from scenegen.draw.sample import rng_of
from scenegen.worlds.kinds import training_kinds
from scenegen.worlds.recipe import Recipe, make_recipe
from scenegen.worlds.tables import combinations, read_toml

MIXED = "mixed"
"""Name of a recipe of several kinds."""
Component = tuple[Recipe, Fraction]
"""A recipe and its weight. Samples come in proportion to the weights."""


def is_mixed(path: Path) -> bool:
    """Whether a recipe file has several kinds. Raises RecipeError if it cannot be read."""
    tables = read_toml(path)
    return tables.get("kind") == MIXED or bool({"component", "domain"} & set(tables))


def read_components(path: Path | None = None, *, seed: int = 0, **settings: Any) -> list[Component]:
    """Read the components of a mixture.

    Args:
        path: A recipe file with ``kind = "mixed"`` and tables ``[[component]]``. Each has a `kind`,
            a `weight`, and its own tables, such as ``[component.world]``; tables of the file are
            common to all. A table ``[domain.TABLE]`` lists several values of parameters: the
            component is split into one for each combination, which share its weight. For intervals,
            ``[domain] draws`` is the number of draws of each combination. Without a file, or
            without components, every kind of scenegen for training has the same weight.
        seed: Seed of values that are drawn from intervals.
        settings: Settings common to all components, as for `scenegen.preset`.

    Raises:
        RecipeError: if a component is invalid, or only some have weights.
    """
    common, where, folder = {}, "", Path()
    if path is not None:
        common, where, folder = read_toml(path), printable(path), path.parent
    kind = common.pop("kind", MIXED)
    all_kinds = [{"kind": name} for name in (training_kinds() if kind == MIXED else [kind])]
    listed = common.pop("component", all_kinds)
    if not isinstance(listed, list) or not 0 < len(listed) <= MAX_SOURCES:
        raise RecipeError(
            f"{where}: component: expected up to {MAX_SOURCES} tables [[component]], each with a "
            f"kind"
        )
    weighed = any(isinstance(entry, dict) and "weight" in entry for entry in listed)
    components = []
    for n, entry in enumerate(listed, start=1):
        at = f"{where}: component {n}" if where else f"component {n}"
        if not isinstance(entry, dict) or not isinstance(entry.get("kind"), str):
            raise RecipeError(f'{at}: names no kind; add a line such as kind = "rooms"')
        tables = dict(entry)
        kind, weight = tables.pop("kind"), tables.pop("weight", 1)
        # a default of 1 beside explicit weights would hide a forgotten one
        if weighed and "weight" not in entry:
            raise RecipeError(
                f"{at} ({short_repr(kind)}): has no weight, and others have; give it one"
            )
        share = fraction(weight, short_repr(kind), at)
        tables = _over(common, tables)
        # a seed below 0 is refused later, with the rest
        drawn = combinations(tables.pop("domain", {}), at, rng_of(abs(seed), n))
        for values in drawn:
            _check_domain(tables, values, at)
            recipe = make_recipe(kind, _over(tables, values), where=at, folder=folder, **settings)
            components.append((recipe, share / len(drawn)))
    return components


def _check_domain(tables: Json, values: Json, at: str) -> None:
    """Check that no parameter of a component has both a value and a domain."""
    for name, row in values.items():
        table = tables.get(name)
        if isinstance(table, dict) and (common := table.keys() & row.keys()):
            raise RecipeError(
                f"{at}: {name}.{min(common)} has a value and a domain; leave one of them out"
            )


def _over(base: Json, changes: Json) -> Json:
    """Merge two levels of tables; values of `changes` win."""
    merged = dict(base)
    for name, table in changes.items():
        are_tables = isinstance(table, dict) and isinstance(base.get(name), dict)
        merged[name] = base[name] | table if are_tables else table
    return merged


def fraction(weight: Any, label: str, owner: str = "stream") -> Fraction:
    """Convert a weight to an exact fraction, as it is written: 0.1 is 1/10.

    Args:
        weight: The weight.
        label: Name of the weighted thing, for the message.
        owner: First word of the message.

    Raises:
        RecipeError: if it is not a number above 0, up to `MAX_WEIGHT`.
    """
    with suppress(ValueError, ZeroDivisionError):
        # by its shortest decimal form, as the binary float 0.1 is not 1/10; text is no weight
        exact = Fraction("" if isinstance(weight, str) else str(weight))
        if 0 < exact <= MAX_WEIGHT:
            return exact
    raise RecipeError(
        f"{owner}: weight of {label} = {short_repr(weight)}: expected a number above 0, up to "
        f"{MAX_WEIGHT}"
    )


def seeds(kinds: Iterable[str], seed: int) -> list[int]:
    """Make the seeds of components.

    Args:
        kinds: Kind of each component.
        seed: Seed of the mixture.

    Returns:
        `seed` for the first component of each kind, other seeds for further ones, so that they draw
            other worlds.
    """
    before: Counter[str] = Counter()
    result = []
    for kind in kinds:
        digest = hashlib.sha256(f"{kind} {before[kind]} {seed}".encode()).digest()
        result.append(int.from_bytes(digest[:4]) if before[kind] else seed)
        before[kind] += 1
    return result


def shares(count: int, weights: Sequence[Fraction]) -> list[int]:
    """Divide a count by weights: whole numbers, rounded by the largest remainders.

    Args:
        count: The total.
        weights: Relative sizes of the parts.
    """
    exact = [count * weight / sum(weights) for weight in weights]
    parts = [int(value) for value in exact]
    # largest remainders first; equal ones in order, as sorting is stable
    order = sorted(range(len(exact)), key=lambda n: parts[n] - exact[n])
    for n in order[: count - sum(parts)]:
        parts[n] += 1
    return parts
