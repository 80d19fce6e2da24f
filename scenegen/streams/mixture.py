"""Which component of a mixture an index takes: a rule that needs no table of what came before.

Component k has the weight w_k and gives V_k samples a unit, one unit after the other, none left
out. Of every n = Σ n_k units in a row, n_k are its own, where n_k is w_k / V_k reduced to whole
numbers, so that *samples* come in proportion to the weights. They are spread evenly: the j-th of
the n_k has the place (2j + 1) / 2n_k, and the n units come in the order of their places, of equal
ones the component named first. This round of n units repeats for ever.
"""

import math
import numbers
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from scenegen.errors import RecipeError, short
from scenegen.limits import MOST_UNITS_IN_ROUND, MOST_WEIGHT
from scenegen.streams.component import Component


class Mixture:
    """Components by weight. A *slot* is the number of a unit in the mixture's own order."""

    def __init__(self, components: Sequence[Component], weights: Sequence[Any]):
        """Raises RecipeError for no component, one that is there twice, ones of different grids or
        sensors, and weights that are no proportions."""
        if not components:
            raise RecipeError(
                "stream: nothing to draw from; name a kind of world, such as 'pillar'"
            )
        self.components = tuple(components)
        _check_alike(self.components)
        each = [component.viewpoints for component in components]
        shares = [
            fraction(weight, component.label) / count
            for weight, component, count in zip(weights, components, each, strict=True)
        ]
        whole = math.lcm(*(share.denominator for share in shares))
        parts = [int(share * whole) for share in shares]
        common = math.gcd(*parts)
        self.units = tuple(part // common for part in parts)
        """Units of each component in a round."""
        if sum(self.units) > MOST_UNITS_IN_ROUND:
            said = ", ".join(
                f"{component.label} {short(weight)}"
                for component, weight in zip(components, weights, strict=True)
            )
            raise RecipeError(
                f"stream: weights {said} come round after {short(sum(self.units))} flights, "
                f"expected "
                f"{MOST_UNITS_IN_ROUND} at most; give proportions such as 2 and 1"
            )
        places = [
            (Fraction(2 * j + 1, 2 * count), k, j)
            for k, count in enumerate(self.units)
            for j in range(count)
        ]
        self._round = [(k, j) for _, k, j in sorted(places)]
        self._start = np.cumsum([0, *(each[k] for k, _ in self._round)])

    @property
    def row(self) -> int:
        """Samples of a world that come one after the other, whichever component they are of: the
        greatest number that divides every unit."""
        return math.gcd(*(component.viewpoints for component in self.components))

    def place(self, index: int) -> tuple[int, int]:
        """(slot, the sample's place in its unit) of a sample of the mixture."""
        turn, rest = divmod(index, int(self._start[-1]))
        within = int(np.searchsorted(self._start, rest, side="right")) - 1
        return turn * len(self._round) + within, rest - int(self._start[within])

    def unit(self, slot: int) -> tuple[int, int]:
        """(component, its unit) of a slot."""
        turn, within = divmod(slot, len(self._round))
        component, number = self._round[within]
        return component, turn * self.units[component] + number


def parts_of(worlds: Any) -> list[tuple[Any, Any]]:
    """(what, weight) of every part of a mixture: a mapping of weights, a list of parts or of pairs,
    or one part."""
    if isinstance(worlds, Mapping):
        return list(worlds.items())
    if isinstance(worlds, list | tuple):
        return [
            part if isinstance(part, tuple) and len(part) == 2 else (part, 1) for part in worlds
        ]
    return [(worlds, 1)]


def fraction(weight: Any, label: str, what: str = "stream") -> Fraction:
    """A weight, exactly as it is written. Raises RecipeError, which says of `what` it is."""
    number = isinstance(weight, numbers.Real) and not isinstance(weight, bool)
    if not number or not 0 < weight <= MOST_WEIGHT:  # which NaN is not
        raise RecipeError(
            f"{what}: weight of {label} = {short(weight)}: expected a number above 0, up to "
            f"{MOST_WEIGHT}"
        )
    return Fraction(str(weight if isinstance(weight, int) else float(weight)))


def _check_alike(components: Sequence[Component]) -> None:
    first, seen = components[0], dict[str, str]()
    for component in components:
        for what in ("grid", "lidar", "mapping"):
            theirs, ours = getattr(component.recipe, what), getattr(first.recipe, what)
            if theirs != ours:
                raise RecipeError(
                    f"stream: the {what} of {component.label} is {theirs}, that of {first.label} "
                    f"is {ours}; a stream "
                    f"has one {what}: mix recipes that share it"
                )
        digest = component.fingerprint(software=False)
        if digest in seen:
            raise RecipeError(
                f"stream: {component.label} is there twice, as {seen[digest]}; name it once, and "
                f"give a weight"
            )
        seen[digest] = component.label
