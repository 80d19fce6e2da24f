"""Parts of a sample that a user may ask for, beyond what every sample holds.

A part is one declaration: its option, what a recipe and a manifest say of it, how its fields are
computed, and which laws they keep. What draws, stores, reads and checks samples walks `PARTS`, so
that a new part is a new file here, a line in `PARTS`, and its fields in `scenegen.draw.sample`.

Reading a dataset imports this package, so a part's module imports what computes only when it does.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from scenegen.draw.parts.labels import LabelsPart
from scenegen.draw.parts.normals import NormalsPart


class Part(Protocol):
    """A part of a sample. Its name in `PARTS` is that of its option, of its entry in recipes and
    manifests, and of its group of fields."""

    help: str
    """The option's text."""
    choices: tuple[str, ...]
    """What the option may be; () for one that is given or not."""
    settings: type
    """The frozen dataclass that a recipe holds of it."""

    def resolve(self, choice: Any, class_names: Callable[[Any], set[str]]) -> Any:
        """The `settings` of what the user chose; `class_names` gives the classes of the geoms of
        all worlds, as far as they are known. Raises RecipeError."""
        ...

    def compute(
        self, fields: Mapping[str, Any], world: Any, recipe: Any, settings: Any
    ) -> dict[str, Any]:
        """The part's fields of a sample whose other `fields` are these, by name, from the world of
        solids and the recipe. Raises GenerationError."""
        ...

    def broken_laws(
        self, fields: Mapping[str, Any], settings: Any, *, exact: bool
    ) -> Iterator[str]:
        """What is wrong with the part's fields of a sample, a line each, by its other fields alone;
        ranges are `exact` where they are without noise."""
        ...


PARTS: Mapping[str, Part] = {"labels": LabelsPart(), "normals": NormalsPart()}
"""Every part, by name."""


def resolved(chosen: Mapping[str, Any], class_names: Callable[[Any], set[str]]) -> dict[str, Any]:
    """The settings of the parts that a user chose, by name; those not chosen are left out. Raises
    RecipeError."""
    return {
        name: PARTS[name].resolve(choice, class_names) for name, choice in chosen.items() if choice
    }
