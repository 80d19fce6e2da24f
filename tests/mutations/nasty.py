"""Values that nobody expects."""

ESCAPES = (
    "\x1b]0;owned\x07\x1b[2J\rscenegen: all is well\nverify: all 17 checks passed\u202e\x00\x9b31m"
)
WHOLE = (0, -1, 1, 2, 3, 255, 2**31, 2**53 + 1, 2**63, 2**64, -(2**63) - 1, 10**9, 10**30, 10**400)
REAL = (
    0.0,
    -0.0,
    1.5,
    -1.0,
    1e-300,
    1e-7,
    5e-324,
    1e9,
    1e38,
    1e300,
    -1e300,
    float("inf"),
    float("-inf"),
    float("nan"),
)
TEXT = (
    "",
    " ",
    "a",
    "x" * 5000,
    ESCAPES,
    "../../x",
    "/",
    ".",
    "..",
    "nan",
    "\ud800",
    "🎈" * 50,
    "%s%n{0}",
    "-1",
    "null",
)
OTHER = (
    None,
    True,
    False,
    [],
    {},
    [[]],
    [None],
    {"": 0},
    {ESCAPES: 1},
    [0] * 1000,
    [1, "a", None],
)


def nasty(random):
    """A value of any type that JSON knows."""
    return random.choice(random.choice((WHOLE, REAL, TEXT, OTHER)))


def number(random):
    """A number, near or far."""
    return random.choice(random.choice((WHOLE, REAL)))


def text(random):
    """A string that an operating system takes as a file's name or an option's value."""
    return random.choice(TEXT).replace("\x00", "").replace("\ud800", "\udcff")


def places(tree, at=()):
    """The path of everything in nested tables and lists."""
    found = [at] if at else []
    items = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else ()
    )
    for step, value in items:
        found += places(value, (*at, step))
    return found


def parent_of(tree, at):
    """What holds the thing at `at`."""
    for step in at[:-1]:
        tree = tree[step]
    return tree


def spoil(tree, random, values=nasty):
    """Change something in nested tables and lists, and say what."""
    at = random.choice(places(tree))
    holder, step, how = parent_of(tree, at), at[-1], random.random()
    where = ".".join(map(str, at))
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
