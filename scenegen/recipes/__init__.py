"""Kinds of worlds, one file a kind: a frozen dataclass of parameters with a method that adds solids to an MjSpec.

The file's name is the kind's name. Nothing else lists the kinds: a new file here is a new kind.
"""

import importlib
import pkgutil
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line asks for the kinds' names on every start, and must not load MuJoCo for that
    from scenegen.recipes.kind import WorldKind


def kind_names() -> tuple[str, ...]:
    """Names of all kinds, sorted; imports none of them."""
    return tuple(sorted(info.name for info in pkgutil.iter_modules(__path__) if info.name != "kind"))


def find_kind(name: str) -> "type[WorldKind]":
    """The class of the kind called `name`, which must be one of `kind_names()`."""
    from scenegen.recipes.kind import WorldKind

    module = importlib.import_module(f"{__name__}.{name}")
    (found,) = (
        item
        for item in vars(module).values()
        if isinstance(item, type) and issubclass(item, WorldKind) and item.__module__ == module.__name__
    )
    return found
