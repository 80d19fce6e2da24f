"""Kinds of worlds, one file a kind: a frozen dataclass of parameters with a method that adds solids
to an MjSpec.

The file's name is the kind's name, and its class has that name with a capital. There is no other
list of kinds: a new file here is a new kind. A user's own is named as ``module:Class``."""

import dataclasses
import itertools
import pkgutil
from typing import TYPE_CHECKING

from lidarsim.registry import Registry, suggestion
from scenegen.base.limits import MAX_KIND_NAME

if TYPE_CHECKING:
    from scenegen.worlds.kinds.kind import WorldKind


_NAMES = sorted(
    info.name for info in pkgutil.iter_modules(__path__) if info.name not in ("kind", "parts")
)
KINDS = Registry(
    "kind",
    {name: f"{__name__}.{name}:{name.capitalize()}" for name in _NAMES},
    needs={
        "version": "a whole number, raised whenever the same parameters would give other worlds",
        "crowded_by": "a tuple of names: the parameters to lower, or with a minus before them to "
        "raise, when worlds are too crowded to fly through",
        "add_to": "a method: (spec, *, rng), which draws one world and adds its solids to the "
        "MjSpec",
    },
)


def kind_names() -> tuple[str, ...]:
    """Return the names of built-in kinds, sorted, without importing them."""
    return tuple(KINDS.builtin)


def training_kinds() -> tuple[str, ...]:
    """Return the names of built-in kinds that methods may train on, sorted; others are for testing
    alone."""
    return tuple(name for name in kind_names() if find_kind(name).for_training)


def graded(kind: str, difficulty: str) -> str:
    """Name a preset beside its kind's others: "maze", or "maze-hard".

    Args:
        kind: The kind.
        difficulty: "easy", "medium" or "hard".

    Returns:
        The preset's name.
    """
    return kind if difficulty == "medium" else f"{kind}-{difficulty}"


def find_kind(name: str) -> "type[WorldKind]":
    """Import the class of a kind.

    Args:
        name: One of `kind_names()`, or a user's own as ``module:Class``.

    Returns:
        The class.

    Raises:
        ValueError: In one line, if there is no such kind, or its class is not a complete
            `WorldKind`.
    """
    # not at the top: it loads MuJoCo, which readers of datasets do without
    from scenegen.worlds.kinds.kind import WorldKind

    kind = KINDS.find(name)
    # a subclass that is no dataclass itself would have its parent's parameters alone
    if (
        len(name) > MAX_KIND_NAME
        or not (isinstance(kind, type) and issubclass(kind, WorldKind))
        or kind.__abstractmethods__
        or "__dataclass_fields__" not in vars(kind)
    ):
        raise ValueError(
            f"kind {name[:MAX_KIND_NAME]}: expected a name of at most {MAX_KIND_NAME} characters "
            "and a class as @dataclass(frozen=True, kw_only=True) class Mine(scenegen.WorldKind), "
            "with a method `add_to`"
        )
    known = [item.name for item in dataclasses.fields(kind)]
    crowded = (word.removeprefix("-") for word in kind.crowded_by)
    for word in itertools.chain(crowded, *kind.graded.values()):
        if word not in known:
            raise ValueError(
                f"kind {name}: crowded_by or graded has an unknown parameter {word!a}; "
                f"{suggestion(word, known)}"
            )
    return kind
