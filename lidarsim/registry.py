"""Things by name: those that come with the toolkit, and a user's own as ``module:Object``.

    SENSORS = Registry("sensor", {"raster": "lidarsim.sensors.raster:Lidar"})
    SENSORS.find("raster")  # imported now, and not before
    SENSORS.find("my_sensors:Rosette")  # from my_sensors.py where the user stands, or installed

The command line reads the names alone, so a registry stands where importing it is cheap: most often
in the `__init__.py` of the package whose modules it names.
"""

import difflib
import importlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

MOST_NAMED = 100
"""Characters of a name that an error repeats."""
MOST_SUGGESTED = 4
"""Names of which an error asks whether one was meant."""


@dataclass(frozen=True)
class Registry:
    """Objects of one sort, each imported when it is first asked for."""

    what: str
    """The sort in one word, for errors: "sensor"."""
    builtin: Mapping[str, str]
    """Names of those that come with the toolkit, each with its ``module:Object``."""
    needs: Mapping[str, str] = field(default_factory=dict)
    """Attributes that every object has to have, each with what it is: {"cast": "a method: (origins,
    …) -> ranges"}."""

    def find(self, name: str) -> Any:
        """The object called `name`. Raises ValueError, in one line, for a name that leads to none,
        or to one that lacks what it needs."""
        name = str(name)
        module, colon, attribute = self.builtin.get(name, name).partition(":")
        if not colon or not all(map(str.isidentifier, (attribute, *module.split(".")))):
            raise ValueError(self.unknown(name))
        if name in self.builtin:
            imported = importlib.import_module(module)
        else:
            imported = self._imported(module, name)
        try:
            chosen = getattr(imported, attribute)
        except AttributeError:
            where = getattr(imported, "__file__", None) or "no file"
            hint = suggestion(attribute, _defined(imported) or ["nothing"])[: 2 * MOST_NAMED]
            raise ValueError(f"{self.what} {name}: {where} has no {attribute}; {hint}") from None
        self.check(chosen, name)
        return chosen

    def unknown(self, name: str) -> str:
        """What to say of a `name` that is none."""
        hint = suggestion(name, self.builtin)
        return f"unknown {self.what} {name[:MOST_NAMED]!a}; {hint} (or one's own, as module:Object)"

    def check(self, chosen: Any, name: str) -> None:
        """Raise ValueError, naming what is missing, unless `chosen` has all that it needs."""
        for attribute, meaning in self.needs.items():
            # a dataclass's field without a default is no attribute of the class yet; no value is
            # asked for, since rays take time to compute
            if attribute not in (*dir(chosen), *getattr(chosen, "__annotations__", ())):
                raise ValueError(f"{self.what} {name}: lacks `{attribute}`, {meaning}")

    def _imported(self, module: str, name: str) -> Any:
        """A user's module: an installed one, or a file in the folder where the user stands."""
        here = os.getcwd()  # noqa: PTH109 (sys.path holds strings)
        if here not in sys.path:
            # last, so that no file of the user's takes the place of a library's
            sys.path.append(here)
        _own.update({here, module.partition(".")[0]})
        try:
            if importlib.util.find_spec(module) is None:
                raise ModuleNotFoundError(module, name=module.partition(".")[0])
            return importlib.import_module(module)
        except (Exception, SystemExit) as error:
            if isinstance(error, ModuleNotFoundError) and module.startswith(str(error.name)):
                raise ValueError(
                    f"{self.what} {name}: there is no module {module}, neither installed nor in "
                    f"{here}"
                ) from None
            at = f" ({line})" if (line := own_line(error)) else ""
            raise ValueError(f"{self.what} {name}: importing it fails{at}: {error!r}") from None


def _defined(module: ModuleType) -> list[str]:
    """Public names that a module defines, and does not import from another."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and not isinstance(value, ModuleType)
        # only functions and classes say where they were defined
        and (not hasattr(value, "__qualname__") or value.__module__ == module.__name__)
    ]


def suggestion(name: str, known: Iterable[str]) -> str:
    """What to say after a `name` that is none of those `known`: the nearest of them, or all."""
    known = list(known)
    plain = name.lower().replace("-", "")
    near = [one for one in known if plain and plain in one.replace("-", "")]
    if not 0 < len(near) <= MOST_SUGGESTED:
        near = difflib.get_close_matches(name[:MOST_NAMED], known, n=1)
    return f"did you mean {' or '.join(map(repr, near))}?" if near else f"known: {', '.join(known)}"


_own: set[str] = set()
"""Modules that a user named, and the folders where they stood."""


def own_line(error: BaseException) -> str:
    """Where the last of a user's own code stands that `error` came through: "line 3 of
    my_methods.py"; "" for none."""
    found = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        file = frame.f_code.co_filename
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        if package in _own or os.path.dirname(file) in _own:  # noqa: PTH120
            found = f"line {line} of {os.path.relpath(file)}"
    return found
