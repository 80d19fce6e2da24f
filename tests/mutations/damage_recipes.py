"""Family ``recipes``: TOML of other values, types and names."""

import copy
import dataclasses
import json

from scenegen.worlds.recipe import make_recipe
from tests.mutations.generated import generated
from tests.mutations.nasty import nasty, number, spoil
from tests.mutations.valid import RECIPE, to_toml


def attempt(random, valid, here):
    """A recipe, damaged, and a sample made by it."""
    content, done = random.choice((_numbers, _numbers, _values))(random)
    (here / "r.toml").write_bytes(content.encode(errors="surrogateescape"))
    return generated("--recipe r.toml", f"r.toml: {done}")


def _full():
    """Every parameter of the recipe, by table."""
    tables = copy.deepcopy(RECIPE)
    recipe = make_recipe(tables.pop("kind"), tables, where="campaign")
    parts = {name: dataclasses.asdict(getattr(recipe, name)) for name in tables}
    return {"kind": "pillar", **json.loads(json.dumps(parts))}


def _numbers(random):
    """Numbers in place of numbers."""
    tree = _full()
    tables = {name: table for name, table in tree.items() if isinstance(table, dict)}
    done = [
        spoil(tables[random.choice(list(tables))], random, number)
        for _ in range(random.choice((1, 1, 2)))
    ]
    return to_toml(tree), "; ".join(done)


def _values(random):
    tree = _full()
    done = spoil(tree, random, nasty)
    return to_toml(tree), done
