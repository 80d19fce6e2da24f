"""Family ``weights``: networks whose header, tensors or graph say something else."""

import json
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np

from tests.mutations.case import NOTHING, Attempt, refuses, words
from tests.mutations.damage_bytes import damage
from tests.mutations.datasets import finite_prediction
from tests.mutations.nasty import nasty, number, spoil
from tests.mutations.valid import EDGE


def attempt(random, valid, here):
    """A damaged network, and a scan completed by it."""
    valid.put("scan.npy", here)
    make = random.choice((_header, _header, _tensors, _tensors, _layout, _other, _onnx, _onnx))
    name, said, must_fail = make(random, valid, here)
    return Attempt(
        words=(
            "complete",
            "scan.npy",
            "--weights",
            name,
            *words("--quiet --device cpu -o out.h5"),
        ),
        damage=f"{name}: {said}",
        makes=("out.h5",),
        after=lambda: finite_prediction(Path("out.h5")),
        holds=refuses(said) if must_fail else _holds,
    )


def _holds(result):
    fine = result.after and all(
        shape == [EDGE] * 3 and fits for shape, fits, _ in result.after.values()
    )
    return NOTHING if fine else f"completed to what cannot be: {result.after}"


def _split(valid):
    """Header and data of the valid network's file."""
    content = (valid.folder / "n.safetensors").read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def _join(header, data):
    text = header if isinstance(header, bytes) else json.dumps(header).encode(errors="replace")
    return struct.pack("<Q", len(text)) + text + data


def _header(random, valid, here):
    """Other values in scenegen's own header."""
    header, data = _split(valid)
    said = json.loads(header["__metadata__"]["header"])
    if random.random() < 0.5:
        known = {
            **{
                "width": (1024, 10**6, 10**30, -8, 0, "8", 8.0),
                "heads": (0, -1, 3, 10**9, 1e300),
                "stem_stride": (0, 1, 3, True),
            },
            "variant": ("occ", "shared", "all", None, [], 3),
        }
        key = random.choice(list(known))
        value: Any = random.choice(known[key])
        said["network"][key] = value
        done = f"network.{key} = {value!r}"
    elif random.random() < 0.6:
        done = spoil(said["grid"], random, random.choice((number, nasty)))
    else:
        done = spoil(said, random)
    header["__metadata__"]["header"] = json.dumps(said)
    if random.random() < 0.1:
        header["__metadata__"]["header"] = random.choice(("[" * 100_000, "null", "3", "", "[]"))
        done = "header of other JSON"
    (here / "n.safetensors").write_bytes(_join(header, data))
    return "n.safetensors", done, False


def _tensors(random, valid, here):
    """Other numbers, types, names and shapes of tensors."""
    from safetensors.numpy import load, save

    header, _ = _split(valid)
    tensors = load((valid.folder / "n.safetensors").read_bytes())
    name = random.choice([name for name in tensors if tensors[name].size])
    old, must_fail = tensors[name], False
    match random.randrange(7):
        case 0 | 1:
            value = random.choice((np.nan, np.inf, -np.inf))
            tensors[name] = np.full(old.shape, value).astype(
                old.dtype if old.dtype.kind == "f" else np.float32
            )
            done, must_fail = f"{name} of {value}", old.dtype.kind == "f"
        case 2:
            tensors[name] = np.full(
                old.shape, 3e38, old.dtype if old.dtype.kind == "f" else np.float32
            )
            done = f"{name} of 3e38"
        case 3:
            kind = random.choice(("f8", "f2", "i8", "u1", "?"))
            tensors[name] = old.astype(kind)
            done = f"{name} as {kind}"
        case 4:
            del tensors[name]
            done, must_fail = f"{name} missing", True
        case 5:
            tensors[name] = (
                old.reshape(-1)[:-1].copy() if random.random() < 0.5 else np.stack([old, old])
            )
            done, must_fail = f"{name} of shape {tensors[name].shape}", True
        case _:
            tensors["more"] = np.zeros(random.choice((0, 1, 1000)), np.float32)
            done = "a tensor more"
    (here / "n.safetensors").write_bytes(save(tensors, header["__metadata__"]))
    return "n.safetensors", done, must_fail


def _layout(random, valid, here):
    """Other offsets and lengths in the file's own header, and other bytes."""
    header, data = _split(valid)
    path = here / "n.safetensors"
    match random.randrange(5):
        case 0:
            name = random.choice([name for name in header if name != "__metadata__"])
            done = f"{name}: " + spoil(header[name], random)
            path.write_bytes(_join(header, data))
        case 1:
            length = random.choice((0, 1, 2**31, 2**63, 2**64 - 1))
            content = _join(header, data)
            path.write_bytes(struct.pack("<Q", length) + content[8:])
            done = f"header of {length} bytes"
        case 2:
            path.write_bytes(_join(b"[" * 1_000_000, data))
            done = "header nested deeply"
        case 3:
            path.write_bytes(_join(header, data[: random.randrange(len(data))]))
            done = "data cut"
        case _:
            content, done = damage((valid.folder / "n.safetensors").read_bytes(), random)
            path.write_bytes(content)
    return path.name, done, False


