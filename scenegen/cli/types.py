"""Types of options and arguments: what is wrong with one is told before anything begins."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import rich_click as click
from click.shell_completion import CompletionItem

from lidarsim.parameters import Bounds
from lidarsim.registry import MOST_NAMED, Registry, suggestion
from scenegen.base.errors import printable, raised_as

MOST_REPEATED = 60
"""Characters of a value that an error repeats."""


FILE = click.Path(path_type=Path)
"""A file or a folder to read."""


class Written(click.ParamType):
    """A value that `read` makes of its text; it raises ValueError, in one line, where it cannot."""

    def __init__(self, read: Callable[[str], Any], name: str):
        self.read, self.name = read, name

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """The value; a default is one already."""
        if not isinstance(value, str):
            return value
        try:
            return self.read(value)
        except ValueError as error:
            self.fail(printable(error), param, ctx)


@dataclass(eq=False)
class Named(Written):
    """The name of something in a registry, or a user's own as module:Object.

    Args:
        registry: What can be named.
        file: A name that ends so is that of a file.
        others: Endings of files that another option takes, each with that option.
        address: Whether an address may follow, as in ray://host:10001.
        paths: Whether it may be a path: what exists, or is no plain word.
    """

    registry: Registry
    file: str | None = None
    others: Mapping[str, str] = field(default_factory=dict)
    address: bool = False
    paths: bool = False

    def __post_init__(self) -> None:
        self.name = self.registry.what

    def read(self, text: str) -> str:
        """The name, if it can be one; a user's own is imported later."""
        path = self.paths and (Path(text).exists() or not text.isidentifier())
        if path or (self.file is not None and text.endswith(self.file)):
            return text
        if option := self.others.get(Path(text).suffix):
            raise ValueError(f"{text} is a file; give it as {option} {text}")
        name = text.partition("://")[0] if self.address else text
        if ":" not in name and name not in self.registry.builtin:
            raise ValueError(self.registry.unknown(name))
        return text

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Names that begin with what is typed."""
        return [
            CompletionItem(name) for name in self.registry.builtin if name.startswith(incomplete)
        ]


class Choice(click.Choice[str]):
    """One of a few words; a word that is none gets the nearest one named."""

    def get_invalid_choice_message(self, value: Any, ctx: Any) -> str:
        """What is wrong with `value`."""
        hint = suggestion(str(value), self.choices)
        return f"{str(value)[:MOST_NAMED]!r} is none of them; {hint}"


class DatasetPath(Written, click.Path):
    """A dataset: a folder of it or of several, a selection's file, hf://user/name[@revision], or
    s3://bucket/folder; the command fetches it, and not the parsing."""

    def __init__(self) -> None:
        click.Path.__init__(self)
        self.name = "dataset"

    def read(self, text: str) -> Path | str:
        """A path, or a name with a scheme, if it can be one."""
        from scenegen.base.stores import place_of
        from scenegen.dataset.locate import SCHEME, parse

        if text.startswith(SCHEME):
            parse(text)
            return text
        place = place_of(text)
        return place if isinstance(place, Path) else text


class OutputFolder(Written, click.Path):
    """A folder to write; with `stores`, also one in a store, s3://bucket/folder."""

    def __init__(self, *, stores: bool = False) -> None:
        click.Path.__init__(self)
        self.stores = stores

    def read(self, text: str) -> Any:
        """The folder, or the store; none that is named with a scheme, where no such thing is
        written to."""
        from scenegen.base.stores import WRITTEN, is_remote, place_of

        scheme = text.partition("://")[0]
        if is_remote(text) and not (self.stores and scheme == WRITTEN):
            hint = " or s3://bucket/folder" if self.stores else "; only datasets go to s3://"
            raise ValueError(f"{scheme}://… is not written to; give a folder{hint}")
        return place_of(text)


class OutputFile(OutputFolder):
    """A file to write, a new one or one as scenegen wrote it, whose name ends in one of `ends`, if
    there are any; with `folders`, also a folder that is there."""

    def __init__(self, *ends: str, folders: bool = False) -> None:
        super().__init__()
        self.ends, self.folders = ends, folders

    def read(self, text: str) -> Path:
        """The path, if a file may be written there."""
        from scenegen.base.errors import DatasetError
        from scenegen.base.files import check_ours

        path: Path = super().read(text)
        if self.folders and path.is_dir():
            return path
        if self.ends and path.suffix not in self.ends:
            raise ValueError(f"{path}: expected a name that ends in {' or '.join(self.ends)}")
        with raised_as(ValueError, of=DatasetError):
            check_ours(path)
        return path


class Number(Written):
    """A finite number within bounds."""

    def __init__(self, bounds: Bounds | None = None, name: str = "float"):
        self.bounds, self.name = bounds or Bounds(), name

    def read(self, text: str) -> Any:
        """The number."""
        try:
            number = float(text)
        except ValueError:
            raise ValueError(f"{text[:MOST_REPEATED]!r} is not a valid float") from None
        if not self.bounds.hold(number):
            raise ValueError(f"{text[:MOST_REPEATED]} is not {self.bounds}")
        return number


class Numbers(Number):
    """As many numbers, with commas between them, as `name` has: X,Y,Z."""

    def read(self, text: str) -> tuple[float, ...]:
        """The numbers."""
        parts, count = text.split(","), self.name.count(",") + 1
        if len(parts) != count:
            expected = f"expected {self.name}, {count} numbers with commas between"
            raise ValueError(f"{text[:MOST_REPEATED]!r}: {expected}")
        return tuple(map(super().read, parts))


def read_range(text: str) -> tuple[int, int]:
    """FIRST:STOP, as in Python: numbers from FIRST to one before STOP."""
    first, _, stop = text.partition(":")
    if not (first.isdecimal() and stop.isdecimal() and int(first) < int(stop)):
        expected = "is not FIRST:STOP with FIRST < STOP, such as 0:8"
        raise ValueError(f"{text[:MOST_REPEATED]!r} {expected}")
    return int(first), int(stop)


def read_ranges(text: str) -> tuple[tuple[int, int], ...]:
    """Whole numbers and ranges of them, FIRST to one before STOP, with commas between: 3,10:20. The
    value has (first, stop) of each."""
    return tuple(
        (int(part), int(part) + 1) if part.isdecimal() else read_range(part)
        for part in text.split(",")
    )
