"""Kinds of worlds, one file a kind: a frozen dataclass of parameters with a method that adds solids
to an MjSpec.

The file's name is the kind's name, and its class has that name with a capital. Nothing else lists
the kinds: a new file here is a new kind. A user's own is named as ``module:Class``.
"""

import pkgutil
from typing import TYPE_CHECKING, Any

from lidarsim.registry import Registry
from scenegen.limits import MOST_KIND_NAME

if TYPE_CHECKING:  # the command line asks for the kinds' names, and must not load MuJoCo for that
    from scenegen.recipes.kind import WorldKind

_NAMES = sorted(info.name for info in pkgutil.iter_modules(__path__) if info.name != "kind")
KINDS = Registry(
    "kind",
    {name: f"{__name__}.{name}:{name.capitalize()}" for name in _NAMES},
    needs={
        "version": "a whole number, raised whenever the same parameters would give other worlds",
        "crowded_by": "a tuple of names: the parameters to lower when worlds are too crowded to "
        "fly through",
        "add_to": "a method: (spec, *, rng), which draws one world and adds its solids to the "
        "MjSpec",
    },
)


def kind_names() -> tuple[str, ...]:
    """Names of the kinds that come with scenegen, sorted; imports none of them."""
    return tuple(KINDS.known)


def find_kind(name: str) -> "type[WorldKind]":
    """The class of the kind called `name`: one of `kind_names()`, or a user's own as
    ``module:Class``.

    Raises ValueError, in one line, where there is none, or one that is no kind.
    """
    from scenegen.recipes.kind import WorldKind

    found: Any = KINDS.find(name)
    wrong = ""
    if len(name) > MOST_KIND_NAME:
        wrong = f"has a name of {len(name)} characters, expected {MOST_KIND_NAME} at most"
    elif not (isinstance(found, type) and issubclass(found, WorldKind)):
        wrong = "is no class that inherits from scenegen.recipes.kind.WorldKind"
    elif found.__abstractmethods__:
        wrong = f"lacks `add_to`, {KINDS.needs['add_to']}"
    elif "__dataclass_fields__" not in vars(found):
        wrong = "is no dataclass; write @dataclass(frozen=True, kw_only=True) above the class"
    if wrong:
        raise ValueError(f"kind {name[:MOST_KIND_NAME]}: {wrong}")
    return found
