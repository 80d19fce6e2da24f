"""Stores: remote places for datasets, named by a URL.

A `Store` has six operations on whole files, over fsspec. Datasets are written to a `Location`, a
folder or a store. They are read from folders; a store's files are mirrored (see
`scenegen.base.mirrors`).
"""

import base64
import errno
import hashlib
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from scenegen.base.errors import (
    DatasetError,
    ScenegenError,
    StoreError,
    needs,
    printable,
)
from scenegen.base.files import list_dir, write_atomic
from scenegen.base.reading import read_bounded

REMOTE = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]*)://(?P<rest>.*)", re.ASCII | re.DOTALL)
ONE_SLASH = re.compile(r"(hf|s3|gs|az|https?):/(?!/)")
"""A URL with one slash missing, which would otherwise be a folder."""
BUCKET = re.compile(r"s3://[a-z0-9][a-z0-9.-]{1,61}[a-z0-9](/.*)?", re.ASCII)
WRITTEN = "s3"
"""Scheme of the stores that can be written. Others are read-only: their conditional puts are not
known."""

ATTEMPTS = 11
"""Maximum number of attempts of a request whose answer is lost or reports a server error: about
half a minute."""
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR)
"""Errors of the local disk."""
DOWNLOADS = 4
"""How often s3fs tries a download that is truncated."""
CONNECT_S, READ_S = 5, 30
"""Timeouts of a connection and of an answer, seconds."""
AGAIN = "what is finished is kept: give the same command again to go on"
"""Advice after an error that may pass."""
REREADS = 10
"""How often an object is read that others replace meanwhile."""
CONFLICT = (
    "somebody else has put other bytes there; end other runs that write there, remove the object "
    "if there are none, and give the same command again to go on"
)
"""Advice after a conflicting write."""
FAULTS = {
    r"\d+ (ConditionalRequestConflict|PreconditionFailed)|(409|412) .*": CONFLICT,
    r"\d+ NoSuchBucket": "there is no such bucket; make it, or name one that is there",
    r"404 .*": "nothing is there that speaks S3's protocol; see to AWS_ENDPOINT_URL",
    r"\d+ (QuotaExceeded|XMinioStorageFull|InsufficientCapacity|StorageLimitExceeded)"
    r"|\d+ NotEnoughSpace|507 .*": "the store is full; free some space, or raise "
    f"its quota; {AGAIN}",
    r"\d+ (ExpiredToken(Exception)?|InvalidToken|TokenRefreshRequired|RequestExpired)"
    r"|(401|403) .*|PermissionError": "the store refuses the credentials; renew them, or what they "
    f"allow; {AGAIN}",
    r"[A-Za-z]*(Credential|Token|Profile|SSO|Login)[A-Za-z]*": "no credentials are found; set "
    "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or log in by Amazon's tools",
    "ValueError|InvalidRegionError|ConfigParseError|ConfigNotFound|InvalidConfigError": "a setting "
    "of AWS cannot be used; see to AWS_ENDPOINT_URL, AWS_DEFAULT_REGION and the file of "
    "AWS_CONFIG_FILE",
    ".*": f"the store does not answer; see to the network and the server; {AGAIN}",
}
"""Advice by the status and code of an answer, or the class of an exception. The first pattern that
matches counts."""


class ConflictError(StoreError):
    """Another process put an object in the meantime."""


