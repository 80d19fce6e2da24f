"""Archives of worlds: untrusted zip files, unpacked within limits, and worlds extracted as files
that MuJoCo opens."""

import os
import re
import struct
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from xml.etree import ElementTree

from lidarsim.parameters import short_repr
from scenegen.base.errors import CorruptFileError, DatasetError, printable, reraise_as
from scenegen.base.files import check_ours, disk_errors, make_parent, write_atomic, write_result
from scenegen.base.limits import (
    MAX_ARCHIVE_BYTES,
    MAX_ASSET_BYTES,
    MAX_CELLS,
    MAX_DOCUMENT_BYTES,
    MAX_MEMBERS,
)
from scenegen.base.reading import read_bounded

MEMBER = re.compile(r"([0-9]{6}|[1-9][0-9]{6,8})\.xml")
"""Name of a world's document in an archive."""
PLAIN = re.compile(r"""(?![.])[^\x00-\x1f\x7f-\U0010ffff/\\:*?"<>|]{1,200}""")
"""Allowed names of members: no path, and no character that a file system may treat specially."""
DOCUMENT = "world.xml"
"""Name of a world's document in `Dataset.world`."""


class Members(dict[str, zipfile.ZipInfo]):
    """Members of an open archive by name. Each is read on request."""

    def __init__(self, archive: zipfile.ZipFile):
        super().__init__({member.filename: member for member in archive.infolist()})
        self._archive = archive

    def read(self, name: str) -> bytes:
        """Unpack a member.

        Raises:
            CorruptFileError: if its size differs from the directory's, or it is an image that would
                take too much memory.
        """
        member = self[name]
        # `ZipFile.read` would unpack everything before it compares sizes
        with self._archive.open(member) as file:
            content = file.read(member.file_size + 1)
        # limits were checked for the size in the directory, so the content must have that size
        if len(content) != member.file_size:
            raise CorruptFileError(
                f"member {name}: {len(content)} bytes unpacked, expected {member.file_size}"
            )
        # a small PNG may declare a huge image, which MuJoCo would allocate
        if content[:8] == b"\x89PNG\r\n\x1a\n":
            width, height = struct.unpack(">II", content[16:24])
            if width * height > MAX_CELLS:
                raise CorruptFileError(
                    f"member {name}: an image of {width} x {height}, expected {MAX_CELLS} at most"
                )
        return content

    def world(self, name: str) -> tuple[bytes, dict[str, bytes]]:
        """Unpack the document `name`, and the files that it refers to."""
        document = self.read(name)
        return document, {file: self.read(file) for file in referred(document, self)}


def referred(document: bytes, names: Iterable[str]) -> list[str]:
    """Find the files that an MJCF document refers to: names that are values of its attributes.

    Args:
        document: The document.
        names: Names of files to look for.

    Returns:
        Names of the files, without documents.
    """
    values = {
        match[1] or match[2]
        # a pattern instead of a parser: untrusted documents reach this before they are screened
        for match in re.finditer(rb"""=\s*(?:"([^"<]*)"|'([^'<]*)')""", document)
    }
    return [name for name in names if not name.endswith(".xml") and name.encode() in values]


@contextmanager
def open_archive(file: BufferedReader, name: str) -> Iterator[Members]:
    """Open an archive, and check the names and sizes of its members.

    Args:
        file: The open file.
        name: Its name, for messages.

    Yields:
        The members.

    Raises:
        CorruptFileError: if the archive is damaged, or reading a member in the block fails.
    """
    try:
        _check_directory(file)
        with zipfile.ZipFile(file) as archive:
            _check_members(archive.infolist())
            yield Members(archive)
    except CorruptFileError as error:
        raise CorruptFileError(f"{name}: {error}") from None
    except Exception as error:  # a crafted file may raise any error of zipfile, zlib or struct
        raise CorruptFileError(
            f"{name}: is damaged ({printable(error)[:200] or type(error).__name__})"
        ) from None


