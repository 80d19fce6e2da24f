"""Types of options and arguments: what is wrong with one is told before anything begins."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rich_click as click
from click.shell_completion import CompletionItem

from lidarsim.parameters import Bounds
from lidarsim.registry import MOST_NAMED, Registry, suggestion


class Named(click.ParamType):
    """The name of something in a registry, or a user's own as module:Object, or, with `file`, a
    file that ends so.

    `others` are endings of files that another option takes, each with that option.
    """

    def __init__(
        self,
        registry: Registry,
        *,
        file: str | None = None,
        others: Mapping[str, str] | None = None,
    ):
        self.registry, self.name, self.file, self.others = (
            registry,
            registry.what,
            file,
            others or {},
        )

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name, if it can be one; a user's own is imported later."""
        if self.file is not None and value.endswith(self.file):
            return str(value)
        if option := self.others.get(Path(value).suffix):
            self.fail(f"{value} is a file; give it as {option} {value}", param, ctx)
        if ":" not in value and value not in self.registry.known:
            self.fail(self.registry.unknown(value), param, ctx)
        return str(value)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Names that begin with what is typed."""
        return [CompletionItem(name) for name in self.registry.known if name.startswith(incomplete)]


class Choice(click.Choice[str]):
    """One of a few words; a word that is none gets the nearest one named."""

    def get_invalid_choice_message(self, value: Any, ctx: Any) -> str:
        """What is wrong with `value`."""
        return (
            f"{str(value)[:MOST_NAMED]!r} is none of them; {suggestion(str(value), self.choices)}"
        )


class Place(Named):
    """The name of an executor, with an address or without: ray://host:10001."""

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """As it is, if its name can be one."""
        super().convert(value.partition("://")[0], param, ctx)
        return str(value)


class DatasetPath(click.ParamType):
    """A dataset: a folder, hf://user/name[@revision], or a place, s3://bucket/folder; the command
    fetches, and not the parsing."""

    name = "dataset"

    def convert(self, value: Any, param: Any, ctx: Any) -> Path | str:
        """A path as it is, or a name with a scheme, if it can be one."""
        from scenegen.dataset.locate import check_name
        from scenegen.stores import folder_of, is_remote

        if not is_remote(value):
            return folder_of(value)
        check_name(value)
        return str(value)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Folders."""
        return [CompletionItem(incomplete, type="dir")]


class OutputFolder(click.Path):
    """A folder to write; with `places`, also a place, s3://bucket/folder."""

    def __init__(self, *, places: bool = False) -> None:
        super().__init__(path_type=Path)
        self.places = places

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        """The folder."""
        from scenegen.stores import folder_of

        _refuse(self, value, param, ctx, places=self.places)
        return folder_of(value) if self.places and isinstance(value, str) else Path(value)


def _refuse(
    kind: click.ParamType, value: Any, param: Any, ctx: Any, *, places: bool = False
) -> None:
    """Fail where a name with a scheme is given to write to, and no such thing is written there."""
    from scenegen.stores import PLACES, is_remote

    scheme = str(value).partition("://")[0]
    if is_remote(value) and not (places and scheme in PLACES.known):
        told = (
            " or a place, s3://bucket/folder"
            if places
            else "; only `generate` and `rescan` write to s3://"
        )
        kind.fail(f"{scheme}://… is not written to; give a folder{told}", param, ctx)


class OutputFile(click.Path):
    """A file to write: a new one, or one as scenegen wrote it; with `folders`, also a folder that
    is there, or any file, of which the command says whether it is replaced."""

    def __init__(self, *, folders: bool = False) -> None:
        super().__init__(path_type=Path)
        self.folders = folders

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        """The path, if a file may be written there."""
        from scenegen.errors import DatasetError
        from scenegen.files import check_ours, check_target

        _refuse(self, value, param, ctx)
        path = Path(value)
        if self.folders and path.is_dir():
            return path
        try:
            (check_target if self.folders else check_ours)(path)
        except DatasetError as error:
            self.fail(str(error), param, ctx)
        return path


class Number(click.ParamType):
    """A finite number within bounds."""

    name = "float"

    def __init__(self, bounds: Bounds | None = None):
        self.bounds = bounds or Bounds()

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """The number."""
        number = float(click.FLOAT.convert(value, param, ctx))
        if not self.bounds.hold(number):
            self.fail(f"{value} is not {self.bounds}", param, ctx)
        return number


class Numbers(click.ParamType):
    """So many finite numbers, with commas between them."""

    def __init__(self, name: str, count: int):
        self.name, self.count = name, count

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, ...]:
        """The numbers."""
        if isinstance(value, tuple):  # a default
            return value
        parts = str(value).split(",")
        if len(parts) != self.count:
            self.fail(
                f"{str(value)[:60]!r}: expected {self.name}, {self.count} numbers with commas "
                f"between",
                param,
                ctx,
            )
        return tuple(Number().convert(part, param, ctx) for part in parts)


class ShardRange(click.ParamType):
    """FIRST:STOP, as in Python: shard numbers from FIRST to one before STOP."""

    name = "first:stop"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        """The two numbers."""
        first, colon, stop = str(value).partition(":")
        short = len(str(value)) <= 40  # and no more digits than int() takes
        if not (
            colon and short and first.isdecimal() and stop.isdecimal() and int(first) < int(stop)
        ):
            self.fail(
                f"{str(value)[:60]!r} is not FIRST:STOP with FIRST < STOP, such as 0:8", param, ctx
            )
        return int(first), int(stop)


class Ranges(click.ParamType):
    """Whole numbers and ranges of them, FIRST to one before STOP, with commas between: 3,10:20."""

    name = "n,first:stop"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[tuple[int, int], ...]:
        """(first, stop) of each."""
        if isinstance(value, tuple):
            return value
        found = []
        for part in str(value).split(","):
            if part.isdecimal() and len(part) <= 12:
                found.append((int(part), int(part) + 1))
            else:
                found.append(ShardRange().convert(part, param, ctx))
        return tuple(found)


class Written(click.ParamType):
    """A value that `read` makes of its text; it raises ValueError, in one line, where it cannot."""

    def __init__(self, read: Callable[[str], Any], name: str):
        self.read, self.name = read, name.lower()

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """The value."""
        if not isinstance(value, str):
            return value
        try:
            return self.read(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)
