"""Makes the folder that is published, from a dataset. It is complete and hashed before it gets its
final name.
"""

import datetime
import json
import os
import re
import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from lidarsim.parameters import short_repr
from scenegen import SPLITS, __version__
from scenegen.base.errors import DatasetError, PublishError, reraise_as
from scenegen.base.executors import commit
from scenegen.base.files import make_parent, real_path, whole_folder, write_atomic
from scenegen.dataset import manifest
from scenegen.dataset.like import check_same
from scenegen.dataset.locate import REPOSITORY, REVISION, file_sha256
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME, VERSION
from scenegen.dataset.selection import kept_measures, measures_file
from scenegen.publish import LICENCES, USUAL
from scenegen.publish.card import card, croissant, facts
from scenegen.view.inspect import inspect
from scenegen.view.look import evenly, looks
from scenegen.view.page import page
from scenegen.worlds.kinds import KINDS

SUMS = "SHA256SUMS"
"""File with digest and name of every other file, which `sha256sum --check` reads."""
MAX_FILES = 100_000
"""Maximum number of shards and archives. The Hub advises against repositories with more files."""
MAX_LISTED = 300
"""Maximum number of files with an entry each in Croissant; the manifest always has all digests."""
SHOWN = 4
"""Number of samples with a picture in the card."""
PAGE, ON_PAGE = "look.html", 12
"""Name of the page that shows samples, and how many it shows."""
ABOVE = """Above, from left to right: returns, observed voxels, occupied voxels, in the map's box; \
below: three levels of the distances to the nearest occupied voxel. The red ball is the sensor."""
LICENCE = """This dataset, published by {owner}, is licensed under

    {licence}
    SPDX-License-Identifier: {spdx}
    {licence_url}

The full text at this address is what counts. The files are provided as they are, without any \
warranty.
"""


@dataclass(frozen=True, kw_only=True)
class Request:
    """A dataset to publish, and where."""

    dataset: Path
    """Folder of the dataset."""
    repository: str
    """The repository on the Hub, as user/name."""
    out: Path
    """The folder to make."""
    tag: str | None = None
    """Name of the revision. None: the format's version and the first digits of the digest."""
    licence: str = USUAL
    """SPDX name of the data's licence, in upper or lower case."""
    kind: str | None = None
    """The dataset's kind as ``module:Class``, which allows to import that module."""

    def __post_init__(self) -> None:
        known = {name.lower(): name for name in LICENCES}
        licence = known.get(self.licence.lower())
        if licence is None:
            raise PublishError(f"--licence {self.licence}: expected one of {', '.join(LICENCES)}")
        object.__setattr__(self, "licence", licence)  # in SPDX's own case
        if not REPOSITORY.fullmatch(self.repository) or re.search(
            r"--|\.\.|[.-](/|$)|\.git$", self.repository
        ):
            raise PublishError(f"--repo {self.repository}: expected user/name, such as ada/pillar")
        if self.tag is not None and (not REVISION.fullmatch(self.tag) or ".." in self.tag):
            raise PublishError(
                f"--tag {self.tag}: expected letters, digits and . _ - /, such as v1"
            )


@dataclass(frozen=True, kw_only=True)
class Staged:
    """A folder that is ready to be sent."""

    folder: Path
    """The folder."""
    repository: str
    """The repository on the Hub, as user/name."""
    tag: str
    """Name of the revision."""
    files: dict[str, int]
    """Size of every file in bytes, by its name in the folder."""
    digest: str
    """Digest of the dataset."""


def examine(request: Request) -> Dataset:
    """Open the dataset, and check all that can be checked without reading its samples.

    Args:
        request: The request.

    Returns:
        The dataset.

    Raises:
        DatasetError: The dataset is damaged.
        PublishError: The dataset cannot be published, or not into this folder.
    """
    dataset = Dataset(request.dataset)
    check_out(request.dataset, request.out)
    if (files := len(dataset.manifest.files)) > MAX_FILES:
        raise PublishError(
            f"{request.dataset}: has {files} files, more than the {MAX_FILES} that publish takes; "
            "generate it again with a larger --shard-samples, which changes no sample"
        )
    described = dataset.manifest
    if described.like is None:
        _check_kind(described.kind, request.kind)
    if not described.noise_is_ours:
        raise PublishError(
            f"its noise, {short_repr(described.noise_stages)}, has stages of a user's own; "
            "publish does "
            "not import them, and so cannot say whether its command makes the same ranges again"
        )
    if request.kind is not None:
        described = manifest.parse(
            manifest.read_content(request.dataset), request.dataset, request.kind
        )
    # the command on the card must make the same dataset, which takes the same versions
    with reraise_as(PublishError, of=DatasetError):
        check_same(described, str(request.dataset))
    return dataset


