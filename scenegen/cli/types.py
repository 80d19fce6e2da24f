"""Types of options and arguments. They refuse wrong values before the command begins."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import rich_click as click
from click.shell_completion import CompletionItem

from lidarsim.parameters import Bounds
from lidarsim.registry import MAX_NAMED, Registry, suggestion
from scenegen.base.errors import printable, reraise_as

MAX_REPEATED = 60
"""Maximum characters of a value that an error repeats."""
FILE = click.Path(path_type=Path)
"""Type of a file or folder to read."""


class Written(click.ParamType):
    """A value that a function reads from its text."""

    def __init__(self, read: Callable[[str], Any], name: str):
        """Make the type.

        Args:
            read: Function from text to value, which raises ValueError with one line.
            name: Name of the value on help pages.
        """
        self.read, self.name = read, name

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the value of a text, see `click.ParamType.convert`.

        Args:
            value: The text, or a default, which is a value already.
            param: The parameter, for errors.
            ctx: The context, for errors.

        Raises:
            click.BadParameter: The text is not valid.
        """
        if not isinstance(value, str):
            return value  # click also converts defaults
        try:
            return self.read(value)
        except ValueError as error:
            self.fail(printable(error), param, ctx)


@dataclass(eq=False)
class Named(Written):
    """The name of an object in a registry, or a user's own as module:Object.

    Args:
        registry: Registry of the names.
        file: Suffix of files that may be given, too.
        file_options: Option that takes a file, by the file's suffix.
        address: Whether an address may follow, as in ray://host:10001.
        paths: Whether paths may be given: texts that exist as one, or are not a plain word.
    """

    registry: Registry
    file: str | None = None
    file_options: Mapping[str, str] = field(default_factory=dict)
    address: bool = False
    paths: bool = False

    def __post_init__(self) -> None:
        self.name = self.registry.what

    def read(self, text: str) -> str:
        """Check a name; a user's own is imported later.

        Raises:
            ValueError: There is no such name.
        """
        path = self.paths and (Path(text).exists() or not text.isidentifier())
        if path or (self.file is not None and text.endswith(self.file)):
            return text
        if option := self.file_options.get(Path(text).suffix):
            raise ValueError(f"{text} is a file; give it as {option} {text}")
        name = text.partition("://")[0] if self.address else text
        # module:Object is not imported here: only its use shows whether it exists
        if ":" not in name and name not in self.registry.builtin:
            raise ValueError(self.registry.unknown(name))
        return text

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Return names for the shell.

        Args:
            ctx: The context, unused.
            param: The parameter, unused.
            incomplete: The begin of a name.
        """
        return [
            CompletionItem(name) for name in self.registry.builtin if name.startswith(incomplete)
        ]


class Choice(click.Choice[str]):
    """One of a few words; an error suggests the nearest one."""

    def get_invalid_choice_message(self, value: Any, ctx: Any) -> str:
        """Return the error for a word that is not among the choices.

        Args:
            value: The word.
            ctx: The context, unused.
        """
        hint = suggestion(str(value), self.choices)
        return f"{str(value)[:MAX_NAMED]!r} is none of them; {hint}"


class DatasetPath(Written, click.Path):
    """A dataset: its folder, a folder of several, the file of a selection,
    hf://user/name[@revision], or s3://bucket/folder. Parsing does not download; the command
    does."""

    def __init__(self) -> None:
        click.Path.__init__(self)
        self.name = "dataset"

    def read(self, text: str) -> Path | str:
        """Return a path, or a name with a scheme. Raises ValueError if that is malformed."""
        from scenegen.base.stores import location_of
        from scenegen.dataset.locate import SCHEME, parse

        if text.startswith(SCHEME):
            parse(text)
            return text
        location = location_of(text)
        return location if isinstance(location, Path) else text


class OutputFolder(Written, click.Path):
    """A folder to write; with `stores`, also one in a store, s3://bucket/folder."""

    def __init__(self, *, stores: bool = False) -> None:
        click.Path.__init__(self)
        self.stores = stores

    def read(self, text: str) -> Any:
        """Return the folder or the store.

        Raises:
            ValueError: Nothing can be written to a name with this scheme.
        """
        from scenegen.base.stores import WRITTEN, is_remote, location_of

        scheme = text.partition("://")[0]
        if is_remote(text) and not (self.stores and scheme == WRITTEN):
            hint = " or s3://bucket/folder" if self.stores else "; only datasets go to s3://"
            raise ValueError(f"{scheme}://… is not written to; give a folder{hint}")
        return location_of(text)


class OutputFile(OutputFolder):
    """A file to write: a new one, or one that scenegen wrote."""

    def __init__(self, *ends: str, folders: bool = False) -> None:
        """Make the type.

        Args:
            ends: Suffixes that the name must have; none: any.
            folders: Whether an existing folder may be given instead.
        """
        super().__init__()
        self.ends, self.folders = ends, folders

    def read(self, text: str) -> Path:
        """Check that a file may be written.

        Raises:
            ValueError: It has another suffix, or exists and scenegen did not write it.
        """
        from scenegen.base.errors import DatasetError
        from scenegen.base.files import check_ours

        path: Path = super().read(text)
        if self.folders and path.is_dir():
            return path
        if self.ends and path.suffix not in self.ends:
            raise ValueError(f"{path}: expected a name that ends in {' or '.join(self.ends)}")
        with reraise_as(ValueError, of=DatasetError):
            check_ours(path)  # now, and not after hours of work
        return path


class Number(Written):
    """A finite number within bounds."""

    def __init__(self, bounds: Bounds | None = None, name: str = "float"):
        self.bounds, self.name = bounds or Bounds(), name

    def read(self, text: str) -> Any:
        """Parse a number.

        Raises:
            ValueError: It is not a number, or out of bounds.
        """
        try:
            number = float(text)
        except ValueError:
            raise ValueError(f"{text[:MAX_REPEATED]!r} is not a valid float") from None
        if not self.bounds.hold(number):  # also NaN and infinity
            raise ValueError(f"{text[:MAX_REPEATED]} is not {self.bounds}")
        return number


class Numbers(Number):
    """Numbers separated by commas, as many as there are words in `name`: X,Y,Z."""

    def read(self, text: str) -> tuple[float, ...]:
        """Parse the numbers.

        Raises:
            ValueError: There are fewer or more, or one is not a number.
        """
        parts, count = text.split(","), self.name.count(",") + 1
        if len(parts) != count:
            expected = f"expected {self.name}, {count} numbers with commas between"
            raise ValueError(f"{text[:MAX_REPEATED]!r}: {expected}")
        return tuple(map(super().read, parts))


def read_range(text: str) -> tuple[int, int]:
    """Parse FIRST:STOP, as in Python: numbers from FIRST to one before STOP.

    Raises:
        ValueError: It is not such a range, or an empty one.
    """
    first, _, stop = text.partition(":")
    # `int` alone would also take signs, blanks and 1_5
    if not (first.isdecimal() and stop.isdecimal() and int(first) < int(stop)):
        expected = "is not FIRST:STOP with FIRST < STOP, such as 0:8"
        raise ValueError(f"{text[:MAX_REPEATED]!r} {expected}")
    return int(first), int(stop)


def read_ranges(text: str) -> tuple[tuple[int, int], ...]:
    """Parse whole numbers and ranges, see `read_range`, separated by commas: 3,10:20. Return
    (first, stop) of each; a number is a range of one."""
    return tuple(
        (int(part), int(part) + 1) if part.isdecimal() else read_range(part)
        for part in text.split(",")
    )
