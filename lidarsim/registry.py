"""Registries: objects by name, built in or a user's own as ``module:Object``.

    SENSORS = Registry("sensor", {"raster": "lidarsim.sensors.raster:Lidar"})
    SENSORS.find("raster")  # imported now, and not before
    SENSORS.find("my_sensors:Rosette")  # from my_sensors.py in the current folder, or installed

The command line reads only the names, so a registry lies in a module that is cheap to import: most
often in the `__init__.py` of the package whose modules it names."""

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

MAX_NAMED = 100
"""Characters of a name that an error repeats."""
MAX_SUGGESTED = 4
"""The most names that an error suggests."""


@dataclass(frozen=True)
class Registry:
    """Objects of one sort, each imported when it is first used."""

    what: str
    """The sort in one word, for errors: "sensor"."""
    builtin: Mapping[str, str]
    """Names of those that come with the toolkit, each with its ``module:Object``."""
    needs: Mapping[str, str] = field(default_factory=dict)
    """Attributes that every object must have, each with a description, such as {"cast":
    "a method: (origins, …) -> ranges"}."""

    def find(self, name: str) -> Any:
        """Import the object called `name`.

        Args:
            name: A built-in name, or ``module:Object``.

        Returns:
            The object.

        Raises:
            ValueError: If there is no such object, its module cannot be imported, or it lacks an
                attribute of `needs`. The message has one line.
        """
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
            hint = suggestion(attribute, _defined(imported) or ["nothing"])[: 2 * MAX_NAMED]
            raise ValueError(f"{self.what} {name}: {where} has no {attribute}; {hint}") from None
        self.check(chosen, name)
        return chosen

    def unknown(self, name: str) -> str:
        """Word the error for an unknown `name`, with a suggestion."""
        hint = suggestion(name, self.builtin)
        return f"unknown {self.what} {name[:MAX_NAMED]!a}; {hint} (or one's own, as module:Object)"

    def check(self, chosen: Any, name: str) -> None:
        """Check that an object has every attribute of `needs`.

        Args:
            chosen: The object.
            name: Its name, for the message.

        Raises:
            ValueError: If an attribute is missing; the message names it.
        """
        for attribute, meaning in self.needs.items():
            # a dataclass's field without a default is no attribute of the class yet; no value is
            # asked for, since rays take time to compute
            if attribute not in (*dir(chosen), *getattr(chosen, "__annotations__", ())):
                raise ValueError(f"{self.what} {name}: lacks `{attribute}`, {meaning}")

    def _imported(self, module: str, name: str) -> Any:
        """Import a user's module: an installed one, or a file in the current folder."""
        folder = os.getcwd()  # noqa: PTH109 (sys.path holds strings)
        if folder not in sys.path:
            # last, so that no file of the user's takes the place of a library's
            sys.path.append(folder)
        _users_code.update({folder, module.partition(".")[0]})
        try:
            if importlib.util.find_spec(module) is None:
                raise ModuleNotFoundError(module, name=module.partition(".")[0])
            return importlib.import_module(module)
        except (Exception, SystemExit) as error:  # a script may call sys.exit
            # else a module that the user's own imports is missing
            if isinstance(error, ModuleNotFoundError) and module.startswith(str(error.name)):
                raise ValueError(
                    f"{self.what} {name}: there is no module {module}, neither installed nor in "
                    f"{folder}"
                ) from None
            place = f" ({line})" if (line := own_line(error)) else ""
            raise ValueError(f"{self.what} {name}: importing it fails{place}: {error!r}") from None


def _defined(module: ModuleType) -> list[str]:
    """List public names that a module defines, without those that it imports."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and not isinstance(value, ModuleType)
        # only functions and classes say where they were defined
        and (not hasattr(value, "__qualname__") or value.__module__ == module.__name__)
    ]


def suggestion(name: str, known: Iterable[str]) -> str:
    """Suggest a known name.

    Args:
        name: The unknown name.
        known: The known names.

    Returns:
        A question with the nearest names, or the list of all.
    """
    known = list(known)
    plain = name.lower().replace("-", "")
    near = [entry for entry in known if plain and plain in entry.replace("-", "")]
    if not 0 < len(near) <= MAX_SUGGESTED:
        # cut, for the comparison takes quadratic time
        near = difflib.get_close_matches(name[:MAX_NAMED], known, n=1)
    return f"did you mean {' or '.join(map(repr, near))}?" if near else f"known: {', '.join(known)}"


_users_code: set[str] = set()
"""Modules that a user named, and the folders where they stood."""


def own_line(error: BaseException) -> str:
    """Locate an error in a user's own code: "line 3 of my_methods.py"; "" if it arose elsewhere."""
    location = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        file = frame.f_code.co_filename
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        if package in _users_code or os.path.dirname(file) in _users_code:  # noqa: PTH120
            # the last frame wins: it is nearest to the error
            location = f"line {line} of {os.path.relpath(file)}"
    return location
