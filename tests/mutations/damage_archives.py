"""Family ``archives``: zip files of worlds that unpack to far more, escape, or hold something
else."""

import io
import struct
import zipfile

from tests.mutations import bombs
from tests.mutations.case import VALID
from tests.mutations.damage_bytes import damage
from tests.mutations.damage_scenes import hostile
from tests.mutations.dataset_commands import read_dataset
from tests.mutations.datasets import sign
from tests.mutations.nasty import ESCAPES

COMMANDS = ("world", "world", "world", "quick", "verify", "verify", "resume")
NAMES = (
    *(
        "../escaped.xml",
        "/tmp/escaped.xml",
        "a/b.obj",
        ".hidden",
        "notes.py",
        "C:\\x",
        "x" * 300,
        "..",
        "",
        " ",
        "w.xml",
    ),
    *(
        ESCAPES.replace("\x00", ""),
        "000000.xml/",
        "world.xml",
        "mesh\udcff.stl".encode(errors="surrogateescape").decode("latin-1"),
    ),
)


def attempt(random, valid, here):
    """A shard's archive, made anew of the same worlds and something else; mostly signed again."""
    name = random.choice("dc")
    folder = valid.put(name, here)
    path = folder / random.choice(
        ("train-00000.worlds.zip", "train-00000.worlds.zip", "test-00000.worlds.zip")
    )
    with zipfile.ZipFile(path) as archive:
        members = [(member, archive.read(member)) for member in archive.namelist()]
    content, done = random.choice(
        (_more, _more, _bomb, _headers, _headers, _documents, _documents, _whole)
    )(members, random)
    path.write_bytes(content)
    signed = random.random() < 0.8
    if signed:
        sign(folder)
    said = f"{name}/{path.name}: {done}{', signed again' * signed}"
    return read_dataset(random, valid, here, name, said, VALID, COMMANDS)


def _zipped(members, method=zipfile.ZIP_DEFLATED):
    import warnings

    memory = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(memory, "w") as archive:
        warnings.simplefilter("ignore")
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, method, 9)
    return memory.getvalue()


def _more(members, random):
    """A member of an odd name, that the first world refers to."""
    odd = random.choice(NAMES)
    if random.random() < 0.6:
        first, document = members[0]
        use = f"<!-- {odd} --></mujoco>".encode(errors="replace")
        members[0] = first, document.replace(b"</mujoco>", use)
    times = random.choice((1, 1, 2, 500))
    return _zipped(
        members + [(odd, b"print('owned')\n")] * times
    ), f"{times} members more, {ascii(odd)[:60]}"


def _bomb(members, random):
    """Members that unpack to far more, and say so or not."""
    first, document = members[0]
    kind = random.randrange(3)
    if kind == 0:
        members[0] = first, document.replace(b"</mujoco>", b" " * (60 << 20) + b"</mujoco>")
        return _zipped(members), "a document of 60 MB"
    names = [f"asset{number}.obj" for number in range(12)]
    members[0] = (
        first,
        document.replace(b"</mujoco>", f"<!-- {' '.join(names)} --></mujoco>".encode()),
    )
    honest = _zipped(members)
    size_mb = 250 if kind == 1 else 40
    size = size_mb << 20
    said = size if random.random() < 0.5 else 100
    return _with_raw(
        honest, names, bombs.deflated(size_mb), bombs.checksum(size_mb), said
    ), f"12 members of {size_mb} MB that say {said} bytes"


def _with_raw(archive, names, packed, checksum, size):
    """An archive with more members, all of the same packed bytes, whose headers say what we
    like."""
    end = archive.rindex(b"PK\x05\x06")
    count, _, start = struct.unpack("<HLL", archive[end + 10 : end + 20])
    body, directory = archive[:start], archive[start:end]
    for name in names:
        raw = name.encode()
        shared = struct.pack(
            "<HHHHHLLLHH", 20, 0, 8, 0, 33, checksum, len(packed), size, len(raw), 0
        )
        directory += (
            b"PK\x01\x02\x14\x03" + shared + struct.pack("<HHHLL", 0, 0, 0, 0, len(body)) + raw
        )
        body += b"PK\x03\x04" + shared + raw + packed
    total = count + len(names)
    return (
        body
        + directory
        + b"PK\x05\x06"
        + struct.pack("<HHHHLLH", 0, 0, total, total, len(directory), len(body), 0)
    )


def _headers(members, random):
    """Fields of the headers that say something else: flags, methods, sizes, checksums, offsets."""
    data = bytearray(_zipped(members))
    places = {
        "version": (4, 6),
        "flags": (6, 8),
        "method": (8, 10),
        "checksum": (14, 16),
        "packed": (18, 20),
        "size": (22, 24),
    }
    field = random.choice((*places, "offset", "count", "encrypted"))
    local, central, end = (
        data.index(b"PK\x03\x04"),
        data.index(b"PK\x01\x02"),
        data.rindex(b"PK\x05\x06"),
    )
    value = random.choice((0, 1, 9, 12, 14, 93, 99, 255, 65535))
    if field == "encrypted":
        data[local + 6] |= 1
        data[central + 8] |= 1
    elif field == "offset":
        data[central + 42 : central + 46] = struct.pack(
            "<L", random.choice((1, end, 2**31, 2**32 - 1))
        )
    elif field == "count":
        data[end + 8 : end + 12] = struct.pack("<HH", value, value)
    else:
        for start, place in zip((local, central), places[field], strict=True):
            if random.random() < 0.8:
                data[start + place : start + place + 2] = struct.pack("<H", value)
    return bytes(data), f"{field} = {value} in the first member's headers"


def _documents(members, random):
    """Worlds that are hostile, or none."""
    document, said, _ = hostile(random)
    which = random.randrange(len(members))
    members[which] = members[which][0], document
    return _zipped(
        members, random.choice((8, 8, 0, 12, 14))
    ), f"{members[which][0]} is a world with {said}"


def _whole(members, random):
    """The archive as a whole."""
    content = _zipped(members)
    match random.randrange(6):
        case 0:
            return b"", "an empty file"
        case 1:
            return _zipped([]), "no members"
        case 2:
            return _zipped(members + members), "every member twice"
        case 3:
            return _zipped([(name, b"") for name, _ in members]), "members without content"
        case 4:
            return random.randbytes(1000) + content, "1000 bytes before it"
        case _:
            return damage(content, random)