class Store:
    """A folder of objects, such as ``s3://bucket/folder``.

    Each object is complete or absent. Every operation raises StoreError, in one line without
    credentials, if the store refuses, is full, or does not answer in time. Stores of other schemes
    than s3 are read-only: put, create, replace and remove raise StoreError.

    Args:
        url: The URL.

    Raises:
        DatasetError: if `url` is not a store's, or holds credentials.
    """

    def __init__(self, url: str):
        match = REMOTE.fullmatch(url)
        assert match is not None, url
        scheme, path = match["scheme"], match["rest"].rstrip("/")
        if "@" in path.partition("/")[0]:
            raise DatasetError(
                f"{scheme}://…@…: a name holds no credentials; give them as docs/cluster.md says"
            )
        if (
            {"", ".", ".."} & {*path.split("/")}
            or not path.isprintable()
            or len(url) > 1000
            or (scheme == WRITTEN and not BUCKET.fullmatch(url))
        ):
            raise DatasetError(
                f"{printable(url)[:200]}: expected a name such as s3://bucket/folder, where bucket "
                "has 3 to 63 lower-case letters, digits, dots or hyphens"
            )
        self.url = f"{scheme}://{path}"
        self._written = scheme == WRITTEN
        self._versions: dict[str, str | None] = {}
        """ETags of the objects that were read or put, by name."""

    def __str__(self) -> str:
        return self.url

    def __reduce__(self) -> Any:
        return Store, (self.url,)

    def list(self) -> dict[str, int]:
        """Sizes of all objects, bytes, by name; those in subfolders included."""

        def _find(system: Any, path: str) -> dict[str, int]:
            files = system.find(path, detail=True)
            # a folder that others begin to fill meanwhile is listed as itself
            return {
                name.removeprefix(path).lstrip("/"): int(info["size"] or 0)
                for name, info in files.items()
                if info["type"] == "file"
            }

        try:
            return self._ask("", _find)
        except FileNotFoundError:
            return {}

    def read(self, name: str, max_bytes: int) -> bytes:
        """Read an object.

        Args:
            name: The object.
            max_bytes: Largest allowed size.

        Raises:
            FileNotFoundError: if there is no such object.
            DatasetError: if it is larger.
        """

        def _read(system: Any, path: str) -> tuple[bytes, str | None]:
            with system.open(path, "rb") as file:
                details = getattr(file, "details", None) or {}
                return file.read(max_bytes + 1), details.get("ETag")

        self._versions.pop(name, None)
        for attempt in range(REREADS):
            try:
                content, version = self._ask(name, _read)
                break
            except ConflictError:  # it was replaced after the request for its version
                if attempt == REREADS - 1:
                    raise
        if len(content) > max_bytes:
            raise DatasetError(f"{self}/{name}: more than {max_bytes} bytes")
        self._versions[name] = version
        return content

    def fetch(self, name: str, path: Path) -> None:
        """Copy an object to a local file.

        Args:
            name: The object.
            path: The file. Its folder must exist.

        Raises:
            FileNotFoundError: if there is no such object.
        """

        def _get(system: Any, source: str) -> None:
            # fsspec's FileNotFoundError would look like a missing object
            if not path.parent.is_dir():
                raise NotADirectoryError(errno.ENOTDIR, f"{path.parent} is gone")
            system.get_file(source, str(path))

        self._ask(name, _get)

    def create(self, name: str, content: bytes) -> None:
        """Put a new object. An existing one with the same content is accepted.

        Args:
            name: The object.
            content: The bytes.

        Raises:
            ConflictError: if the object exists with other content.
        """
        try:
            self._put(name, content, IfNoneMatch="*")
        except ConflictError:
            # a retry of a request whose answer was lost meets our own object
            with suppress(FileNotFoundError, DatasetError):
                if self.read(name, len(content)) == content:
                    return
            raise

    def replace(self, name: str, content: bytes) -> None:
        """Put an object in place of the version that this `Store` read or put last; if there is
        none, create it.

        Args:
            name: The object.
            content: The bytes.

        Raises:
            ConflictError: if the object has changed since.
        """
        version = self._versions.get(name)
        if version is None:
            self._put(name, content, IfNoneMatch="*")
            return
        try:
            self._put(name, content, IfMatch=version)
        except ConflictError:  # Ceph of 2021 compares versions without their quotation marks
            self._put(name, content, IfMatch=version.strip('"'))

    def put(self, name: str, content: bytes) -> None:
        """Put an object unconditionally.

        Args:
            name: The object.
            content: The bytes.
        """
        self._put(name, content)

    def remove(self, name: str) -> None:
        """Remove an object if it exists."""
        self._check_written()
        with suppress(FileNotFoundError):
            self._ask(name, lambda system, path: system.rm_file(path))
        self._versions.pop(name, None)

    def _put(self, name: str, content: bytes, **condition: str) -> None:
        self._check_written()
        # with a checksum, the server refuses content that was corrupted in transit
        digest = hashlib.md5(content, usedforsecurity=False).digest()
        headers = {"ContentMD5": base64.b64encode(digest).decode(), **condition}

        def _put_file(system: Any, path: str) -> str:
            # in one request, however large it is; a page to log in at answers without ETag
            return system.pipe_file(path, content, chunksize=1 << 40, **headers)["ETag"]

        self._versions[name] = self._ask(name, _put_file)

    def _check_written(self) -> None:
        if not self._written:
            raise StoreError(
                f"{self}: is for reading alone; write to a folder, or to s3://bucket/folder"
            )

    def _ask(self, name: str, ask: Callable[[Any, str], Any]) -> Any:
        """Call `ask` with the file system and the path of object `name`; translate its errors."""
        system, home = _connect(self.url, os.getpid())
        try:
            return ask(system, f"{home}/{name}".rstrip("/"))
        except ScenegenError:
            raise
        except Exception as error:  # each file system has its own
            code, url = _code_of(error), f"{self}/{name}".rstrip("/")
            if isinstance(error, FileNotFoundError) and "NoSuchBucket" not in code:
                raise FileNotFoundError(url) from None
            # a code that begins with a letter is no server's answer, so the disk is this machine's
            if isinstance(error, OSError) and error.errno in DISK_ERRORS and code[0].isalpha():
                raise StoreError(
                    f"{url}: cannot be copied to this machine ({error.strerror}); free some "
                    "space, or name another folder by SCENEGEN_CACHE or TMPDIR"
                ) from None
        # Only the code of an answer is repeated: its text may echo the request with its signature.
        advice = next(text for pattern, text in FAULTS.items() if re.fullmatch(pattern, code))
        reason, _, fix = advice.partition(";")
        kind = ConflictError if advice is CONFLICT else StoreError
        raise kind(f"{url}: {reason} ({code});{fix}")


