"""Family ``recipes``: TOML of other values, types, names and depths."""

import copy

from tests.mutations.generated import generated
from tests.mutations.nasty import ESCAPES, nasty, number, spoil
from tests.mutations.valid import RECIPE, to_toml


def attempt(random, valid, here):
    """A recipe, damaged, and a sample made by it."""
    content, done = random.choice((_numbers, _numbers, _numbers, _values, _text))(random)
    (here / "r.toml").write_bytes(content.encode(errors="surrogateescape"))
    return generated(("--recipe", "r.toml"), f"r.toml: {done}")


def _full():
    """Every parameter of the recipe, by table."""
    import dataclasses
    import json

    from scenegen.recipe import make_recipe

    tables = copy.deepcopy(
        {name: table for name, table in RECIPE.items() if isinstance(table, dict)}
    )
    recipe = make_recipe("pillar", tables, where="campaign")
    parts = {
        name: dataclasses.asdict(getattr(recipe, name))
        for name in ("world", "flight", "accept", "lidar", "grid")
    }
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


def _text(random):
    """What only the text of TOML can say."""
    whole = to_toml(RECIPE)
    match random.randrange(8):
        case 0:
            return "a = " + "[" * 100_000, "nested deeply"
        case 1:
            return whole + "x = " + "{a=" * 5000 + "1" + "}" * 5000, "tables nested deeply"
        case 2:
            return ".".join(["a"] * 20_000) + " = 1", "a key of 20000 parts"
        case 3:
            return whole + "[grid]\nshape = 1\n", "a table twice"
        case 4:
            return whole + random.choice(
                ("d = 1979-05-27\n", "n = 0x" + "f" * 5000, "n = " + "9" * 5000, "s = '''")
            ), "odd values"
        case 5:
            return f'kind = "{ascii(ESCAPES)[1:-1]}"\n', "a kind that does not exist"
        case 6:
            return whole + "# " + "x" * (3 << 20), "3 MB long"
        case _:
            return random.choice(
                ("", "\x00", "\udcff\udcfe", "kind", "[", "\ufeff" + whole)
            ), "something else"
