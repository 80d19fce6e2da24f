"""Screening of MJCF before MuJoCo reads it: documents must be self-contained, of bounded size, and
made of finite numbers."""

import hashlib
import math
import re
import struct
from collections.abc import Mapping
from xml.parsers import expat

from lidarsim.parameters import MAX_LENGTH_M, short_repr
from scenegen.base.errors import CorruptFileError
from scenegen.base.limits import (
    MAX_ATTRIBUTES,
    MAX_BUILTIN,
    MAX_CELLS,
    MAX_DEPTH,
    MAX_ELEMENTS,
    MAX_GEOMS,
    MAX_MJCF_VALUES,
    MAX_OTHERS,
)

FORBIDDEN = {
    "include",
    "attach",
    "model",
    "plugin",
    "extension",
    "replicate",
    "composite",
    "flexcomp",
    "skin",
    "flex",
}
"""MJCF elements that read other files, run other code, multiply, or are not solids. An archived
world has none."""
SOLIDS = {"geom", "mesh", "hfield", "material"}
"""Elements whose number only the limits of geoms and elements bound."""
FILES = {"file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back"))}
FOLDERS = {"meshdir", "texturedir", "assetdir"}
LOOKS = {"name", "rgba", "material"}
"""Attributes that do not place a solid; a world's outline omits them."""
WATCHED = FILES | FOLDERS | {"builtin"} | set(MAX_MJCF_VALUES)
LENGTHS = {"pos", "size", "fromto", "scale", "refpos", "vertex", "elevation"}
"""Attributes that hold metres, or multiples of them."""
TURNS = {"quat", "axisangle", "xyaxes", "zaxis", "euler", "refquat", "params", "rgba"}
"""Attributes that hold other numbers on which the solids, or whether they are seen, depend."""
SUSPECT = re.compile(rb"[\d.]e[+\d]|\d{7}|nan|inf|&")
"""A pattern that every document with a NaN, infinite or large number matches, in small letters.
Others need no check number by number."""


def screen(document: bytes, assets: Mapping[str, bytes], name: str) -> bytes:
    """Check that an MJCF document is self-contained and of bounded size.

    MuJoCo would read included files and assets from anywhere on disk, expand what multiplies, and
    allocate as much memory as a document asks for. No document that scenegen has archived does
    that.

    Args:
        document: The MJCF.
        assets: The files of its archive, by name.
        name: Its name, for messages.

    Returns:
        A digest of its elements without names and colours, in any order. It is equal for documents
        of the same solids that were renamed or reordered, though not for every way to write the
        same solids (`geometry_digest`).

    Raises:
        CorruptFileError: If it is not plain, self-contained MJCF, or too large.
    """
    geoms, other_elements, outline, within = 0, 0, list[str](), [""]
    suspect = SUSPECT.search(document.lower()) is not None

    def _start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal geoms, other_elements
        geoms += tag == "geom"
        other_elements += tag not in SOLIDS
        if tag in FORBIDDEN:
            raise CorruptFileError(
                f"{name}: has <{tag}>, expected a self-contained world of solids"
            )
        if len(within) > MAX_DEPTH or len(outline) >= MAX_ELEMENTS or geoms > MAX_GEOMS:
            raise CorruptFileError(
                f"{name}: more than {MAX_GEOMS} geoms, {MAX_ELEMENTS} elements or {MAX_DEPTH} "
                "levels of them"
            )
        if other_elements > MAX_OTHERS or len(attributes) > MAX_ATTRIBUTES:
            raise CorruptFileError(
                f"{name}: more than {MAX_OTHERS} elements besides {', '.join(sorted(SOLIDS))}, or "
                f"{MAX_ATTRIBUTES} attributes of one; put geoms straight into the worldbody"
            )
        # most elements have none of these attributes: one set operation spares the look-ups
        if tag == "numeric" or not WATCHED.isdisjoint(attributes):
            _check_attributes(tag, attributes, assets, name)
        if suspect:
            _check_numbers(tag, attributes, name)
        written = [
            f"{key}={value}" for key, value in sorted(attributes.items()) if key not in LOOKS
        ]
        # an element counts with the digest of its parent's, so that a move to another body changes
        # it
        outline.append(f"{within[-1]} {tag} {' '.join(written)}")
        # a geom holds no other solid, so that nobody needs its digest
        within.append(
            "" if tag == "geom" else hashlib.sha256(outline[-1].encode()).hexdigest()[:16]
        )

    def _end(tag: str) -> None:
        within.pop()

    def _refuse(*_: object) -> None:
        raise CorruptFileError(f"{name}: declares a document type or entities, expected plain MJCF")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = _start, _end
    # entities could expand to gigabytes
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = _refuse
    try:
        parser.Parse(document, True)
    except (expat.ExpatError, ValueError) as error:
        raise CorruptFileError(f"{name}: is not plain XML ({error})") from None
    return hashlib.sha256("\n".join(sorted(outline)).encode()).digest()


