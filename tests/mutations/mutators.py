"""Mutators: each damages a file in place, and says how, and what exit code 0 may mean then."""

import copy
import dataclasses
import json
import re
import struct

import h5py

from scenegen.worlds.recipe import make_recipe
from tests.command_line import beside, rows
from tests.mutations import damage_hdf5
from tests.mutations.case import VALID, words
from tests.mutations.nasty import ESCAPES, REAL, nasty, number, spoil
from tests.mutations.onnx_files import GRID, NETWORK, build_onnx
from tests.mutations.valid import RECIPE, SCENE, to_toml

OF_WORDS = (".txt", ".tum", ".yaml", ".xyz", ".ply", ".bt", ".ot")
"""Files that are text, or begin with it."""
NUMBERS = (
    *words("nan inf -inf 1e308 -1e308 1e30 1e9 1e-300 0 -1 65536 2147483648 a"),
    *("", "1 2 3 4 5 6 7"),
)
USES = {
    "mesh": '<geom type="mesh" mesh="m"/>',
    "hfield": '<geom type="hfield" hfield="h"/>',
    "model": '<attach model="other" body="cart" prefix="p"/>',
}
"""What uses an asset of these kinds."""
DEEP = 20_000
ADDED = [
    *rows(beside(__file__, "scenes.txt")),
    ("worldbody", '<replicate count="300">' * 3 + '<geom size="0.1"/>' + "</replicate>" * 3),
    ("worldbody", '<geom size="0.1"/>' * 60_000),
    ("worldbody", "<body>" * DEEP + '<geom size="0.1"/>' + "</body>" * DEEP),
    ("worldbody", f'<geom name="{"n" * 100_000}" size="0.1"/>'),
    ("worldbody", '<geom user="' + "1 " * 100_000 + '" size="1"/>'),
    ("mujoco", "<worldbody/>" * 1000),
    ("mujoco", "<!-- " + ESCAPES.replace("\x00", "") + " -->"),
]
"""Sections of a scene, and what stands there besides; what is long is made here."""


def in_bytes(path, random):
    """Flips, zeroed and random runs, truncation, splices, anywhere in a file."""
    data = bytearray(path.read_bytes())
    size = len(data)
    at, source = random.randrange(size), random.randrange(size)
    length = min(random.choice((1, 2, 8, 50, 512, 4096)), size - at)
    end = at + length
    kind = random.choice(["flip", "flip", "overwrite", "cut", "splice", "double"])
    match kind:
        case "flip":
            for _ in range(random.choice((1, 1, 2, 8, 64))):
                place = random.randrange(random.choice((size, min(size, 2048))))
                data[place] ^= 1 << random.randrange(8)
        case "overwrite":
            runs = bytes(length), b"\xff" * length, random.randbytes(length)
            data[at:end] = random.choice(runs)
        case "cut":
            del data[random.choice((0, 1, at, size - 1)) :]
        case "splice":
            data[at:end] = data[source : source + length]
        case "double":
            data[at:at] = data[at:end]
    path.write_bytes(data)
    return f"{kind} of {length} of {size} bytes at {at}", VALID


def in_words(path, random):
    """Another word, where a file is of words."""
    if path.suffix not in OF_WORDS:
        return in_bytes(path, random)
    said = random.choice((*map(repr, REAL), ESCAPES, "1 2", "", "[" * 999))
    parts = path.read_bytes().split(b" ", 100)
    parts[random.randrange(len(parts))] = said.encode()
    path.write_bytes(b" ".join(parts))
    return said, VALID


def in_toml(path, random):
    """Other values, types and names in a recipe with every parameter."""
    tables = copy.deepcopy(RECIPE)
    recipe = make_recipe(tables.pop("kind"), tables, where="campaign")
    parts = {name: dataclasses.asdict(getattr(recipe, name)) for name in tables}
    tree = {"kind": "pillar", **json.loads(json.dumps(parts))}
    spoiled, values = random.choice(((tree, nasty), *[(tree[one], number) for one in tables]))
    said = spoil(spoiled, random, values)
    path.write_bytes(to_toml(tree).encode(errors="surrogateescape"))
    return said, VALID


def in_header(path, random):
    """Other values in scenegen's header of a network, or in a tensor's entry."""
    how = random.choice((number, nasty))
    if path.suffix == ".onnx":
        header = {"grid": dict(GRID), "network": dict(NETWORK), "about": {}}
        said = spoil(header, random, how)
        path.write_bytes(build_onnx(header=header).SerializeToString())
        return said, VALID
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    entries = json.loads(content[8 : 8 + length])
    header = json.loads(entries["__metadata__"]["header"])
    tensors = [entries[name] for name in entries if name != "__metadata__"]
    said = spoil(random.choice((header, header["grid"], random.choice(tensors))), random, how)
    entries["__metadata__"]["header"] = json.dumps(header)
    text = json.dumps(entries).encode(errors="replace")
    path.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + length :])
    return said, VALID


def in_predictions(path, random):
    """What the family ``hdf5`` does to shards."""
    change = random.choice(damage_hdf5.STRUCTURAL)
    whole = () if change in damage_hdf5.OF_CHUNKS else ("world", "viewpoint")
    name = random.choice(("occupancy_probability", "tudf", *whole))
    with h5py.File(path, "r+") as file:
        said, expected = change(file, name, random)
    return f"{name} {said}", VALID if change is damage_hdf5.other_type else expected


def in_numbers(path, random):
    """Other numbers in an attribute of a scene."""
    place = random.choice(list(re.finditer(r'(\w+)="([^"a-z]+)"', SCENE)))
    numbers, value = place[2].split(), random.choice(NUMBERS)
    numbers[random.randrange(len(numbers))] = value
    if random.random() < 0.3:
        numbers = [value] * len(numbers)
    path.write_text(SCENE[: place.start(2)] + " ".join(numbers) + SCENE[place.end(2) :])
    return f"{place[0]} is {numbers}", VALID


def in_sections(path, random):
    """Something more in a section of a scene, which mostly uses it; what it names is there, and is
    not what it seems."""
    section, addition = random.choice(ADDED)
    used = USES.get(addition[1:].split()[0], "") if random.random() < 0.7 else ""
    scene = SCENE.replace("</worldbody>", used + "</worldbody>")
    path.write_text(scene.replace(f"</{section}>", f"{addition}</{section}>"))
    count, width, height = random.choice(((0, 2, 2), (2**31, 65536, 65536), (2**32 - 1, -1, -1)))
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">LL", 2**31 - 1, 2**31 - 1)
    path.with_name("liar.stl").write_bytes(bytes(80) + struct.pack("<L", count) + bytes(50))
    path.with_name("liar.bin").write_bytes(struct.pack("<ll", width, height) + bytes(16))
    path.with_name("liar.png").write_bytes(png + bytes(9))
    return f"{addition[:100]} in <{section}>", VALID


def in_document(path, random):
    """Something else as a whole."""
    entity = '<!DOCTYPE x [<!ENTITY a SYSTEM "/etc/passwd">]>' + SCENE.replace("small", "&a;")
    spaces = SCENE.replace("</mujoco>", " " * (20 << 20) + "</mujoco>")
    content = random.choice((entity, spaces, "", "<mujoco/>", "<robot/>", "\0" * 1000, "<" * 10**5))
    path.write_bytes(content.encode(random.choice(("utf-8", "utf-8", "utf-16", "utf-32"))))
    return f"another document: {content[:40]}", VALID