class _Owned:
    """A pickle of this makes a file."""

    def __reduce__(self):
        return os.system, ("touch owned",)


def _other(random, valid, here):
    """What is no network's file at all."""
    name = random.choice(("n.safetensors", "n.pt", "best.ckpt"))
    path = here / name
    match random.randrange(7):
        case 0:
            path.write_bytes(pickle.dumps(_Owned()))
            return name, "a pickle", True
        case 1:
            import torch

            torch.save({"a": torch.zeros(2), "b": _Owned()}, path)
            return name, "torch.save", True
        case 2:
            path.symlink_to(name)
            return name, "a link to itself", True
        case 3:
            os.mkfifo(path)
            return name, "a pipe", True
        case 4:
            path.mkdir()
            (path / "best.safetensors").mkdir()
            return name, "folders", True
        case 5:
            folder = here / "run"
            folder.mkdir()
            os.mkfifo(folder / "best.safetensors")
            return "run", "a run whose network is a pipe", True
        case _:
            path.write_bytes(
                random.choice((b"", b"\0" * 8, b"PK\x03\x04", b"\x80\x04", random.randbytes(5000)))
            )
            return name, "other bytes", True


def _onnx(random, valid, here):
    """ONNX of other outputs, constants, headers and operators."""
    from onnx import TensorProto, helper, numpy_helper

    from tests.mutations.onnx_files import GRID, NETWORK, build_onnx

    path = here / "n.onnx"
    must_fail = True
    match random.randrange(10):
        case 0:
            model, done = build_onnx(outputs=("tudf", "logits")), "outputs in another order"
            must_fail = False
        case 1:
            outputs = random.choice(
                (("logits",), ("a", "b"), ("logits", "tudf", "more"), ("tudf",))
            )
            model = build_onnx(outputs=outputs, factors=(1.0,) * 3, shifts=(0.0,) * 3)
            done, must_fail = f"outputs {outputs}", outputs != ("logits", "tudf", "more")
        case 2:
            kind = random.choice(
                (TensorProto.DOUBLE, TensorProto.INT64, TensorProto.BOOL, TensorProto.FLOAT16)
            )
            model, done, must_fail = build_onnx(kind=kind), f"outputs of type {kind}", False
        case 3:
            value = random.choice((float("nan"), float("inf"), -1e38))
            model = build_onnx(
                shifts=(value, 1.5) if value != value or random.random() < 0.5 else (0.0, value)
            )
            done, must_fail = f"adds {value}", False
        case 4:
            header = {"grid": dict(GRID), "network": dict(NETWORK), "about": {}}
            done = spoil(header, random, random.choice((number, nasty)))
            model, must_fail = build_onnx(header=header), False
        case 5:
            model, done = (
                build_onnx(header=random.choice(("[" * 100_000, "null", "3", "[]", "{}", "x"))),
                "other JSON as header",
            )
        case 6:
            size = random.choice((1 << 30, 1 << 36))
            shape = numpy_helper.from_array(np.array([size], np.int64), "huge")
            nodes = (
                helper.make_node("ConstantOfShape", ["huge"], ["zeros"]),
                helper.make_node("ReduceSum", ["zeros"], ["nothing"], keepdims=0),
            )
            model, done = (
                build_onnx(extra=nodes, constants=(shape,)),
                f"a constant of {size} numbers",
            )
            model.graph.node[1].input[1] = model.graph.node[1].input[1]
            model.graph.node.append(helper.make_node("Add", ["s0", "nothing"], ["s9"]))
            model.graph.node[2].input[0] = "s0"
            must_fail = False
        case 7:
            outside = helper.make_tensor("far", TensorProto.FLOAT, (1,), b"\0" * 4, raw=True)
            outside.ClearField("raw_data")
            outside.data_location = TensorProto.EXTERNAL
            outside.external_data.add(
                key="location", value=random.choice(("../n.safetensors", "/etc/passwd", "scan.npy"))
            )
            extra = (helper.make_node("Add", ["s0", "far"], ["unused"]),)
            model, done = build_onnx(extra=extra, constants=(outside,)), "data in another file"
            must_fail = False
        case 8:
            model = build_onnx(
                extra=(helper.make_node("Nothing", ["s0"], ["unused"], domain="com.nobody"),)
            )
            done, must_fail = "an unknown operator", False
        case _:
            content, done = damage((valid.folder / "n.onnx").read_bytes(), random)
            path.write_bytes(content)
            return path.name, done, False
    path.write_bytes(model.SerializeToString())
    return path.name, done, must_fail