def _check_attributes(
    tag: str, attributes: dict[str, str], assets: Mapping[str, bytes], name: str
) -> None:
    """Check the files and amounts that an element asks for. Raises CorruptFileError, or ValueError
    for words in place of numbers."""
    for key, value in attributes.items():
        where = f"{name}: <{tag} {key}={short_repr(value)}>"
        if key in FILES and value not in assets:
            raise CorruptFileError(f"{where}: expected a file of the archive")
        if key in FOLDERS and value:
            raise CorruptFileError(f"{where}: expected files beside the document")
        if (tag, key) == ("hfield", "file") and not value.lower().endswith(".png"):
            _check_field(assets[value], where)
        limit = 100_000 if (tag, key) == ("numeric", "size") else MAX_MJCF_VALUES.get(key)
        # by -1, MuJoCo's files ask for its default
        if limit is not None and not -1 <= _amount(value) <= limit:
            raise CorruptFileError(f"{where}: expected {limit} at most")
    for sides in (("width", "height"), ("nrow", "ncol")):
        if math.prod(_amount(attributes.get(side, "0")) for side in sides) > MAX_CELLS:
            raise CorruptFileError(
                f"{name}: <{tag}>: {' times '.join(sides)} is more than {MAX_CELLS}"
            )
    params = attributes.get("params", "") if "builtin" in attributes else ""
    if not all(float(part) <= MAX_BUILTIN for part in params.split()):
        raise CorruptFileError(
            f"{name}: <{tag} params={short_repr(params)}>: expected {MAX_BUILTIN} at most"
        )


def _check_numbers(tag: str, attributes: Mapping[str, str], name: str) -> None:
    """Check that numbers that place, turn and size solids are finite. Raises CorruptFileError.

    MuJoCo takes a NaN for a number that is missing, so that solids would silently stand elsewhere.
    """
    for key in attributes.keys() & (LENGTHS | TURNS):
        limit = MAX_LENGTH_M if key in LENGTHS else math.inf
        for part in attributes[key].split():
            try:
                number = float(part)
            except ValueError:  # MuJoCo reports it
                continue
            if not (math.isfinite(number) and abs(number) <= limit):
                expected = f"numbers up to {limit:g}" if math.isfinite(limit) else "finite numbers"
                raise CorruptFileError(
                    f"{name}: <{tag} {key}={short_repr(attributes[key])}>: {short_repr(part)}, "
                    "expected "
                    f"{expected}"
                )


def _check_field(content: bytes, where: str) -> None:
    """Check a height field's file, which begins with its rows and columns: MuJoCo allocates by
    these."""
    rows, columns = struct.unpack("<ii", content[:8]) if len(content) >= 8 else (0, 0)
    if not (0 < rows * columns <= MAX_CELLS and len(content) == 8 + 4 * rows * columns):
        raise CorruptFileError(
            f"{where}: {rows} rows and {columns} columns in {len(content)} bytes, expected a "
            "height field"
        )


def _amount(value: str) -> float:
    """Read an amount as MJCF writes it: 100, or 16M."""
    unit = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}.get(value[-1:].upper())
    return float(value[:-1]) * unit if unit else float(value)
