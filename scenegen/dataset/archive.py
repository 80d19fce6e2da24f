"""A shard's archive of worlds: a zip from anywhere, of which no more is unpacked than its directory
may say; and a world out of it as files that MuJoCo opens."""

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

from scenegen.base.errors import BrokenError, DatasetError, printable, raised_as, short
from scenegen.base.files import (
    check_ours,
    disk_told,
    make_parent,
    read_bounded,
    write_result,
    write_whole,
)
from scenegen.base.limits import (
    MOST_ARCHIVE_BYTES,
    MOST_ASSET_BYTES,
    MOST_CELLS,
    MOST_DOCUMENT_BYTES,
    MOST_MEMBERS,
)

MEMBER = re.compile(r"([0-9]{6}|[1-9][0-9]{6,8})\.xml")
"""What a world's document is called in an archive."""
PLAIN = re.compile(r"""(?![.])[^\x00-\x1f\x7f-\U0010ffff/\\:*?"<>|]{1,200}""")
"""What members are called: no path, and nothing that a file system could mistake."""
DOCUMENT = "world.xml"
"""What `Dataset.world` calls it."""


class Members(dict[str, zipfile.ZipInfo]):
    """The members of an open archive, by their names; each is read when asked for."""

    def __init__(self, archive: zipfile.ZipFile):
        super().__init__({member.filename: member for member in archive.infolist()})
        self._archive = archive

    def read(self, name: str) -> bytes:
        """A member's content. Raises BrokenError for an image that would take too much memory."""
        member = self[name]
        with self._archive.open(
            member
        ) as file:  # `ZipFile.read` would unpack whatever is in it, and then cut it
            content = file.read(member.file_size + 1)
        if len(content) != member.file_size:
            raise BrokenError(
                f"member {name}: {len(content)} bytes unpacked, expected {member.file_size}"
            )
        if content[:8] == b"\x89PNG\r\n\x1a\n":  # which says how much memory it wants
            width, height = struct.unpack(">II", content[16:24])
            if width * height > MOST_CELLS:
                raise BrokenError(
                    f"member {name}: an image of {width} x {height}, expected {MOST_CELLS} at most"
                )
        return content

    def world(self, name: str) -> tuple[bytes, dict[str, bytes]]:
        """The document `name`, and the files that it refers to."""
        document = self.read(name)
        return document, {other: self.read(other) for other in referred(document, self)}


def referred(document: bytes, names: Iterable[str]) -> list[str]:
    """Those of the files `names`, but for documents, that an MJCF document has among its
    attributes' values."""
    values = {
        match[1] or match[2]
        for match in re.finditer(rb"""=\s*(?:"([^"<]*)"|'([^'<]*)')""", document)
    }
    return [name for name in names if not name.endswith(".xml") and name.encode() in values]


@contextmanager
def open_archive(file: BufferedReader, name: str) -> Iterator[Members]:
    """The members of the archive in `file`, if all have plain names and bounded sizes.

    Whatever goes wrong meanwhile comes out as BrokenError, naming the archive, `name`.
    """
    try:
        _check_directory(file)
        with zipfile.ZipFile(file) as archive:
            _check_members(archive.infolist())
            yield Members(archive)
    except BrokenError as error:
        raise BrokenError(f"{name}: {error}") from None
    except (
        Exception
    ) as error:  # zipfile's, zlib's, struct's, and what else a crafted file may bring forth
        raise BrokenError(
            f"{name}: is damaged ({printable(error)[:200] or type(error).__name__})"
        ) from None


def _check_directory(file: BufferedReader) -> None:
    """Before zipfile reads the directory of members, see that it is small."""
    size = file.seek(0, os.SEEK_END)
    if size > MOST_ARCHIVE_BYTES:
        raise BrokenError(f"{size} bytes, expected {MOST_ARCHIVE_BYTES} at most")
    file.seek(max(size - 42, 0))
    end = file.read(42)
    if (
        len(end) < 22 or end[-22:-18] != b"PK\5\6" or end[:4] == b"PK\6\7"
    ):  # the latter: another directory, of any size
        raise BrokenError("is not a whole zip file: it does not end as one")
    count, length = struct.unpack("<HI", end[-12:-6])
    if count > MOST_MEMBERS or length > MOST_MEMBERS * 200:
        raise BrokenError(
            f"{count} members listed in {length} bytes, expected {MOST_MEMBERS} members at most"
        )


def _check_members(members: list[zipfile.ZipInfo]) -> None:
    total = 0
    for member in members:
        name = member.filename
        if not PLAIN.fullmatch(name) or member.orig_filename != name:
            raise BrokenError(
                f"member {short(name)}: expected a plain file name, of a file beside the others"
            )
        if name.endswith(".xml") and not MEMBER.fullmatch(name):
            raise BrokenError(
                f"member {short(name)}: expected a world's number, six digits or more, before .xml"
            )
        if (
            member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
            or member.flag_bits & 1
        ):
            raise BrokenError(f"member {name}: is encrypted or packed otherwise than by deflate")
        most = MOST_DOCUMENT_BYTES if name.endswith(".xml") else MOST_ASSET_BYTES
        if member.file_size > most:
            raise BrokenError(
                f"member {name}: {member.file_size} bytes unpacked, expected {most} at most"
            )
        total += member.file_size
    if total > MOST_ARCHIVE_BYTES:
        raise BrokenError(f"{total} bytes unpacked, expected {MOST_ARCHIVE_BYTES} at most")
    for name, count in Counter(member.filename for member in members).most_common(1):
        if count > 1:
            raise BrokenError(f"member {name}: is there twice")


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
    odd = f"{output}: the archived world is no XML: "
    failed = (ElementTree.ParseError, ValueError, RecursionError)
    with raised_as(DatasetError, odd, "; verify the dataset", of=failed):
        root = ElementTree.fromstring(document)
    for compiler in root.iter("compiler"):
        for name in FOLDERS:
            compiler.attrib.pop(name, None)
    root.insert(0, ElementTree.Element("compiler", {"assetdir": folder}))
    ElementTree.indent(root)
    return ElementTree.tostring(root) + b"\n"


def _add(files: Mapping[str, bytes], folder: Path) -> None:
    """Put `files` into `folder`, where they may be already."""
    with disk_told(folder):
        folder.mkdir(exist_ok=True)
    absent = {name: content for name, content in files.items() if not (folder / name).exists()}
    for name in files.keys() - absent.keys():
        if read_bounded(folder / name, MOST_ASSET_BYTES) != files[name]:
            raise DatasetError(f"{folder / name}: is there and another file; give another -o")
    for name, content in absent.items():
        write_whole(folder / name, content)
