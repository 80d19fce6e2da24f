"""Family ``hdf5``: shards that are well-formed HDF5, and not what the format says.

Each function damages the dataset `name` of an open file, and says how, and what exit code 0 may
mean.
"""

import h5py
import numpy as np

from tests.mutations.case import REFUSED, SAME, VALID, words
from tests.mutations.hdf5_chunks import (
    chunk_missing,
    chunk_of_our_own,
    shuffled_bomb,
    taken,
    unknown_filter,
)
from tests.mutations.nasty import ESCAPES

PACKED = ("observed", "occupancy", "ranges", "free", "tudf")


def virtual(file, name, random):
    old = file[name]
    shape, dtype = old.shape, old.dtype
    file.move(name, "elsewhere")
    layout = h5py.VirtualLayout(shape=shape, dtype=dtype)
    layout[...] = h5py.VirtualSource(
        random.choice((".", "train-00000.h5", "/etc/passwd")), "elsewhere", shape=shape
    )
    file.create_virtual_dataset(name, layout)
    return "virtual", REFUSED


def external(file, name, random):
    old = taken(file, name)
    other = random.choice(("/etc/passwd", "/dev/zero", "recipe.toml"))
    file.create_dataset(name, old.shape, old.dtype, external=[(other, 0, h5py.h5f.UNLIMITED)])
    return f"stored in {other}", REFUSED


def link(file, name, random):
    del file[name]
    link = random.choice(
        (h5py.SoftLink("/sha256"), h5py.SoftLink(f"/{name}"), h5py.ExternalLink("/dev/zero", name))
    )
    file[name] = link
    return f"{type(link).__name__} to {link.path}", REFUSED


def other_type(file, name, random):
    old = taken(file, name)
    plain = words("f2 f8 >f4 u1 i8 >i8 c16 S8 V16")
    kinds = (*plain, h5py.string_dtype(), h5py.ref_dtype, [("x", "f4"), ("y", "i2")])
    kind = random.choice([one for one in kinds if np.dtype(one) != old.dtype])
    file.create_dataset(name, old.shape, kind, chunks=(1, *old.shape[1:]))
    return f"of type {np.dtype(kind)}", REFUSED


def other_shape(file, name, random):
    values = taken(file, name)
    many, chunks = (1 << 40, *values.shape[1:]), (1, *values.shape[1:])
    kind = random.randrange(4)
    if kind == 0:
        file.create_dataset(name, many, values.dtype, chunks=chunks, compression="gzip")
        return f"of shape {many}", REFUSED
    if kind == 1:
        file.create_group(name)
        return "a group", REFUSED
    if kind == 2:
        file[name] = h5py.Empty(values.dtype)
        return "empty", REFUSED
    doubled = np.concatenate([values, values])
    file[name] = other = random.choice((values[:0], doubled, values.reshape(-1)[:-1]))
    return f"of shape {other.shape}", REFUSED


LAYOUTS = (
    {"chunks": None},
    {"shuffle": True},
    {"compression": "lzf"},
    {"compression": "gzip", "fletcher32": True},
    {"maxshape": True},
)


def other_layout(file, name, random):
    """Other chunks or filters, which HDF5 itself undoes."""
    values, options = taken(file, name), dict(random.choice(LAYOUTS))
    if options.pop("maxshape", False):
        options["maxshape"] = (None, *values.shape[1:])
    file.create_dataset(name, data=values, **{"chunks": (1, *values.shape[1:])} | options)
    return f"laid out by {options}", SAME


def number(file, name, random):
    """Another number, in place."""
    data = file[name]
    value = True
    if data.dtype.kind == "f":
        value = random.choice((np.nan, -np.nan, 1e308, -1e30, np.inf, -1.0))
    elif data.dtype != np.bool_:
        value = random.choice((-1, 2**62, 255))
    data[(random.randrange(len(data)),) + (0,) * (data.ndim - 1)] = value
    return f"holds {value}", VALID


ATTRIBUTES = (
    *(None, 3, -1, np.arange(5), ["a", "b"], ESCAPES.replace("\x00", ""), "[" * 5000, "{}"),
    *("x" * 60_000, np.bytes_(b"\xff\xfe"), h5py.Empty("f4"), np.float64("nan"), '{"worlds": 3}'),
)


def attribute(file, name, random):
    key = random.choice(("parameters", "rejected", "worlds_sha256", "first_world", "split"))
    value = random.choice(ATTRIBUTES)
    if value is None:
        del file.attrs[key]
    else:
        file.attrs[key] = value
    return f"attribute {key} = {ascii(value)[:60]}", SAME if key != "parameters" else VALID


def more(file, name, random):
    """Things that nobody asked for."""
    match random.randrange(3):
        case 0:
            file.create_dataset("zz", (1 << 30,), "f8", chunks=(1 << 16,), compression="gzip")
        case 1:
            file.create_group("g/" * 200)
        case _:
            file[ESCAPES.replace("\x00", "").replace("/", "")] = file[name]
    return "with something more beside it", VALID


OF_CHUNKS = (chunk_of_our_own, shuffled_bomb)
"""Those that need a packed field."""
STRUCTURAL = (
    *(virtual, external, link, other_type, other_shape, other_layout, other_layout),
    *(unknown_filter, more, chunk_missing, shuffled_bomb, *[chunk_of_our_own] * 3),
)
DAMAGES = (*STRUCTURAL, number, number, attribute, attribute)


def in_shard(path, random):
    """A damage to a field of a shard."""
    with h5py.File(path, "r+") as file:
        field = random.choice([name for name in file if name != "sha256"])
        packed = [name for name in PACKED if name in file]
        change = random.choice(DAMAGES)
        field = random.choice(packed) if change in OF_CHUNKS else field
        said, expected = change(file, field, random)
    return f"{field} {said}", expected
