"""Values that nobody expects."""

ESCAPES = (
    "\x1b]0;owned\x07\x1b[2J\rscenegen: all is well\nverify: all 17 checks passed\u202e\x00\x9b31m"
)
WHOLE = (0, -1, 1, 2, 3, 255, 2**31, 2**53 + 1, 2**63, 2**64, -(2**63) - 1, 10**9, 10**30, 10**400)
REAL = "0 -0 1.5 -1 1e-300 1e-7 5e-324 1e9 1e38 1e300 -1e300 inf -inf nan"
REAL = tuple(map(float, REAL.split()))
TEXT = ["", " ", "x" * 5000, ESCAPES, "\ud800", "🎈" * 50]
TEXT += ["a", "../../x", "/", ".", "..", "nan", "%s%n{0}", "-1", "null"]
OTHER = None, True, [], {}, [[]], {"": 0}, {ESCAPES: 1}, [0] * 1000, [1, "a", None]


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
