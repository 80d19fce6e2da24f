"""TOML files, and dataclasses made of their tables, with errors that name the file, the table and
the parameter."""

import dataclasses
import difflib
import re
import tomllib
from pathlib import Path
from typing import Any

from scenegen.errors import DatasetError, RecipeError, printable, short
from scenegen.files import read_bounded
from scenegen.limits import MOST_DEPTH, MOST_RECIPE_BYTES

_DECIMAL = re.compile(r"(?<![\w.])\d+\.\d+(?:[eE][-+]?\d+)?(?![\w.])")
"""A number's own dot, of which a list of beams has many in a line."""


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises RecipeError, naming the file."""
    where = printable(path)
    try:
        text = read_bounded(path, MOST_RECIPE_BYTES).decode()
        lines = (
            _DECIMAL.sub("", line)
            for line in text.splitlines()
            if not line.lstrip().startswith("#")
        )
        if any(line.count(".") > MOST_DEPTH for line in lines):
            # dotted keys: tomllib's time grows with the square of their depth, or worse
            raise RecursionError
        return tomllib.loads(text)
    except OSError as error:
        raise RecipeError(f"{where}: cannot be read: {error.strerror}") from None
    except DatasetError as error:
        raise RecipeError(printable(error)) from None
    except ValueError as error:  # TOMLDecodeError, and int()'s for thousands of digits
        raise RecipeError(f"{where}: not valid TOML: {printable(error)}") from None
    except RecursionError:
        raise RecipeError(f"{where}: nested too deeply; expected tables of parameters") from None


def from_table(part: Any, table: dict[str, Any], where: str, folder: Path) -> Any:
    """An instance of the dataclass `part`, which checks its values, or a copy of the instance
    `part` with the values changed; paths in `table` are relative to `folder`. Raises
    RecipeError."""
    fields = {item.name: item for item in dataclasses.fields(part)}
    values = {}
    for name, value in table.items():
        check_name(name, tuple(fields), "parameter", where)
        is_path = fields[name].type in (Path, "Path") and isinstance(value, str)
        values[name] = folder / value if is_path else value
    for name, item in fields.items():
        needed = item.default is item.default_factory is dataclasses.MISSING
        if needed and name not in table and isinstance(part, type):
            raise RecipeError(f"{where} {name}: is missing, and has no default; give it a value")
    try:
        return part(**values) if isinstance(part, type) else dataclasses.replace(part, **values)
    except (
        ValueError,
        TypeError,
    ) as error:  # a user's own sensor may check its values in either way
        raise RecipeError(f"{where} {printable(error)}") from None


def field_names(part: Any) -> set[str]:
    """What may stand in a table of the dataclass `part`."""
    return {item.name for item in dataclasses.fields(part)}


def check_name(name: Any, known: tuple[str, ...], what: str, where: str) -> None:
    """Raise RecipeError, with the nearest of the `known` names, for one that is none of them."""
    if name not in known:
        near = difflib.get_close_matches(str(name)[:100], known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        raise RecipeError(f"{where}{': ' if where else ''}unknown {what} {short(name)}; {hint}")