def _check_kind(kind: str, named: str | None) -> None:
    """Raise PublishError for a kind of a user's own module, unless the user `named` it: a module is
    never imported because a manifest names it."""
    if kind != "scene" and kind not in KINDS.builtin and kind != named:
        raise PublishError(
            f"the dataset's kind, {short_repr(kind)}, is a user's own, and only its module can say "
            "whether the recipe makes the same worlds again; give --kind with its name to have it "
            "imported"
        )


def _environment_lock(described: Manifest) -> str:
    """Return a requirements file with the packages that made the dataset's numbers.

    scenegen itself is only in a comment: it is installed from its own source, and a package index
    might have another package of its name.
    """
    versions = dict(described.software)
    lines = [f"# scenegen {versions.pop('scenegen', __version__)}, published with {__version__}"]
    lines.append(f"# {versions.pop('machine', 'unknown machine')}, commit {commit()}")
    lines += [f"{name}=={version}" for name, version in sorted(versions.items())]
    return "\n".join([*lines, ""])


def stage(request: Request, checks: tuple[tuple[str, str], ...]) -> Staged:
    """Make the folder: shards and worlds, manifest, pictures, card, Croissant, requirements,
    licence and checksums. The same request gives the same bytes.

    Args:
        request: The request.
        checks: Name and detail of each check that the dataset passed.

    Returns:
        The folder and its files.

    Raises:
        DatasetError: The dataset is damaged.
        PublishError: The dataset cannot be published, or not into this folder.
    """
    dataset = examine(request)
    described, digest = dataset.manifest, str(dataset.manifest.digest)
    content = (request.dataset / NAME).read_bytes()
    tag = request.tag or f"v{VERSION}-{digest[:8]}"
    with whole_folder(request.out, partial(check_out, request.dataset)) as draft:
        take(request.dataset, draft, described.files)
        write_atomic(draft / NAME, content)
        if kept_measures(dataset):
            figures = measures_file(dataset)
            write_atomic(draft / figures.name, figures.read_bytes())
        listed = {NAME: file_sha256(draft / NAME)}
        sums = described.files | listed
        # of the draft, so that the card describes the files that are sent
        summary = inspect(Dataset(draft))
        values = facts(
            described,
            summary,
            request.repository,
            request.licence,
            tag=tag,
            date=former_date(request.out, content)
            or datetime.datetime.now(datetime.UTC).date().isoformat(),
            checks=checks,
            pictures=_draw(dataset, draft),
        )
        texts = {
            "README.md": card(values),
            "croissant.json": croissant(
                values, described, summary, sums if len(sums) <= MAX_LISTED else listed
            ),
            "LICENSE": LICENCE.format(spdx=request.licence, **values),
            "requirements.lock.txt": _environment_lock(described),
        }
        for file, text in texts.items():
            write_atomic(draft / file, text.encode())
        sizes = seal(draft, sums)
    return Staged(
        folder=request.out, repository=request.repository, tag=tag, files=sizes, digest=digest
    )


def _draw(dataset: Dataset, draft: Path) -> str:
    """Draw a few samples, if matplotlib is installed, and write a page of some more, if their grid
    is not too large. Return Markdown that shows both in the card."""
    split = next(name for name in SPLITS if len(dataset.split(name)))
    samples, notes = looks(dataset, split, evenly(len(dataset.split(split)), ON_PAGE))
    parts = []
    if find_spec("matplotlib") is not None:
        from scenegen.view.stills import draw, to_bytes

        (draft / "pictures").mkdir()
        for number, look in enumerate(
            looks(dataset, split, evenly(len(dataset.split(split)), SHOWN))[0]
        ):
            name = f"pictures/{split}-{number}.png"
            write_atomic(draft / name, to_bytes(draw([look]), ".png"))
            parts.append(f"![{look.name}]({name})")
        parts.append(ABOVE)
    with suppress(DatasetError):  # a grid that is too large
        text = page(samples, title=f"{dataset.kind}, {split}", notes=notes)
        write_atomic(draft / PAGE, text.encode())
        parts.append(
            f"Samples in three dimensions: download [{PAGE}]({PAGE}), and open it in a browser."
        )
    return "\n\n".join(parts)


