"""Errors that a user can act on. Each message is one line: the thing, the value, what was expected,
and the fix."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from numbers import Integral
from typing import Any

from lidarsim.parameters import short_repr
from lidarsim.registry import own_line

EXTRAS = {
    "gymnasium": "fly",
    "matplotlib": "view",
    "mcap": "mcap",
    "mcap_ros2": "mcap",
    "PIL": "view",
    "rerun": "rerun",
    "rosbags": "mcap",
    "safetensors": "train",
    "small_gicp": "align",
    "torch": "train",
}
"""Optional packages, and the extra of scenegen that installs each."""
MAX_REPEATED = 1000
"""Maximum length of another error's text that is repeated in ours, characters: it may quote a
user's file."""


class ScenegenError(Exception):
    """Base of all errors that a user can act on. The command line prints them without traceback."""

    code = 1
    """Exit code of a command that ends with this error."""


class RecipeError(ScenegenError):
    """A recipe has an unknown parameter, or a value that no world can have."""


class UsageError(RecipeError):
    """Options contradict each other."""


class SceneError(ScenegenError):
    """An MJCF document cannot serve as a world."""


class GenerationError(ScenegenError):
    """No acceptable world came out of the allowed number of draws."""


class DatasetError(ScenegenError):
    """A folder holds no dataset, another dataset than expected, or cannot be written."""


# also a FileNotFoundError, as stores raise for a missing object: callers catch one class
class NotFoundError(DatasetError, FileNotFoundError):
    """A file that should be read does not exist."""


class DiskError(DatasetError):
    """The disk refuses a write: it is full, or permission is denied."""


class CorruptFileError(DatasetError):
    """A file of a dataset violates the format so that it cannot be examined further. The message is
    the fault."""


class UnsupportedVersionError(CorruptFileError):
    """A file uses a name that this version does not know: a newer scenegen may have written it."""


class MissingPartError(DatasetError):
    """A dataset lacks the part of samples that is asked for."""


class StoreError(ScenegenError):
    """A store refuses, is full, or does not answer. The content of the store is unknown then."""


class PublishError(ScenegenError):
    """A dataset cannot be published with these options, or not to this destination."""


class GuardError(ScenegenError):
    """A process that read an untrusted file crashed, timed out, or exceeded its memory."""


class StoppedError(ScenegenError):
    """The run was stopped by a signal. Finished work stays on disk."""


class UndecidedError(ScenegenError):
    """No fault was seen, but this machine cannot decide whether the dataset follows from its recipe
    and seed."""

    # 2 is click's, for wrong arguments
    code = 3


class OwnCodeError(ScenegenError):
    """A user's own kind, sensor, engine, method or command fails. The message names the line of
    their code."""


def plural(count: int, nouns: str) -> str:
    """Write a count with its noun: "1 world", "2 worlds".

    Args:
        count: How many.
        nouns: The noun in the plural, which ends in s.
    """
    return f"{count} {nouns.removesuffix('s') if count == 1 else nouns}"


def as_own_code_error(error: Exception) -> Exception:
    """Return `error`, or an `OwnCodeError` instead if it was raised in a user's own module."""
    line = "" if isinstance(error, ScenegenError) else own_line(error)
    return OwnCodeError(f"{line}: {type(error).__name__}: {printable(error)}") if line else error


@contextmanager
def own_code(expected: str) -> Iterator[None]:
    """Raise errors of the block, which calls a user's own code, as an `OwnCodeError`. A
    `ScenegenError`, and one that says that memory ran out, pass unchanged.

    Args:
        expected: What is called, and what it should take and give: for an error that arises outside
            of that code, such as of a function with other arguments.
    """
    try:
        yield
    except Exception as error:
        fault = as_own_code_error(error)
        # unchanged: it is one of ours, or arose in other code from what the user's gave
        if fault is error and not (isinstance(error, ScenegenError) or is_out_of_memory(error)):
            fault = OwnCodeError(f"{expected} ({type(error).__name__}: {printable(error)})")
        raise fault from None


@contextmanager
def reraise_as(
    make_error: Callable[[str], Exception],
    begin: str = "",
    end: str = "",
    *,
    of: type[Exception] | tuple[type[Exception], ...] = ValueError,
) -> Iterator[None]:
    """Raise errors of the block as an error of another kind.

    Args:
        make_error: Class of the new error, or a function that makes it from a message.
        begin: Text before the original message.
        end: Text after it.
        of: Classes of errors that are caught. Others pass unchanged.

    Raises:
        Exception: what `make_error` returns.
    """
    try:
        yield
    except of as error:
        # "from None": the command line prints one line, and the cause would repeat it
        raise make_error(f"{begin}{printable(error)[:MAX_REPEATED]}{end}") from None


def check_int(label: str, value: Any, minimum: int, maximum: int) -> int:
    """Convert a whole number of any type, such as numpy's, to an int.

    Args:
        label: What the number is, for the message.
        value: The value to check.
        minimum: Smallest allowed value.
        maximum: Largest allowed value.

    Raises:
        DatasetError: if `value` is a bool, no whole number, or out of bounds.
    """
    # bool is a subclass of int, and `--n true` is a mistake
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_whole or not minimum <= value <= maximum:
        raise DatasetError(
            f"{label} {short_repr(value)}: expected a whole number from {minimum} to {maximum}"
        )
    return int(value)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means that memory ran out. Python, torch and the system each say it in
    another way."""
    known = ("not enough memory", "can't allocate memory", "out of memory")
    return isinstance(error, MemoryError) or any(text in str(error) for text in known)


def escaped(text: object) -> str:
    """Replace every unprintable character, line ends included, by its escape."""
    return "".join(char if char.isprintable() else ascii(char)[1:-1] for char in str(text))


def needs(packages: str, extra: str) -> str:
    """Say that packages are missing, and how to install them.

    Args:
        packages: The packages, for the message.
        extra: The extra of scenegen that installs them.

    Returns:
        A clause such as "needs torch; in scenegen's checkout: pip install -e '.[train]'".
    """
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import unquote, urlsplit

    with suppress(PackageNotFoundError):
        # an installed wheel records its own file, from which the extra can be installed offline
        origin = json.loads(distribution("scenegen-lidar").read_text("direct_url.json") or "{}")
        if "archive_info" in origin:
            path = unquote(urlsplit(origin["url"]).path)
            return f"needs {packages}: pip install '{path}[{extra}]'"
    return f"needs {packages}; in scenegen's checkout: pip install -e '.[{extra}]'"


def lacking(error: ModuleNotFoundError) -> str:
    """Explain a missing package: `needs` if one of `EXTRAS` installs it, otherwise ""."""
    package = str(error.name).partition(".")[0]
    return needs(package, EXTRAS[package]) if package in EXTRAS else ""


def empty_split(split: str) -> str:
    """Say that a split has no samples, and how to get some."""
    option = "--n" if split == "train" else f"--{split}"
    return (
        f"its {split} split is empty; generate with {option} (scenes are split by world: give "
        "three or more, or one map, which is cut into regions)"
    )


def printable(text: object) -> str:
    """Write a value as one line: whitespace becomes single spaces, control characters become
    escapes.

    Names, keys and messages may come from an untrusted file. Printed raw, they could add lines or
    terminal codes.
    """
    return escaped(" ".join(str(text).split()))
