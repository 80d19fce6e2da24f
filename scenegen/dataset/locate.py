"""Find the local folder of a dataset: a path as it is, ``hf://user/name[@revision]`` downloaded
from the Hugging Face Hub, or a mirror of a store, ``s3://bucket/folder``, whose files are fetched
on first use."""

import contextlib
import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from scenegen.base.errors import DatasetError, StoreError, needs, printable
from scenegen.base.executors import LOCATED
from scenegen.base.limits import MAX_MANIFEST_BYTES
from scenegen.base.mirrors import fetch_all, make_mirror, note_files
from scenegen.base.reading import sha256_in
from scenegen.base.stores import Store, is_remote
from scenegen.dataset import manifest
from scenegen.dataset.parameters import rays_digest
from scenegen.dataset.schema import NAME, pattern_of

# the Hub's client reads this when it is imported, which is later
os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")

SCHEME = "hf://"
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)
REVISION = re.compile(r"[A-Za-z0-9][\w./-]{0,249}", re.ASCII)
TOKEN = re.compile(r"hf_(?:jwt_|oauth_)?[A-Za-z0-9][A-Za-z0-9.~+/=-]{7,}")
"""Pattern of tokens for the Hub."""
MANY = 1000
"""Number of files from which on they are requested by patterns instead of names."""
TIMEOUT_S = 20.0
"""Timeout of the Hub, seconds."""


def parse(name: str) -> tuple[str, str | None]:
    """Split ``hf://user/name[@revision]``.

    Args:
        name: The URL.

    Returns:
        Repository, and revision or None for the newest.

    Raises:
        DatasetError: if the URL is malformed.
    """
    repository, at, revision = name.removeprefix(SCHEME).partition("@")
    if (
        not REPOSITORY.fullmatch(repository)
        or (at and not REVISION.fullmatch(revision))
        or ".." in name
    ):
        raise DatasetError(
            f"{name}: expected hf://user/name or hf://user/name@tag, such as hf://ada/pillar@v1"
        )
    return repository, revision or None


def locate(
    name: str | os.PathLike[str], *, show_progress: bool = False, whole: bool = False
) -> Path:
    """Find the local folder of a dataset. Paths are returned unchanged.

    ``hf://…`` is downloaded; see `download`. Of a store, only the manifest is fetched into a mirror
    (see `scenegen.base.mirrors`); shards follow on first use.

    Args:
        name: A path or a URL.
        show_progress: Whether a download shows its progress.
        whole: Whether all files of a store are fetched now.

    Raises:
        DatasetError: if there is no dataset.
        StoreError: if the store fails.
    """
    if not is_remote(name):
        return Path(name)
    if str(name).startswith(SCHEME):
        folder = download(str(name), show_progress=show_progress)
        commit = f"{SCHEME}{parse(str(name))[0]}@{folder.name}"
        LOCATED[folder] = locate_again, commit, folder.name
        return folder
    store = Store(str(name))
    try:
        content = store.read(NAME, MAX_MANIFEST_BYTES)
    except FileNotFoundError:
        raise DatasetError(
            f"{name}: not a dataset, it has no {NAME}; make one with `scenegen generate "
            f"--out {name}`"
        ) from None
    folder = make_mirror(store, NAME, content)
    # parsing checks the names of files, before they are used as paths
    document = manifest.load(folder, str(name))
    note_files(folder, store, document.files)
    fetch_all(folder, document.files if whole else rays_digest(document.tables.lidar))
    LOCATED[folder] = locate_again, store.url, folder.name
    return folder


@cache
def locate_again(name: str, folder: str) -> Path:
    """Call `locate` on another machine, once per process.

    Args:
        name: URL of the dataset.
        folder: Name of the first machine's folder, which identifies the manifest.

    Raises:
        StoreError: if the manifest has changed since. Errors of `locate` pass through.
    """
    located = locate(name)
    if located.name != folder:
        raise StoreError(
            f"{name}: has changed since the command was given; give the same command again"
        )
    return located


