"""Family ``weights``: networks whose header says something else, and whose bytes are damaged
anywhere; tensors and graphs that are none are in test_checkpoint.py and test_export.py."""

import json
import struct
from pathlib import Path

from tests.mutations.case import Attempt, words
from tests.mutations.damage_bytes import damage
from tests.mutations.datasets import finite_prediction
from tests.mutations.nasty import nasty, number, spoil
from tests.mutations.onnx_files import GRID, NETWORK, build_onnx
from tests.mutations.valid import EDGE


def attempt(random, valid, here):
    """A damaged network, and a scan completed by it."""
    valid.put("scan.npy", here)
    name = random.choice(("n.safetensors", "n.onnx"))
    content, said = random.choice((_header, _header, _layout, _bytes))(name, random, valid)
    (here / name).write_bytes(content)
    return Attempt(
        words=words(f"complete scan.npy --weights {name} --quiet --device cpu -o out.h5"),
        damage=f"{name}: {said}",
        makes=("out.h5",),
        after=lambda: finite_prediction(Path("out.h5")),
        holds=holds,
    )


def holds(result):
    """A completion of the valid network's size, whose numbers can be such."""
    fine = result.after and all(one == [[EDGE] * 3, True] for one in result.after.values())
    return "" if fine else f"completed to what cannot be: {result.after}"


def _parts(valid):
    """Header and data of the valid network's file."""
    content = (valid.folder / "n.safetensors").read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def _joined(header, data):
    text = json.dumps(header).encode(errors="replace")
    return struct.pack("<Q", len(text)) + text + data


def _header(name, random, valid):
    """Other values in scenegen's own header."""
    how = random.choice((number, nasty))
    if name == "n.onnx":
        said = {"grid": dict(GRID), "network": dict(NETWORK), "about": {}}
        done = spoil(said, random, how)
        return build_onnx(header=said).SerializeToString(), done
    header, data = _parts(valid)
    said = json.loads(header["__metadata__"]["header"])
    done = spoil(random.choice((said, said["grid"], said["network"])), random, how)
    header["__metadata__"]["header"] = json.dumps(said)
    return _joined(header, data), done


def _layout(name, random, valid):
    """Other types, shapes and offsets of a tensor."""
    if name == "n.onnx":
        return _bytes(name, random, valid)
    header, data = _parts(valid)
    tensor = random.choice([one for one in header if one != "__metadata__"])
    done = spoil(header[tensor], random)
    return _joined(header, data), f"{tensor}: {done}"


def _bytes(name, random, valid):
    return damage((valid.folder / name).read_bytes(), random)
