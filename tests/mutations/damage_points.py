"""Family ``points``: scans that promise more than they hold, or hold other things than points."""

import io
import os
import pickle
import struct
from pathlib import Path

import numpy as np

from scenegen.display.exchange.files import encode_points
from tests.mutations.case import Attempt, refuses, words
from tests.mutations.damage_bytes import damage
from tests.mutations.damage_weights import _holds, _Owned
from tests.mutations.datasets import finite_prediction
from tests.mutations.nasty import ESCAPES

POINTS = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))

WRITTEN = (".pcd", ".bin", ".npz")
"""Files as `scenegen scan` writes them, damaged anywhere."""


def attempt(random, valid, here):
    """A damaged scan, completed."""
    suffix = random.choice((".ply", ".ply", ".npy", ".xyz", *WRITTEN))
    path = here / f"scan{suffix}"
    must_fail = False
    if suffix in WRITTEN:
        content, said = damage(encode_points(suffix, POINTS), random)
        path.write_bytes(content)
    elif random.random() < 0.2:
        content, said = damage((valid.folder / path.name).read_bytes(), random)
        path.write_bytes(content)
    elif random.random() < 0.08:
        os.mkfifo(path)
        said, must_fail = "a pipe", True
    else:
        content, said, must_fail = {".ply": _ply, ".npy": _npy, ".xyz": _xyz}[suffix](random)
        path.write_bytes(content)
    valid.put("n.safetensors", here)
    return Attempt(
        words=(
            "complete",
            path.name,
            *words("--weights n.safetensors --quiet --device cpu -o out.h5"),
        ),
        damage=f"{path.name}: {said}",
        makes=("out.h5",),
        after=lambda: finite_prediction(Path("out.h5")),
        holds=refuses(said) if must_fail else _holds,
    )


def _head(count, kind="ascii", more="", properties=None):
    said = (
        "".join(f"property float {axis}\n" for axis in "xyz") if properties is None else properties
    )
    return f"ply\nformat {kind} 1.0\nelement vertex {count}\n{said}{more}end_header\n"


def _ply(random):
    text = "\n".join(" ".join(f"{x:.3f}" for x in point) for point in POINTS)
    binary = POINTS.astype("<f4").tobytes()
    match random.randrange(10):
        case 0:
            count = random.choice((10**12, 2**31, 2**63, 10**30, 21))
            return (_head(count) + text).encode(), f"promises {count} points and holds 20", True
        case 1:
            count = random.choice((10**12, 2**31, 2**63, 21))
            return (
                _head(count, "binary_little_endian").encode() + binary,
                f"promises {count}, binary",
                True,
            )
        case 2:
            count = random.choice((-1, 0, "many", "nan", "1e3", ""))
            return (_head(count) + text).encode(), f"promises {count}", True
        case 3:
            lists = "property list uchar int vertex_indices\n"
            faces = f"element face {random.choice((1, 10**9))}\n{lists}"
            body = struct.pack("<Biii", 255, 0, 1, 2**31 - 1)
            return (
                _head(20, "binary_little_endian", faces).encode() + binary + body,
                "faces beyond its points",
                False,
            )
        case 4:
            lists = "".join(f"property list uint float {axis}\n" for axis in "xyz")
            body = struct.pack("<L", 2**32 - 1) + binary
            return (
                _head(20, "binary_little_endian", properties=lists).encode() + body,
                "lists for coordinates",
                True,
            )
        case 5:
            kind = random.choice(("utf8", "binary", "binary_middle_endian", ESCAPES))
            return (_head(20, kind) + text).encode(), f"format {ascii(kind)[:40]}", True
        case 6:
            wrong = random.choice(
                ("property string x\n", "property float x\n" * 3, "property float a\n", "")
            )
            return (_head(20, properties=wrong) + text).encode(), f"properties {wrong!r}", True
        case 7:
            value = random.choice((*words("nan inf 1e300 -1e38 1e9 0x10"), ESCAPES))
            return (
                (_head(21) + text + f"\n{value} 0 0").encode(),
                f"a point at {ascii(value)[:40]}",
                False,
            )
        case 8:
            return (
                (_head(20, more="comment x\n" * 200_000) + text).encode(),
                "200000 comments",
                False,
            )
        case _:
            more = f"element {'x' * 10_000} 3\nproperty float x\n"
            return (_head(20, more=more * 50) + text).encode(), "50 elements more", False


def _npy(random):
    memory = io.BytesIO()
    match random.randrange(8):
        case 0:
            np.save(memory, np.array([_Owned()], dtype=object), allow_pickle=True)
            return memory.getvalue(), "objects", True
        case 1:
            return pickle.dumps(_Owned()), "a pickle", True
        case 2:
            values = random.choice(
                (POINTS.T, POINTS[0], POINTS[:0], POINTS[None], np.float64(3), POINTS[:, :2])
            )
            np.save(memory, values)
            return memory.getvalue(), f"shape {np.shape(values)}", np.shape(values) != (3, 20)
        case 3:
            kind = random.choice(("c16", "?", "S5", "M8[s]", "f2", ">f8", "i1"))
            np.save(
                memory,
                POINTS.astype("i8").astype(kind) if kind[0] == "M" else POINTS.real.astype(kind),
            )
            return memory.getvalue(), f"of type {kind}", kind in ("c16", "S5", "M8[s]", "?")
        case 4:
            shape = random.choice(((10**12, 3), (2**62, 3), (-1, 3), (2**63, 2**63), (3, 10**18)))
            said = (
                f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(
                    117
                ).encode()
                + b"\n"
            )
            return (
                b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + said + POINTS.tobytes(),
                f"promises {shape}",
                True,
            )
        case 5:
            said = b"{'descr': " + b"(" * 9000 + b"\n"
            return (
                b"\x93NUMPY\x01\x00" + struct.pack("<H", len(said)) + said,
                "a header that nests",
                True,
            )
        case 6:
            values = POINTS.copy()
            values[random.randrange(20)] = random.choice((np.nan, np.inf, 1e300, -1e308))
            np.save(memory, values)
            return memory.getvalue(), "a point that is none", False
        case _:
            np.savez(memory, POINTS)
            return memory.getvalue(), "an archive of arrays", True


def _xyz(random):
    text = "\n".join(" ".join(f"{x:.3f}" for x in point) for point in POINTS)
    match random.randrange(6):
        case 0:
            return (
                text.encode() + b"\nnan nan nan\ninf 0 0\n1e300 0 0\n",
                "points that are none",
                False,
            )
        case 1:
            return ("1 " * 3_000_000).encode(), "one line of 6 MB", True
        case 2:
            return random.choice((b"", b"\n" * 100, b"# nothing\n", b"a b c\n")), "no points", True
        case 3:
            return text.encode() + b"\n1 2\n", "a line of two numbers", False
        case 4:
            return (
                text.encode() + f"\n{ESCAPES} 0 0\n".encode(),
                "a line of control characters",
                False,
            )
        case _:
            return random.randbytes(4000), "other bytes", True
