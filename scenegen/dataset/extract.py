"""Worlds out of a dataset: compiled again, or as files that MuJoCo opens, with what a document
refers to in a folder."""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from scenegen.dataset.read import Dataset
from scenegen.errors import BrokenError, DatasetError, SceneError
from scenegen.files import (
    check_ours,
    disk_error,
    make_parent,
    read_bounded,
    write_result,
    write_whole,
)
from scenegen.limits import MOST_ASSET_BYTES
from scenegen.worlds.screen import screen
from scenegen.worlds.world import World, compile_world


def compile_archived(dataset: Dataset, split: str, number: int) -> World:
    """World `number` of a split, compiled; the document is screened before MuJoCo sees it.

    Raises DatasetError where there is none, or it cannot be compiled.
    """
    files = dataset.world(split, number)
    document, name = files.pop(DOCUMENT), f"{number:06d}.xml"
    try:
        screen(document, files, name)
        return compile_world(document, files, name=name)
    except (BrokenError, SceneError) as error:
        raise DatasetError(
            f"{dataset.folder}: {error}; copy the dataset again, or generate it"
        ) from None


DOCUMENT = "world.xml"
"""What `Dataset.world` calls the document."""
FOLDERS = ("assetdir", "meshdir", "texturedir")


def write_extracted(files: Mapping[str, bytes], output: Path) -> None:
    """Write a world, as `Dataset.world` gives it, to `output`.

    The document goes there as it is archived. If it refers to other files, these go into a folder
    of their own, `output`'s name with ``.files`` for its ending, and the document says so. In that
    folder nothing is replaced. Raises DatasetError.
    """
    document = files[DOCUMENT]
    others = {name: content for name, content in files.items() if name != DOCUMENT}
    check_ours(output)
    make_parent(output)
    if others:
        folder = output.with_suffix(".files")
        document = _referring(document, folder.name, output)
        _add(others, folder)
    write_result(output, document)


def _referring(document: bytes, folder: str, output: Path) -> bytes:
    """`document` with its files in `folder`."""
    try:
        root = ElementTree.fromstring(document)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise DatasetError(
            f"{output}: the archived world is no XML ({error}); verify the dataset"
        ) from None
    for compiler in root.iter("compiler"):
        for name in FOLDERS:
            compiler.attrib.pop(name, None)
    root.insert(0, ElementTree.Element("compiler", {"assetdir": folder}))
    ElementTree.indent(root)
    return ElementTree.tostring(root) + b"\n"


def _add(files: Mapping[str, bytes], folder: Path) -> None:
    """Put `files` into `folder`, where they may be already."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from None
    absent = {}
    for name, content in files.items():
        try:
            there = read_bounded(folder / name, MOST_ASSET_BYTES)
        except FileNotFoundError:
            absent[name] = content
            continue
        if there != content:
            raise DatasetError(f"{folder / name}: is there and another file; give another -o")
    for name, content in absent.items():
        write_whole(folder / name, content)
