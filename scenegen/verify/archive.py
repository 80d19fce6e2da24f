"""The worlds' archive: a zip of MJCF from anywhere, screened before MuJoCo sees it. Nothing is written to disk."""

import hashlib
from dataclasses import dataclass
from io import BufferedReader
from xml.parsers import expat

import mujoco

from scenegen.dataset.archive import open_archive, referred
from scenegen.limits import MOST_ASKED, MOST_CELLS, MOST_DEPTH, MOST_ELEMENTS, MOST_GEOMS
from scenegen.truth import Solids, solids_of
from scenegen.verify.report import BrokenError
from scenegen.world import one_line

FORBIDDEN = {"include", "attach", "model", "plugin", "extension", "replicate", "composite", "flexcomp", "skin", "flex"}
"""MJCF elements that read other files, run other code, multiply, or are not solids. An archived world has none."""
FILES = {"file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back"))}
FOLDERS = {"meshdir", "texturedir", "assetdir"}
LOOKS = {"name", "rgba", "material"}
"""Attributes that say nothing of where a solid is; a world's outline leaves them out."""
WATCHED = FILES | FOLDERS | set(MOST_ASKED)


@dataclass(frozen=True, eq=False)
class Archive:
    """The worlds of one shard."""

    documents: dict[int, bytes]
    """MJCF by the world's number."""
    outlines: dict[int, bytes]
    """What `screen` gives for each document."""
    assets: dict[str, bytes]

    def world(self, number: int) -> tuple[bytes, dict[str, bytes]]:
        """A world's document and the files it refers to. Raises BrokenError where there is none."""
        if number not in self.documents:
            raise BrokenError(f"has no member {number:06d}.xml")
        document = self.documents[number]
        return document, {name: self.assets[name] for name in referred(document, self.assets)}


def read_archive(file: BufferedReader, name: str) -> Archive:
    """Every member of the archive in `file`, screened. Raises BrokenError, naming `name`, with what is wrong."""
    with open_archive(file, name) as members:
        contents = {member: members.read(member) for member in members}
        documents = {int(member[:-4]): content for member, content in contents.items() if member.endswith(".xml")}
        assets = {member: content for member, content in contents.items() if not member.endswith(".xml")}
        outlines = {
            number: screen(document, frozenset(assets), f"{number:06d}.xml") for number, document in documents.items()
        }
    return Archive(documents, outlines, assets)


def screen(document: bytes, assets: frozenset[str], name: str) -> bytes:
    """See that an MJCF document is self-contained and of bounded size. Raises BrokenError, naming `name`.

    Returns a digest of its elements but for names and colours, whatever their order: equal for documents of the same
    solids that were renamed or reordered, though not for every way to write the same solids (`geometry_digest`).

    MuJoCo would read included files and assets from anywhere on disk, expand what multiplies, and take memory as it is
    told; none of that is in a document that scenegen has archived.
    """
    geoms, outline, within = 0, list[str](), [""]

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal geoms
        geoms += tag == "geom"
        if tag in FORBIDDEN:
            raise BrokenError(f"{name}: has <{tag}>, expected a self-contained world of solids")
        if len(within) > MOST_DEPTH or len(outline) >= MOST_ELEMENTS or geoms > MOST_GEOMS:
            raise BrokenError(
                f"{name}: more than {MOST_GEOMS} geoms, {MOST_ELEMENTS} elements or {MOST_DEPTH} levels of them"
            )
        if tag == "numeric" or not WATCHED.isdisjoint(attributes):
            _check_attributes(tag, attributes, assets, name)
        written = [f"{key}={value}" for key, value in sorted(attributes.items()) if key not in LOOKS]
        outline.append(f"{within[-1]} {tag} {' '.join(written)}")
        within.append("" if tag == "geom" else hashlib.sha256(outline[-1].encode()).hexdigest()[:16])

    def end(tag: str) -> None:
        within.pop()

    def refuse(*_: object) -> None:
        raise BrokenError(f"{name}: declares a document type or entities, expected plain MJCF")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(document, True)
    except (expat.ExpatError, ValueError) as error:
        raise BrokenError(f"{name}: is not plain XML ({error})") from None
    return hashlib.sha256("\n".join(sorted(outline)).encode()).digest()


def _check_attributes(tag: str, attributes: dict[str, str], assets: frozenset[str], name: str) -> None:
    """Files and amounts that an element asks for. Raises BrokenError, or ValueError for no number."""
    for key, value in attributes.items():
        where = f"{name}: <{tag} {key}={value[:80]!r}>"
        if key in FILES and value not in assets:
            raise BrokenError(f"{where}: expected a file of the archive")
        if key in FOLDERS and value:
            raise BrokenError(f"{where}: expected files beside the document")
        most = 100_000 if (tag, key) == ("numeric", "size") else MOST_ASKED.get(key)
        if most is not None and not -1 <= _amount(value) <= most:
            raise BrokenError(f"{where}: expected {most} at most")
    for one, other in (("nrow", "ncol"), ("width", "height")):
        if _amount(attributes.get(one, "0")) * _amount(attributes.get(other, "0")) > MOST_CELLS:
            raise BrokenError(f"{name}: <{tag}>: {one} times {other} is more than {MOST_CELLS}")


def _amount(value: str) -> float:
    """A number as MJCF writes amounts: 100, or 16M."""
    unit = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}.get(value[-1:].upper())
    return float(value[:-1]) * unit if unit else float(value)


def compile_solids(document: bytes, assets: dict[str, bytes], name: str) -> Solids:
    """The solids of an archived world that has been screened. Raises BrokenError, naming `name`."""
    try:
        model = mujoco.MjModel.from_xml_string(document.decode(), assets)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        return solids_of(model, data)
    except (ValueError, MemoryError, mujoco.FatalError) as error:
        raise BrokenError(f"{name}: MuJoCo cannot compile it: {one_line(error)[:200]}") from None
