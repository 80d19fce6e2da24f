"""Stores: where a dataset lies that lies in no folder, by a name with a scheme. One file a store;
each fills `Store`.

A store has no rename and no locks. What it promises instead: an object is complete or absent, and
it can be put on the condition that nobody else put one meanwhile. `StorePath` is how the code of
datasets sees it.
"""

import io
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, Any, NamedTuple, Protocol

from lidarsim.registry import Registry
from scenegen.errors import DatasetError, StoreError, printable

LOCATED: dict[Path, tuple[Any, ...]] = {}
"""Folders of this machine that were found by a name with a scheme: for each, a function that finds
it on another machine, and what that takes."""
Version = str | None
"""What tells two contents of an object apart; None where there is no object."""
ANY: Version = "*"
"""Stands for any version, or none."""
REMOTE = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]*)://(?P<rest>.*)", re.ASCII | re.DOTALL)
ONE_SLASH = re.compile(r"(hf|s3|gs|az|https?):/(?!/)")
"""What was meant for a store, and would be a folder of an odd name."""


PART = re.compile(r"(train|val|test)-[0-9]+x+", re.ASCII)
"""What the folders in a dataset's are called, of which each holds a thousand shards."""


def home_of(folder: Path) -> Path:
    """The dataset's own folder: this one, or the one that it is a part of."""
    return folder.parent if PART.fullmatch(folder.name) else folder


def note_file(folder: Path) -> Path:
    """Where the note lies that makes a dataset's folder one of copies; see
    `scenegen.stores.cache`."""
    return Path(f"{home_of(folder)}.place")


class ConflictError(StoreError):
    """An object is no longer, or not yet, what it was taken for: somebody else put one."""


class Object(NamedTuple):
    """An object of a store, as a listing has it."""

    name: str
    bytes: int
    version: Version


class Part(NamedTuple):
    """A part of an object, in bytes."""

    first: int = 0
    """Where it begins; below 0, so many before the object's end."""
    stop: int | None = None
    """Where it ends, if not with the object."""


WHOLE = Part()


class Store(Protocol):
    """A folder of objects, made of its whole name. Raises DatasetError for a name that cannot
    be.

    Every method raises StoreError, in one line that tells no credential, where the store refuses,
    is full, or does not answer in good time; a first failure is tried again. A store for reading
    alone raises it in the last three.
    """

    def __init__(self, name: str) -> None: ...

    def list(self) -> Iterator[Object]:
        """The objects in it, and in folders in it, in any order, as they come."""
        ...

    def read(self, name: str, file: IO[bytes], most_bytes: int, part: Part = WHOLE) -> Object:
        """Copy an object into `file`, or a part of it, and return which object it is. Raises
        FileNotFoundError where there is none, DatasetError where what is asked for is larger."""
        ...

    def put(self, name: str, content: bytes, version: Version = ANY) -> Version:
        """Put an object, complete or not at all, if it is `version` still; `ANY` stands for
        whatever is there. Raises ConflictError otherwise."""
        ...

    def remove(self, name: str) -> None:
        """Remove an object, if it is there."""
        ...


OTHERS = "fsspec"
"""What reads the stores that are not named below."""
STORES = Registry(
    "store", {"s3": "scenegen.stores.bucket:Bucket", OTHERS: "scenegen.stores.bucket:Foreign"}
)
"""Stores by the scheme of their names, each a `Store`."""


def is_remote(name: object) -> bool:
    """Whether `name` stands for a store. A Path never does, whatever it looks like, unless it is a
    `StorePath`."""
    return isinstance(name, StorePath) or (isinstance(name, str) and REMOTE.match(name) is not None)


def folder_of(name: str) -> Path:
    """What a name stands for that a user gave for a dataset's folder: a store where it begins with
    a scheme, a path otherwise. Raises DatasetError for a name that cannot be."""
    if not is_remote(name):
        if ONE_SLASH.match(name):
            raise DatasetError(
                f"{printable(name)}: expected two slashes, {printable(name.replace('/', '//', 1))}"
            )
        return Path(name)
    store_of(name)
    return StorePath(name)


def store_of(name: str) -> Store:
    """The store called `name`, opened once a process. Raises DatasetError for a name that cannot
    be."""
    return _opened(name, os.getpid())  # connections do not survive a fork


@lru_cache(maxsize=64)
def _opened(name: str, process: int) -> Store:
    match = REMOTE.fullmatch(name)
    assert match is not None
    scheme, rest = match["scheme"], match["rest"]
    if "@" in rest.partition("/")[0]:
        raise DatasetError(
            f"{scheme}://…@…: a name holds no credentials; give them as docs/stores.md says"
        )
    if (
        {"", ".", ".."} & {*rest.rstrip("/").split("/")}
        or not rest.isprintable()
        or len(name) > 1000
    ):
        raise DatasetError(f"{printable(name)[:200]}: expected a name such as s3://bucket/folder")
    return STORES.find(scheme if scheme in STORES.builtin else OTHERS)(name)


_seen: dict[str, Version] = {}
"""Versions of objects that this process has read or put, by their whole names: it replaces no
others."""

if TYPE_CHECKING:
    _Path = Path
else:
    _Path = PurePosixPath  # so that what is not written below fails, and never reaches for a file


class StorePath(_Path):
    """A store, or an object in it, in the stead of a Path: it has those methods of Path that
    datasets are written by.

    What is put replaces only what this process has read before; see `Store.put`.
    """

    def __str__(self) -> str:
        return PurePosixPath.__str__(self).replace(":/", "://", 1)

    @property
    def store(self) -> Store:
        """The store that it is."""
        return store_of(str(self))

    def _home(self) -> tuple[Store, str]:
        """The store of the dataset's folder, and what the object is called there."""
        folder = home_of(self.parent)
        return store_of(str(folder)), str(self.relative_to(folder))

    def mkdir(self, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        """Nothing: there are no folders."""

    def open_bounded(self, most_bytes: int) -> io.BufferedReader:
        """A copy of the object on this disk, that nobody else sees. Raises as `Store.read`."""
        copy: Any = None
        try:
            copy = tempfile.TemporaryFile()  # noqa: SIM115 (who asks closes it)
            store, name = self._home()
            _seen[str(self)] = store.read(name, copy, most_bytes).version
            copy.seek(0)
            return io.BufferedReader(copy.detach())
        except OSError as error:
            if copy is not None:
                copy.close()
                if isinstance(error, FileNotFoundError):  # a full disk raises it, too, before
                    raise
            told = error.strerror or type(error).__name__
            raise StoreError(
                f"{self}: cannot be copied to this machine's temporary folder ({told}); free some "
                "space there"
            ) from None

    def read_bytes(self) -> bytes:
        """Its content."""
        with self.open_bounded(1 << 62) as file:
            return file.read()

    def put(self, content: bytes) -> None:
        """Put `content` there, unless somebody else put something else: that raises
        ConflictError."""
        mine, (store, name) = self.version, self._home()
        with suppress(ConflictError):
            _seen[str(self)] = store.put(name, content, mine)
            return
        with suppress(FileNotFoundError):
            if self.read_bytes() == content:
                return
        _seen[str(self)] = mine
        raise ConflictError(
            f"{self}: somebody else has put other bytes there; end other runs that write there, "
            "remove the object if there are none, and give the same command again to go on"
        )

    @property
    def version(self) -> Version:
        """What this process last read or put there."""
        return _seen.get(str(self))

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the object, if it is there."""
        store, name = self._home()
        store.remove(name)
        _seen.pop(str(self), None)
