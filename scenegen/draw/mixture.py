"""Mixtures: components of one kind each, and which share of the samples each has."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

from scenegen.base.errors import RecipeError, printable, short
from scenegen.base.files import Json
from scenegen.base.limits import MOST_SOURCES, MOST_WEIGHT
from scenegen.draw.sample import rng_of
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.recipe import Recipe, make_recipe
from scenegen.worlds.tables import combinations, read_toml

MIXED = "mixed"
"""The kind that stands for several."""
Component = tuple[Recipe, Fraction]
"""A recipe, and its weight: samples come in proportion to it."""


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
