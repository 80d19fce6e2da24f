"""What can be wrong with what a user gave. Every message is one line: what, where, what was
expected, how to fix it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from numbers import Integral
from typing import Any

from lidarsim.parameters import shown
from lidarsim.registry import own_line

short = shown
"""A stranger's value for an error's line."""
EXTRAS = {
    "gymnasium": "fly",
    "matplotlib": "view",
    "mcap": "mcap",
    "mcap_ros2": "mcap",
    "PIL": "view",
    "rerun": "rerun",
    "rosbags": "mcap",
    "safetensors": "train",
    "torch": "train",
}
"""Packages that are needed beyond the core, and the extra that brings each."""
MOST_REPEATED = 1000
"""Characters that an error's line repeats of another's, which may hold a stranger's text."""


class ScenegenError(Exception):
    """Base of every error that a user can act on; the command line prints it without a
    traceback."""

    code = 1
    """The exit code of a command that ends with it."""


class RecipeError(ScenegenError):
    """A recipe names an unknown parameter, or one that no world can have."""


class AskedError(RecipeError):
    """What was asked for does not go together."""


class SceneError(ScenegenError):
    """An MJCF document cannot serve as a world."""


class GenerationError(ScenegenError):
    """No acceptable world came out of the allowed number of draws."""


class DatasetError(ScenegenError):
    """A folder does not hold the dataset that it should, or cannot take it."""


class AbsentError(DatasetError, FileNotFoundError):
    """There is no file where one is to be read."""


class DiskError(DatasetError):
    """The disk refuses, whatever is written next."""


class BrokenError(DatasetError):
    """A file of a dataset is not as the format says, and cannot be looked at any further; the
    message is the fault."""


class NewerError(BrokenError):
    """A file names something that this scenegen does not know: a newer one may have written it."""


class StoreError(ScenegenError):
    """A store refuses, is full, or does not answer; nothing follows from it about what it holds."""


class PublishError(ScenegenError):
    """A dataset cannot be published as asked, or not to that place."""


class GuardError(ScenegenError):
    """A process that looked at a stranger's file crashed, took too long, or took too much
    memory."""


class StoppedError(ScenegenError):
    """The run was stopped from outside; what is finished stays."""


class UndecidedError(ScenegenError):
    """Nothing is wrong with a dataset, and whether it is what its recipe and seed give cannot be
    told here."""

    code = 3


class OwnCodeError(ScenegenError):
    """A user's own kind, sensor, engine, method or command fails; the message names the line."""


def plural(count: int, what: str) -> str:
    """A number of things, whose plural ends in s: "1 world", "2 worlds"."""
    return f"{count} {what.removesuffix('s') if count == 1 else what}"


def told(error: Exception) -> Exception:
    """`error`, or an OwnCodeError in its place where it came through code of the user's own."""
    line = "" if isinstance(error, ScenegenError) else own_line(error)
    return OwnCodeError(f"{line}: {type(error).__name__}: {printable(error)}") if line else error


@contextmanager
def raised_as(
    kind: Callable[[str], Exception],
    begin: str = "",
    end: str = "",
    *,
    of: type[Exception] | tuple[type[Exception], ...] = ValueError,
) -> Iterator[None]:
    """What the block raises as an error `of` some sorts comes out as one of another `kind`, its
    line between `begin` and `end`."""
    try:
        yield
    except of as error:
        raise kind(f"{begin}{printable(error)[:MOST_REPEATED]}{end}") from None


def whole_number(what: str, value: Any, least: int, most: int) -> int:
    """`value` as a number of Python's. Raises DatasetError for one that is not whole or out of
    bounds, of `what` is given."""
    number = isinstance(value, Integral) and not isinstance(value, bool)
    if not number or not least <= value <= most:
        raise DatasetError(f"{what} {short(value)}: expected a whole number from {least} to {most}")
    return int(value)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error of Python's, or of torch's, means that memory ran out."""
    known = ("not enough memory", "can't allocate memory", "out of memory")
    return isinstance(error, MemoryError) or any(text in str(error) for text in known)


def escaped(text: object) -> str:
    """`text` with every character that is not printable, line ends included, as its escape."""
    return "".join(char if char.isprintable() else ascii(char)[1:-1] for char in str(text))


def needs(packages: str, extra: str) -> str:
    """What to say where `packages` of our optional dependencies `extra` are not installed, and how
    to get them: of the file that scenegen was installed from, or in its checkout."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import unquote, urlsplit

    with suppress(PackageNotFoundError):
        origin = json.loads(distribution("scenegen-lidar").read_text("direct_url.json") or "{}")
        if "archive_info" in origin:
            path = unquote(urlsplit(origin["url"]).path)
            return f"needs {packages}: pip install '{path}[{extra}]'"
    return f"needs {packages}; in scenegen's checkout: pip install -e '.[{extra}]'"


def lacking(error: ModuleNotFoundError) -> str:
    """What to say of a package that is missing, if one of `EXTRAS` brings it; "" else."""
    package = str(error.name).partition(".")[0]
    return needs(package, EXTRAS[package]) if package in EXTRAS else ""


def empty_split(split: str) -> str:
    """What to say of a dataset whose `split` holds no samples, and how to get some."""
    option = "--n" if split == "train" else f"--{split}"
    return (
        f"its {split} split is empty; generate with {option} (scenes are split by world: give "
        "three or more)"
    )


def printable(text: object) -> str:
    """`text` as one line that a terminal shows as it is: line ends become spaces, control
    characters become escapes.

    Names, keys and messages may come from a stranger's file; raw, they could print lines of their
    own.
    """
    return escaped(" ".join(str(text).split()))
