"""Optional parts of a sample.

A part is one declaration: its option, its entry in recipes and manifests, how its fields are
computed, and which laws they satisfy. Drawing, storing, reading and checking iterate over `PARTS`.
A new part is a new file here, a line in `PARTS`, and its fields in `scenegen.draw.sample`.

Reading a dataset imports this package. Modules of parts therefore import numerical code only where
they use it.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from lidarsim.parameters import short_repr
from scenegen.base.errors import UsageError
from scenegen.draw.parts.labels import LabelsPart
from scenegen.draw.parts.movers import MoversPart
from scenegen.draw.parts.normals import NormalsPart


class Part(Protocol):
    """An optional part of a sample. Its name in `PARTS` is also the name of its option, of its
    entry in recipes and manifests, and of its group of fields."""

    help: str
    """Help text of the option."""
    choices: tuple[str, ...]
    """Allowed values of the option; () for a flag."""
    settings: type
    """Frozen dataclass of the part's settings in a recipe."""

    def resolve(self, choice: Any, class_names: Callable[[Any], set[str]]) -> Any:
        """Make the settings of the user's choice.

        Args:
            choice: The value of the option.
            class_names: Returns the known classes of the geoms of all worlds.

        Returns:
            An instance of `settings`.

        Raises:
            RecipeError: if the choice is not possible.
        """
        ...

    def compute(
        self, fields: Mapping[str, Any], world: Any, recipe: Any, settings: Any
    ) -> dict[str, Any]:
        """Compute the part's fields of a sample.

        Args:
            fields: Other fields of the sample, by name.
            world: The `World`.
            recipe: The `Recipe`.
            settings: The part's settings.

        Returns:
            The part's fields, by name.

        Raises:
            GenerationError: if they cannot be computed.
        """
        ...

    def broken_laws(
        self, fields: Mapping[str, Any], settings: Any, *, exact: bool
    ) -> Iterator[str]:
        """Check the part's fields against the other fields of a sample.

        Args:
            fields: All fields of the sample, by name.
            settings: The part's settings.
            exact: Whether ranges are free of noise.

        Yields:
            A line for each fault.
        """
        ...


PARTS: Mapping[str, Part] = {
    "labels": LabelsPart(),
    "normals": NormalsPart(),
    "movers": MoversPart(),
}
"""All parts by name."""


def resolved(chosen: Mapping[str, Any], class_names: Callable[[Any], set[str]]) -> dict[str, Any]:
    """Make the settings of all parts that the user chose.

    Args:
        chosen: Value of each part's option, by name.
        class_names: As for `Part.resolve`.

    Returns:
        Settings by name, without the parts that are off.

    Raises:
        RecipeError: if a choice is not possible.
        UsageError: if there is no such part.
    """
    for name in chosen.keys() - PARTS.keys():
        raise UsageError(f"unknown option {short_repr(name)}; expected {', '.join(PARTS)}")
    return {
        name: PARTS[name].resolve(choice, class_names) for name, choice in chosen.items() if choice
    }
