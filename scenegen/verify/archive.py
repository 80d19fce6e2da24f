"""The worlds' archive: a zip of MJCF from anywhere, screened before MuJoCo sees it. Nothing is written to disk."""

import os
import struct
import zipfile
from collections import Counter
from dataclasses import dataclass
from io import BufferedReader

import mujoco

from scenegen.limits import MOST_ARCHIVE_BYTES, MOST_ASSET_BYTES, MOST_CELLS, MOST_DOCUMENT_BYTES, MOST_MEMBERS
from scenegen.quiet import quiet_mujoco
from scenegen.screen import ScreenError, screen
from scenegen.truth import Solids, solids_of
from scenegen.verify.report import BrokenError
from scenegen.world import one_line


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
        return document, {name: content for name, content in self.assets.items() if name.encode() in document}


def read_archive(file: BufferedReader, name: str) -> Archive:
    """Every member of the archive in `file`, screened. Raises BrokenError, naming `name`, with what is wrong."""
    try:
        _check_directory(file)
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            _check_members(members)
            contents = {member.filename: archive.read(member) for member in members}
        documents = {int(member[:-4]): content for member, content in contents.items() if member.endswith(".xml")}
        assets = {member: content for member, content in contents.items() if not member.endswith(".xml")}
        for member, content in assets.items():
            _check_image(member, content)
        outlines = {number: screen(document, assets, f"{number:06d}.xml") for number, document in documents.items()}
    except (BrokenError, ScreenError) as error:
        raise BrokenError(f"{name}: {error}") from None
    except Exception as error:  # zipfile's, zlib's, struct's, and what else a crafted file may bring forth
        raise BrokenError(f"{name}: is damaged ({one_line(error)[:200] or type(error).__name__})") from None
    return Archive(documents, outlines, assets)


def _check_directory(file: BufferedReader) -> None:
    """Before zipfile reads the directory of members, see that it is small."""
    size = file.seek(0, os.SEEK_END)
    if size > MOST_ARCHIVE_BYTES:
        raise BrokenError(f"{size} bytes, expected {MOST_ARCHIVE_BYTES} at most")
    file.seek(max(size - 22, 0))
    end = file.read(22)
    if len(end) < 22 or end[:4] != b"PK\5\6":
        raise BrokenError("is not a whole zip file: it does not end as one")
    count, length = struct.unpack("<HI", end[10:16])
    if count > MOST_MEMBERS or length > MOST_MEMBERS * 200:
        raise BrokenError(f"{count} members listed in {length} bytes, expected {MOST_MEMBERS} members at most")


def _check_members(members: list[zipfile.ZipInfo]) -> None:
    total = 0
    for member in members:
        name = member.filename
        plain = name.isascii() and name.isprintable() and not set(name) & set('/\\:*?"<>|') and not name.startswith(".")
        if not plain or len(name) > 200 or member.orig_filename != name:
            raise BrokenError(f"member {name[:80]!r}: expected a plain file name, of a file beside the others")
        if name.endswith(".xml") and not (len(name) == 10 and name[:6].isdecimal()):
            raise BrokenError(f"member {name!r}: expected a world's number, six digits, before .xml")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & 1:
            raise BrokenError(f"member {name}: is encrypted or packed otherwise than by deflate")
        most = MOST_DOCUMENT_BYTES if name.endswith(".xml") else MOST_ASSET_BYTES
        if member.file_size > most:
            raise BrokenError(f"member {name}: {member.file_size} bytes unpacked, expected {most} at most")
        total += member.file_size
    if total > MOST_ARCHIVE_BYTES:
        raise BrokenError(f"{total} bytes unpacked, expected {MOST_ARCHIVE_BYTES} at most")
    twice = [name for name, count in Counter(member.filename for member in members).items() if count > 1]
    if twice:
        raise BrokenError(f"member {twice[0]}: is there twice")


def _check_image(name: str, content: bytes) -> None:
    """A PNG file says how much memory it wants."""
    if content[:8] == b"\x89PNG\r\n\x1a\n":
        width, height = struct.unpack(">II", content[16:24])
        if width * height > MOST_CELLS:
            raise BrokenError(f"member {name}: an image of {width} x {height}, expected {MOST_CELLS} pixels at most")


def compile_solids(document: bytes, assets: dict[str, bytes], name: str) -> Solids:
    """The solids of an archived world that has been screened. Raises BrokenError, naming `name`."""
    try:
        with quiet_mujoco():
            return solids_of(mujoco.MjModel.from_xml_string(document.decode(), assets))
    except (ValueError, MemoryError, mujoco.FatalError) as error:
        raise BrokenError(f"{name}: MuJoCo cannot compile it: {one_line(error)[:200]}") from None
