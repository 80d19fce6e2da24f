"""Values that nobody expects."""

import json

from tests.command_line import beside

WHOLE, REAL, TEXT, OTHER = json.loads(beside(__file__, "nasty.json")).values()
ESCAPES = TEXT[2]
TEXT.append("x" * 5000)
OTHER.append([0] * 1000)


def nasty(random):
    """A value of any type that JSON knows."""
    return random.choice(random.choice((WHOLE, REAL, TEXT, OTHER)))


def number(random):
    """A number, near or far."""
    return random.choice(random.choice((WHOLE, REAL)))


def text(random):
    """A string that an operating system takes as a file's name or an option's value."""
    return random.choice(TEXT).replace("\x00", "").replace("\ud800", "\udcff")


def places(tree, name=""):
    """Everything in nested tables and lists: what holds it, its key there, and its name."""
    keys = range(len(tree)) if isinstance(tree, list) else tree if isinstance(tree, dict) else ()
    for key in keys:
        yield tree, key, f"{name}.{key}"
        yield from places(tree[key], f"{name}.{key}")


def spoil(tree, random, values=nasty):
    """Change something in nested tables and lists, and say what."""
    holder, step, where = random.choice([*places(tree)])
    how = random.random()
    if how < 0.7:
        holder[step] = values(random)
        return f"{where} = {ascii(holder[step])[:80]}"
    if how < 0.85:
        del holder[step]
        return f"{where} removed"
    if isinstance(holder, list):
        holder.extend([holder[step]] * random.choice((1, 3, 1000)))
        return f"{where} repeated"
    holder[random.choice(TEXT)] = holder.pop(step)
    return f"{where} renamed"
