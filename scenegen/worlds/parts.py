"""What an MJCF file is made of, before MuJoCo reads it: its elements, and those of the files that
it includes."""

import re
from collections.abc import Iterator
from pathlib import Path

from scenegen.errors import BrokenError, DatasetError, SceneError
from scenegen.files import read_bounded
from scenegen.limits import MOST_DOCUMENT_BYTES, MOST_GEOMS
from scenegen.worlds.screen import check_amounts, check_numbers

ELEMENT = re.compile(
    r"<(/?)([A-Za-z]\w*)((?:(?:\s+|(?<=[\"']))[\w:.-]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*)\s*(/?)>"
)
"""Whether it is an element's end, its name and attributes, and whether nothing is within. MuJoCo
wants no space between attributes."""
ATTRIBUTE = re.compile(r"([\w:.-]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
PART = "mujocoinclude"
"""Root of a file that only others include."""


def look_over(main: Path) -> tuple[bool, frozenset[Path]]:
    """Read an MJCF file and all that it includes or attaches: whether it is a world of its own, and
    which files it includes, resolved.

    Raises SceneError for a file that is not regular or too large, for numbers that no solid can
    have, and for more geoms than MuJoCo can cope with.
    """
    is_world, included, waiting, seen, geoms = True, set[Path](), [main], set[Path](), 0.0
    while waiting:
        path = waiting.pop()
        if path.resolve() in seen:  # MuJoCo says what it thinks of a circle
            continue
        seen.add(path.resolve())
        for tag, attributes, times in _elements(path):
            is_world &= not (tag == PART and path is main)
            geoms += times * (tag == "geom")
            if (
                max(geoms, times * _count(tag, attributes)) > MOST_GEOMS
            ):  # over many more, MuJoCo takes hours
                raise SceneError(f"{main}: more than {MOST_GEOMS} geoms; merge some into meshes")
            _check(tag, attributes, path)
            if tag in ("include", "model") and "file" in attributes:
                # MuJoCo looks from the file that includes, or from the main one
                for folder in (path.parent, main.parent):
                    other = folder / attributes["file"]
                    if other.exists():
                        waiting.append(other)
                        if tag == "include":
                            included.add(other.resolve())
                        break
    return is_world, frozenset(included)


def _check(tag: str, attributes: dict[str, str], path: Path) -> None:
    try:
        check_numbers(tag, attributes, str(path))
        check_amounts(tag, attributes, str(path))
    except BrokenError as error:
        raise SceneError(str(error)) from None
    except ValueError:  # no number at all: MuJoCo says so
        pass


def _count(tag: str, attributes: dict[str, str]) -> float:
    """How often an element gives what is within it."""
    count = attributes.get("count", "") if tag == "replicate" else ""
    return float(count) if count.isdecimal() else 1.0


def _elements(path: Path) -> Iterator[tuple[str, dict[str, str], float]]:
    """Names and attributes of a file's elements, and how often the file's <replicate>s around each
    repeat it.

    They are read as forgivingly as MuJoCo does; expat would refuse some.
    """
    try:
        text = read_bounded(path, MOST_DOCUMENT_BYTES).decode(errors="replace")
    except (DatasetError, FileNotFoundError) as error:
        raise SceneError(str(error)) from None
    first, *rest = text.split("<!--")
    times = [1.0]
    for piece in (first, *(after.partition("-->")[2] for after in rest)):
        for found in ELEMENT.finditer(piece):
            ended, tag, written, empty = found.groups()
            if ended:
                if tag == "replicate" and len(times) > 1:
                    times.pop()
                continue
            pairs = (pair.groups(default="") for pair in ATTRIBUTE.finditer(written))
            attributes = {key: double or single for key, double, single in pairs}
            yield tag, attributes, times[-1]
            if tag == "replicate" and not empty:
                times.append(times[-1] * _count(tag, attributes))
