"""Family ``manifest``: JSON that says other things, or things twice, or without end."""

import json

from tests.mutations.case import SAME, VALID, Attempt
from tests.mutations.dataset_commands import read_dataset
from tests.mutations.nasty import ESCAPES, nasty, places, spoil

DEEP = 100_000
"""Levels of what nests without end."""


def attempt(random, valid, here):
    """The manifest, damaged."""
    name = random.choice("dc")
    folder = valid.put(name, here)
    path = folder / "dataset.json"
    tree = json.loads(path.read_text())
    change = random.choice((_values, _values, _values, _values, _text, _entries, _entries))
    content, done = change(tree, random)
    path.write_bytes(content.encode(errors="surrogatepass"))
    return _read(random, valid, here, name, f"{name}/dataset.json: {done}", content)


def _read(random, valid, here, name, done, content):
    attempt = read_dataset(random, valid, here, name, done, VALID if "shuffled" in done else SAME)
    if attempt.words[0] != "verify":
        return attempt
    original = json.loads((valid.folder / name / "dataset.json").read_text())

    def unchanged(result):
        found = json.loads(content)  # keys that nobody knows say nothing
        return (
            ""
            if {key: found.get(key) for key in original} == original
            else f"passed, in spite of: {done}"
        )

    return Attempt(words=attempt.words, damage=done, makes=attempt.makes, holds=unchanged)


def _values(tree, random):
    done = [spoil(tree, random) for _ in range(random.choice((1, 1, 1, 2, 5)))]
    return json.dumps(tree), "; ".join(done)


def _entries(tree, random):
    """Shards listed twice, not at all, in another order, or as other things."""
    shards = tree["shards"]
    match random.randrange(7):
        case 0:
            times = random.choice((1, 1000, 100_000))
            tree["shards"] = shards + [random.choice(shards)] * times
            done = f"an entry {times} times more"
        case 1:
            shards.pop(random.randrange(len(shards)))
            done = "an entry less"
        case 2:
            random.shuffle(shards)
            done = "entries shuffled"
        case 3:
            entry = random.choice(shards)
            entry["samples"] = random.choice((1, 3, 10**7, 10**7 + 1, 2**63))
            done = f"{entry['samples']} samples in {entry['file']}"
        case 4:
            entry = random.choice(shards)
            key = random.choice(("file", "worlds"))
            entry[key] = random.choice(
                (
                    "../d/train-00000.h5",
                    "/etc/passwd",
                    f"{ESCAPES}.h5",
                    "val-00000.h5",
                    "train-00000.worlds.zip",
                )
            )
            done = f"{key} = {entry[key]!a}"
        case 5:
            one, other = random.sample(shards, 2)
            for key in random.choice(
                (("split",), ("file", "sha256"), ("worlds", "worlds_sha256"), ("first_world",))
            ):
                one[key], other[key] = other[key], one[key]
            done = f"{key} of two entries swapped"
        case _:
            tree["shards"] = []
            done = "no entries"
    return json.dumps(tree), done


def _text(tree, random):
    """What only the text of JSON can say."""
    whole = json.dumps(tree)
    match random.randrange(7):
        case 0:
            at = random.choice(places(tree))
            key, value = (
                json.dumps(str(at[0])),
                random.choice((json.dumps(nasty(random)), "1" * 10_000, "[" * DEEP)),
            )
            return whole[:-1] + f", {key}: {value}}}", f"{key} twice, then {value[:60]}"
        case 1:
            return "[" * DEEP + "]" * DEEP, "nested deeply"
        case 2:
            return whole[:-1] + ', "note": ' + '{"a":' * DEEP + "1" + "}" * (
                DEEP + 1
            ), "with a note nested deeply"
        case 3:
            return whole[:-1] + f", {json.dumps(ESCAPES)}: 1}}", "with a key of control characters"
        case 4:
            return random.choice(
                ("", "null", "3", '"a"', "[]", "{}", "\ufeff" + whole, whole + whole, "\x00")
            ), "other JSON"
        case 5:
            return whole.replace("seed", "s\\u0065ed"), "seed in escapes"
        case _:
            return whole.replace(": ", ": " + " " * 100_000), "with many spaces"
