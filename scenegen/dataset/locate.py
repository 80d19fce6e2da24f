"""Where a dataset is: a folder as it stands, ``hf://user/name[@revision]``, downloaded from the
Hugging Face Hub, or a store, ``s3://bucket/folder``, of which files are fetched when they are
first opened."""

import contextlib
import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from scenegen.base.errors import DatasetError, StoreError, needs, printable
from scenegen.base.executors import LOCATED
from scenegen.base.files import sha256_in
from scenegen.base.limits import MOST_MANIFEST_BYTES
from scenegen.base.mirrors import fetch_all, make_mirror, note_files
from scenegen.base.stores import Store, is_remote
from scenegen.dataset import manifest
from scenegen.dataset.parameters import rays_digest
from scenegen.dataset.schema import NAME, pattern_of

os.environ.setdefault(
    "HF_HUB_DISABLE_TELEMETRY", "1"
)  # read when the Hub's client is imported, which is later

SCHEME = "hf://"
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)
REVISION = re.compile(r"[A-Za-z0-9][\w./-]{0,249}", re.ASCII)
TOKEN = re.compile(r"hf_(?:jwt_|oauth_)?[A-Za-z0-9][A-Za-z0-9.~+/=-]{7,}")
"""What a token for the Hub looks like."""
MANY = 1000
"""Files from which on they are asked for by patterns."""
TIMEOUT_S = 20.0
"""After which a silent Hub counts as out of reach, seconds."""


def parse(name: str) -> tuple[str, str | None]:
    """Repository and revision (None: the newest) of ``hf://user/name[@revision]``. Raises
    DatasetError."""
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


def locate(name: str | os.PathLike[str], *, shown: bool = False, whole: bool = False) -> Path:
    """The folder of a dataset on this machine. A path comes back as it is; only a name with a
    scheme is looked for.

    ``hf://…`` is downloaded: see `download`. Of a store the manifest is, into a mirror (see
    `scenegen.base.mirrors`), where each shard comes to lie when it is first opened, or all of them
    now, with `whole`. Raises DatasetError and StoreError.
    """
    if not is_remote(name):
        return Path(name)
    if str(name).startswith(SCHEME):
        found = download(str(name), shown=shown)
        commit = f"{SCHEME}{parse(str(name))[0]}@{found.name}"
        LOCATED[found] = locate_again, commit, found.name
        return found
    store = Store(str(name))
    try:
        content = store.read(NAME, MOST_MANIFEST_BYTES)
    except FileNotFoundError:
        raise DatasetError(
            f"{name}: not a dataset, it has no {NAME}; make one with `scenegen generate "
            f"--out {name}`"
        ) from None
    folder = make_mirror(store, NAME, content)
    document = manifest.load(folder, str(name))  # checked before its files are used as names
    note_files(folder, store, document.files)
    fetch_all(folder, document.files if whole else rays_digest(document.tables.lidar))
    LOCATED[folder] = locate_again, store.url, folder.name
    return folder


@cache
def locate_again(name: str, folder: str) -> Path:
    """`locate` on another machine, once a process. The manifest, after which the `folder` is
    called, must be the same; raises StoreError where it is not, and as `locate`."""
    found = locate(name)
    if found.name != folder:
        raise StoreError(
            f"{name}: has changed since the command was given; give the same command again"
        )
    return found


def download(name: str, *, shown: bool) -> Path:
    """The folder of a dataset on the Hub.

    What the Hub has is downloaded into the client's usual cache by revision, no file but those that
    the manifest lists, and held against the manifest's SHA-256s at every call; with `shown`, the
    client shows how far it has come. Raises DatasetError.
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
        with client_output(shown):
            _check_listing(repository, revision)
            folder = fetch(revision, NAME)
            listed = manifest.load(folder, name).files  # checked before they are used as names
            # the client holds every file against every name: of many, their patterns are enough
            names = listed if len(listed) < MANY else {*map(pattern_of, listed)}
            # by commit, whose name the folder bears: should the branch move on, nothing is mixed
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
def client_output(shown: bool) -> Iterator[None]:
    """Whether the Hub's client shows its progress; it never gives advice, which would be about
    itself."""
    from huggingface_hub.utils import logging
    from huggingface_hub.utils.tqdm import (
        are_progress_bars_disabled,
        disable_progress_bars,
        enable_progress_bars,
    )

    before, let_be = logging.get_verbosity(), shown or are_progress_bars_disabled()
    logging.set_verbosity_error()
    if not let_be:
        disable_progress_bars()
    try:
        yield
    finally:
        logging.set_verbosity(before)
        if not let_be:
            enable_progress_bars()


def check_files(folder: Path, files: dict[str, str], name: str) -> None:
    """Hold `files` (name to SHA-256) against what is in `folder`. Raises DatasetError naming the
    first that differs."""

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
    """The first paragraph of what the Hub's client says, and who says it, in one line and without
    any token: a server may repeat what it was sent."""
    said = without_tokens(str(error).split("\n\n")[0])
    return f"{type(error).__name__}: {said[:300]}" if said else type(error).__name__


def without_tokens(said: object) -> str:
    """What was said, as one printable line, without the user's token for the Hub and whatever else
    looks like one."""
    from huggingface_hub import get_token

    return TOKEN.sub("…", printable(said).replace(get_token() or "\0", "…"))


def _check_listing(repository: str, revision: str | None) -> None:
    """Refuse, before anything is downloaded, a repository without a manifest, or with one too large
    to be ours.

    Without network there is nothing to ask: the client then looks into its cache.
    """
    from huggingface_hub import HfApi, constants
    from huggingface_hub.errors import HfHubHTTPError

    if constants.HF_HUB_OFFLINE:
        return
    try:
        info = HfApi().dataset_info(
            repository, revision=revision, files_metadata=True, timeout=TIMEOUT_S
        )
    except HfHubHTTPError:
        raise
    except (
        Exception
    ):  # each version of the client has its own errors for a network that is not there
        return
    sizes = {file.rfilename: file.size or 0 for file in info.siblings or []}
    if NAME not in sizes:
        raise DatasetError(f"{SCHEME}{repository}: not a scenegen dataset, it has no {NAME}")
    if sizes[NAME] > MOST_MANIFEST_BYTES:
        raise DatasetError(
            f"{SCHEME}{repository}: its {NAME} has {sizes[NAME]} bytes; that is no manifest of ours"
        )