def _code_of(error: Exception) -> str:
    """Status and code of a server's answer, or the name of the exception's class."""
    answer = getattr(error.__cause__ or error, "response", None)
    if not isinstance(answer, dict):
        return type(error).__name__
    code = re.sub(r"[^A-Za-z0-9]", "", str(answer.get("Error", {}).get("Code")))
    status = answer.get("ResponseMetadata", {}).get("HTTPStatusCode", 0)
    return f"{status} {code[:60]}"


@lru_cache(maxsize=64)
def _connect(url: str, process: int) -> tuple[Any, str]:
    """Connect to a store. Cached per process, because connections do not survive a fork.

    Args:
        url: The store.
        process: Process id, as a key of the cache.

    Returns:
        The file system, and the store's path in it.
    """
    scheme, options = url.partition("://")[0], dict[str, Any]()
    if scheme == WRITTEN:
        config: dict[str, Any] = {
            "retries": {"mode": "standard", "max_attempts": ATTEMPTS},
            "connect_timeout": CONNECT_S,
            "read_timeout": READ_S,
            # servers of earlier years know no other checksum than MD5
            "request_checksum_calculation": "when_required",
            "response_checksum_validation": "when_required",
        }
        # a server of one's own seldom has a host name for each bucket, as Amazon has
        if any(os.environ.get(name) for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3")):
            config["s3"] = {"addressing_style": "path"}
        # other jobs put objects meanwhile: no listing may come from a cache
        options = {"config_kwargs": config, "max_concurrency": 1, "use_listings_cache": False}
    try:
        import fsspec

        system, path = fsspec.core.url_to_fs(url, skip_instance_cache=True, **options)
    except (ValueError, ImportError, OSError) as error:
        if scheme == WRITTEN:
            raise DatasetError(f"{url}: {needs('s3fs', 's3')}") from None
        raise DatasetError(
            f"{url}: fsspec has nothing here that reads it ({type(error).__name__}); give a "
            "folder, hf://user/name or s3://bucket/folder"
        ) from None
    system.retries = DOWNLOADS
    return system, path


Location = Path | Store
"""Location of a dataset: a local folder, or a store."""


def is_remote(name: object) -> bool:
    """Whether `name` is a string with a scheme. A Path never is."""
    return isinstance(name, str) and REMOTE.match(name) is not None


def location_of(name: str) -> Location:
    """Make a `Location` of a name that a user gave.

    Raises:
        DatasetError: if the URL is malformed.
    """
    if is_remote(name):
        return Store(name)
    if ONE_SLASH.match(name):
        raise DatasetError(
            f"{printable(name)}: expected two slashes, {printable(name.replace('/', '//', 1))}"
        )
    return Path(name)


def names_at(location: Location) -> Mapping[str, int | None]:
    """Names of a dataset's files, with their sizes in bytes at a store."""
    return location.list() if isinstance(location, Store) else dict.fromkeys(list_dir(location))


def read_at(location: Location, name: str, max_bytes: int) -> bytes:
    """Read a file of a dataset.

    Args:
        location: The dataset's location.
        name: The file.
        max_bytes: Largest allowed size.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if it is larger.
    """
    if isinstance(location, Store):
        return location.read(name, max_bytes)
    return read_bounded(location / name, max_bytes)


def create_at(location: Location, name: str, content: bytes) -> None:
    """Write a file of a dataset.

    Args:
        location: The dataset's location.
        name: The file.
        content: The bytes.

    Raises:
        ConflictError: if a store holds the file with other content.
    """
    if isinstance(location, Store):
        location.create(name, content)
    else:
        write_atomic(location / name, content)


def remove_at(location: Location, name: str) -> None:
    """Remove a file of a dataset if it exists.

    Args:
        location: The dataset's location.
        name: The file.
    """
    if isinstance(location, Store):
        location.remove(name)
    else:
        (location / name).unlink(missing_ok=True)