def _check_directory(file: BufferedReader) -> None:
    """Check the size of the directory of members before zipfile reads it into memory."""
    size = file.seek(0, os.SEEK_END)
    if size > MAX_ARCHIVE_BYTES:
        raise CorruptFileError(f"{size} bytes, expected {MAX_ARCHIVE_BYTES} at most")
    # the end record has 22 bytes, and the 20 before it would be a zip64 locator
    file.seek(max(size - 42, 0))
    end = file.read(42)
    # PK\6\7 would point to a second directory (zip64) of any size
    if len(end) < 22 or end[-22:-18] != b"PK\5\6" or end[:4] == b"PK\6\7":
        raise CorruptFileError("is not a whole zip file: it does not end as one")
    # total entries and the directory's size, as the end record has them (APPNOTE.TXT, 4.3.16)
    count, length = struct.unpack("<HI", end[-12:-6])
    if count > MAX_MEMBERS or length > MAX_MEMBERS * 200:
        raise CorruptFileError(
            f"{count} members listed in {length} bytes, expected {MAX_MEMBERS} members at most"
        )


def _check_members(members: list[zipfile.ZipInfo]) -> None:
    total = 0
    for member in members:
        name = member.filename
        # zipfile cuts names at a NUL, so the original is compared as well
        if not PLAIN.fullmatch(name) or member.orig_filename != name:
            raise CorruptFileError(
                f"member {short_repr(name)}: expected a plain file name, of a file beside the "
                "others"
            )
        if name.endswith(".xml") and not MEMBER.fullmatch(name):
            raise CorruptFileError(
                f"member {short_repr(name)}: expected a world's number, six digits or more, "
                "before .xml"
            )
        if (
            member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
            or member.flag_bits & 1
        ):
            raise CorruptFileError(
                f"member {name}: is encrypted or packed otherwise than by deflate"
            )
        max_bytes = MAX_DOCUMENT_BYTES if name.endswith(".xml") else MAX_ASSET_BYTES
        if member.file_size > max_bytes:
            raise CorruptFileError(
                f"member {name}: {member.file_size} bytes unpacked, expected {max_bytes} at most"
            )
        total += member.file_size
    if total > MAX_ARCHIVE_BYTES:
        raise CorruptFileError(f"{total} bytes unpacked, expected {MAX_ARCHIVE_BYTES} at most")
    # of two members with the same name, readers may use either
    for name, count in Counter(member.filename for member in members).most_common(1):
        if count > 1:
            raise CorruptFileError(f"member {name}: is there twice")


FOLDERS = ("assetdir", "meshdir", "texturedir")


def write_extracted(files: Mapping[str, bytes], output: Path) -> None:
    """Write a world to files that MuJoCo opens.

    Files that the document refers to go to a folder beside it, named as `output` with the ending
    ``.files``; the document then refers to that folder. No file in the folder is replaced.

    Args:
        files: The world, from `Dataset.world`.
        output: Path of the document.

    Raises:
        DatasetError: if other files stand there, or the document is no XML.
    """
    document = files[DOCUMENT]
    assets = {name: content for name, content in files.items() if name != DOCUMENT}
    check_ours(output)
    make_parent(output)
    if assets:
        folder = output.with_suffix(".files")
        # files first: a document without its files would look complete
        document = _referring(document, folder.name, output)
        _add(assets, folder)
    write_result(output, document)


def _referring(document: bytes, folder: str, output: Path) -> bytes:
    """Make `document` refer to its files in `folder`."""
    fault = f"{output}: the archived world is no XML: "
    errors = (ElementTree.ParseError, ValueError, RecursionError)
    with reraise_as(DatasetError, fault, "; verify the dataset", of=errors):
        root = ElementTree.fromstring(document)
    # any of these would win over, or stand beside, the folder that is set below
    for compiler in root.iter("compiler"):
        for name in FOLDERS:
            compiler.attrib.pop(name, None)
    root.insert(0, ElementTree.Element("compiler", {"assetdir": folder}))
    ElementTree.indent(root)
    return ElementTree.tostring(root) + b"\n"


def _add(files: Mapping[str, bytes], folder: Path) -> None:
    """Write `files` into `folder`. Equal files may exist there."""
    with disk_errors(folder):
        folder.mkdir(exist_ok=True)
    absent = {name: content for name, content in files.items() if not (folder / name).exists()}
    # several worlds may share a folder: equal files are kept
    for name in files.keys() - absent.keys():
        if read_bounded(folder / name, MAX_ASSET_BYTES) != files[name]:
            raise DatasetError(f"{folder / name}: is there and another file; give another -o")
    for name, content in absent.items():
        write_atomic(folder / name, content)