def download(name: str, *, show_progress: bool) -> Path:
    """Download a dataset from the Hub into the client's cache.

    Only files in the manifest are downloaded. They are compared with its SHA-256 sums at every
    call.

    Args:
        name: The URL.
        show_progress: Whether the client shows its progress.

    Returns:
        The folder of the revision.

    Raises:
        DatasetError: if the download fails, or a file differs.
    """
    repository, revision = parse(name)
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        raise DatasetError(f"{name}: {needs('huggingface_hub', 'publish')}") from None

    def fetch(revision: str | None, *files: str) -> Path:
        return Path(
            snapshot_download(
                repository, repo_type="dataset", revision=revision, allow_patterns=list(files)
            )
        )

    try:
        with client_output(show_progress):
            _check_listing(repository, revision)
            folder = fetch(revision, NAME)
            # parsing checks the names of files, before they are used as paths
            listed = manifest.load(folder, name).files
            # The client compares every file with every name, which is quadratic: patterns serve.
            names = listed if len(listed) < MANY else {*map(pattern_of, listed)}
            # the folder is named by its commit: files of a newer commit are not mixed in
            folder = fetch(folder.name, NAME, *names)
    except DatasetError:
        raise
    except Exception as error:  # whatever the Hub's client or the network beneath it raises
        raise DatasetError(
            f"{name}: {reason(error)}; check the name, the revision and the network"
        ) from None
    check_files(folder, listed, name)
    return folder


@contextlib.contextmanager
def client_output(show_progress: bool) -> Iterator[None]:
    """Show or hide the progress of the Hub's client. Its advice is always hidden."""
    from huggingface_hub.utils import logging
    from huggingface_hub.utils.tqdm import (
        are_progress_bars_disabled,
        disable_progress_bars,
        enable_progress_bars,
    )

    # the user's own settings of the client are restored afterwards
    verbosity, keep_bars = logging.get_verbosity(), show_progress or are_progress_bars_disabled()
    logging.set_verbosity_error()
    if not keep_bars:
        disable_progress_bars()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if not keep_bars:
            enable_progress_bars()


def check_files(folder: Path, files: dict[str, str], name: str) -> None:
    """Compare files with the manifest.

    Args:
        folder: The folder.
        files: SHA-256 of each file, by name.
        name: Name of the dataset, for messages.

    Raises:
        DatasetError: if a file is missing or differs.
    """

    from concurrent.futures import ThreadPoolExecutor  # for the Hub alone; importing it takes time

    def differs(name: str) -> bool:
        return not (folder / name).is_file() or file_sha256(folder / name) != files[name]

    with ThreadPoolExecutor() as pool:  # hashing lets other threads run
        for file, wrong in zip(files, pool.map(differs, files), strict=True):
            if wrong:
                raise DatasetError(
                    f"{name}: {file} is not the file that {NAME} lists; delete "
                    f"{folder.parents[1]} to download it anew, or ask its publisher"
                )


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return sha256_in(file)


def reason(error: BaseException) -> str:
    """Describe an error of the Hub's client in one line: its type and first paragraph, without
    tokens, which a server may echo."""
    message = without_tokens(str(error).split("\n\n")[0])
    return f"{type(error).__name__}: {message[:300]}" if message else type(error).__name__


def without_tokens(text: object) -> str:
    """Make one printable line without the user's token for the Hub, and without anything that looks
    like a token."""
    from huggingface_hub import get_token

    # \0 is in no printable line; an empty text would be found between all characters
    return TOKEN.sub("…", printable(text).replace(get_token() or "\0", "…"))


def _check_listing(repository: str, revision: str | None) -> None:
    """Check, before the download, that a repository has a manifest of possible size.

    Without network the check is skipped, and the client uses its cache.
    """
    from huggingface_hub import HfApi, constants
    from huggingface_hub.errors import HfHubHTTPError

    if constants.HF_HUB_OFFLINE:
        return
    try:
        info = HfApi().dataset_info(
            repository, revision=revision, files_metadata=True, timeout=TIMEOUT_S
        )
    # an answer of the Hub, such as no permission: the download would get it, too
    except HfHubHTTPError:
        raise
    except Exception:  # versions of the client raise different errors without a network
        return
    sizes = {file.rfilename: file.size or 0 for file in info.siblings or []}
    if NAME not in sizes:
        raise DatasetError(f"{SCHEME}{repository}: not a scenegen dataset, it has no {NAME}")
    if sizes[NAME] > MAX_MANIFEST_BYTES:
        raise DatasetError(
            f"{SCHEME}{repository}: its {NAME} has {sizes[NAME]} bytes; that is no manifest of ours"
        )