def check_out(dataset: Path, out: Path) -> None:
    """Check that a folder may be written or replaced.

    Args:
        dataset: Folder of the dataset.
        out: The folder to write.

    Raises:
        PublishError: `out` is a file, overlaps the dataset, or has another dataset, or files that
            publish did not write.
    """
    if out.exists() and not out.is_dir():
        raise PublishError(f"--out {out}: is there, and not a folder; give another name")
    target, source = real_path(out), real_path(dataset)
    if target.is_relative_to(source) or source.is_relative_to(target):
        raise PublishError(f"--out {out}: overlaps the dataset; choose another folder")
    files = (path for path in out.rglob("*") if path.is_symlink() or not path.is_dir())
    # links count as files: what they lead to is not ours
    foreign = {str(path.relative_to(out)) for path in files}
    # an earlier run listed its files; without a readable list, no file is ours to replace
    with suppress(DatasetError, OSError, UnicodeDecodeError):
        manifest.read_content(out)
        foreign -= {SUMS, *read_sums(out)}
    if foreign:
        raise PublishError(
            f"--out {out}: holds {min(foreign)}, which publish did not put there; choose another "
            "folder"
        )
    if (out / NAME).exists():
        # one that has grown, or was made with other noise, replaces what was published before
        held, asked = (
            f"{about.kind}, seed {about.seed}" for about in map(manifest.load, (out, dataset))
        )
        if held != asked:
            raise PublishError(f"--out {out}: holds {held}; remove it, or choose another folder")


def read_sums(folder: Path) -> dict[str, str]:
    """Read the digests that `SUMS` lists, by the names of files."""
    lines = (folder / SUMS).read_text(encoding="utf-8").splitlines()
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def take(source: Path, draft: Path, names: Mapping[str, str]) -> None:
    """Link files of a dataset into a folder, or copy them to another disk, and check their digests.

    Args:
        source: Folder of the dataset.
        draft: The folder.
        names: SHA-256 of each file, by its name.

    Raises:
        PublishError: A file is missing, or has another digest.
    """

    def copy_checked(name: str) -> None:
        """Link or copy a file.

        Raises:
            PublishError: It is missing, or has another digest.
        """
        # the file behind a link, as the folder to send must hold no links
        original, copy = real_path(source / name), draft / name
        make_parent(copy)
        if original.is_file():
            try:
                # a hard link takes no space on the disk
                os.link(original, copy)
            except OSError:  # another disk, or links are not allowed
                shutil.copyfile(original, copy)
        if not original.is_file() or file_sha256(copy) != names[name]:
            raise PublishError(
                f"{source / name}: is not the file that {NAME} lists; generate it again"
            )

    with ThreadPoolExecutor() as pool:
        # a list: an error in a thread is raised only when its result is taken
        list(pool.map(copy_checked, names))


def seal(draft: Path, known: Mapping[str, str]) -> dict[str, int]:
    """Write `SUMS` for all files of a folder.

    Args:
        draft: The folder.
        known: SHA-256 of files that need not be read again, by name.

    Returns:
        Size of every file in bytes, by name.
    """
    names = sorted(str(path.relative_to(draft)) for path in draft.rglob("*") if path.is_file())
    # two spaces: the format of sha256sum, which checks the folder without scenegen
    lines = [f"{known.get(name) or file_sha256(draft / name)}  {name}\n" for name in names]
    write_atomic(draft / SUMS, "".join(lines).encode())
    return {name: (draft / name).stat().st_size for name in [*names, SUMS]}


def former_date(out: Path, content: bytes) -> str | None:
    """Return the date of publication in an existing folder of the same dataset.

    A run after a stop keeps this date, so that its files are those that the stopped run sent.

    Args:
        out: The folder.
        content: Content of the dataset's manifest.

    Returns:
        YYYY-MM-DD; None if the folder does not exist, or has another dataset.
    """
    with suppress(OSError, ValueError, KeyError, TypeError):
        if (out / NAME).read_bytes() == content:
            return str(json.loads((out / "croissant.json").read_bytes())["datePublished"])
    return None
