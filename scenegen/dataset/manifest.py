"""The manifest, `dataset.json`: how it is read and written.

`scenegen.dataset.schema` defines the file's schema, `scenegen.dataset.contract` the objects made
from it. A manifest may come from an untrusted source: every value is checked before it is used, and
no module is imported because a manifest names it.
"""

import difflib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from scenegen import __version__
from scenegen.base.errors import (
    BrokenError,
    DatasetError,
    NewerError,
    StoreError,
    printable,
    short,
)
from scenegen.base.files import write_whole
from scenegen.base.limits import MOST_MANIFEST_BYTES
from scenegen.base.reading import sha256_of
from scenegen.base.stores import ConflictError, Place, Store, read_at
from scenegen.dataset.contract import Manifest
from scenegen.dataset.schema import (
    FORMAT,
    NAME,
    VERSION,
    Document,
    to_json,
)


def encode(manifest: Document) -> bytes:
    """Content of the file."""
    return (json.dumps(to_json(manifest), indent=1) + "\n").encode()


def write(folder: Place, manifest: Manifest) -> None:
    """Replace the manifest of a folder; at a store, the version that was read last.

    If another run replaced it meanwhile, a complete manifest stays, and an incomplete one is
    replaced. Manifests of such runs differ only in the shards that they list.

    Raises:
        StoreError: if the other manifest has other parameters, or completes the dataset with other
            bytes.
    """
    content = encode(manifest)
    if not isinstance(folder, Store):
        write_whole(folder / NAME, content)
        return
    while True:  # until no other run replaces it in between
        try:
            folder.replace(NAME, content)
            return
        except ConflictError:
            stored = read_content(folder)
        # our own request succeeded, and its answer was lost
        if stored == content:
            return
        stored_manifest = parse(stored)
        if stored_manifest.parameters != manifest.parameters:
            raise StoreError(
                f"{folder}: another run has begun another dataset there; choose another --out for "
                f"one"
            )
        if stored_manifest.complete:
            if manifest.complete:
                raise StoreError(
                    f"{folder}: another run has completed it with other bytes; give the same "
                    f"command again"
                )
            return


class _Head(Struct):
    """Entries that are read first, to distinguish other files and other versions from damaged
    files."""

    format: Any = None
    version: Any = None
    software: Any = None


def parse(content: bytes, folder: Path = Path(), named: str | None = None) -> Manifest:
    """Parse and check a manifest.

    Args:
        content: The file.
        folder: Its folder.
        named: A user's own kind that may be imported.

    Raises:
        BrokenError: if it is damaged. The message has the location, the value, and what was
            expected.
        NewerError: if a newer scenegen wrote it.
        DatasetError: if it is no manifest, or has an earlier format.
    """
    try:
        head = msgspec.json.decode(content, type=_Head)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise BrokenError(f"is no JSON of a dataset ({printable(error)[:200]})") from None
    if head.format != FORMAT:
        raise DatasetError(f'is not a scenegen dataset\'s, expected "format": "{FORMAT}"')
    version = head.version if isinstance(head.version, int | float) else 0
    if head.version != VERSION:
        if version > VERSION:
            raise NewerError(f"format version {short(head.version)}: this scenegen reads {VERSION}")
        raise DatasetError(
            f"format version {short(head.version)}: scenegen 0.3 reads {VERSION} alone; generate "
            "the dataset again, or read it with scenegen 0.2"
        )
    try:
        document = msgspec.json.decode(content, type=Document)
        values = {name: getattr(document, name) for name in Document.__struct_fields__}
        return Manifest(**values, folder=folder, named=named).check()
    except NewerError:
        raise
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError, BrokenError) as error:
        # msgspec appends the location; our messages begin with it
        fault = re.sub(r"^(.*) - at `\$\.?(.*)`$", r"\2: \1", printable(error))
    made_by = head.software.get("scenegen") if isinstance(head.software, dict) else None
    # an unknown entry in a file of a later version is no damage
    raise NewerError(fault) if _is_later(made_by) else BrokenError(fault)


def _is_later(version: Any) -> bool:
    """Whether a version of scenegen, as a manifest names it, is later than this one."""
    theirs, ours = (
        # bounded lengths, as the text is untrusted
        list(map(int, re.findall(r"[0-9]{1,9}", str(text)[:50])))
        for text in (version, __version__)
    )
    return theirs > ours


def load(folder: Path, name: str = "") -> Manifest:
    """Read the manifest of a folder.

    Args:
        folder: The folder.
        name: Name of the dataset in messages; by default the folder.

    Raises:
        DatasetError: if there is no manifest, it is damaged, or a newer scenegen wrote it.
    """
    path, content = f"{name or folder}: {NAME}", read_content(folder, name)
    try:
        return parse(content, folder)
    except NewerError as error:
        raise DatasetError(
            f"{path}: a newer scenegen wrote it: {error}; read it with that one"
        ) from None
    except BrokenError as error:
        fault = printable(error)[:300]
        raise DatasetError(
            f"{path} is damaged: {fault}; copy the dataset again, or generate it"
        ) from None
    except DatasetError as error:
        raise DatasetError(f"{path} {error}") from None


def read_content(folder: Place, name: str = "") -> bytes:
    """Read the bytes of a folder's manifest.

    Args:
        folder: The folder, or a store.
        name: Name of the dataset in messages; by default the folder.

    Raises:
        DatasetError: if there is no manifest, or it cannot be read.
    """
    try:
        return read_at(folder, NAME, MOST_MANIFEST_BYTES)
    except FileNotFoundError:
        path = Path(str(folder))
        problem = f"it has no {NAME}" if path.exists() else "there is no such folder"
        inner, siblings = (
            [str(near.parent) for near in parent.glob(f"*/{NAME}")]
            for parent in (path, path.parent)
        )
        # suggest a dataset inside the folder, or one with a similar name beside it
        for near in sorted(inner)[:1] or difflib.get_close_matches(str(folder), siblings, 1, 0.8):
            problem += f"; did you mean {near}?"
        raise DatasetError(
            f"{name or folder}: not a dataset, {problem}; make one with `scenegen generate`"
        ) from None
    except OSError as error:
        raise DatasetError(
            f"{name or folder}/{NAME}: cannot be read ({printable(error)[:200]})"
        ) from None


def total_digest(digests: Sequence[bytes]) -> str:
    """Digest of a dataset from the digests of its samples, 32 bytes each, in order."""
    return sha256_of(b"".join(digests))
