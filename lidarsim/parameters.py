"""One way to check a parameter: its bounds stand beside its default, and are checked when the dataclass is made.

@dataclass(frozen=True, kw_only=True)
class Sensor:
    rows: int = number(16, least=1, most=1000)
    max_range_m: float = number(10.0, above=0)

    def __post_init__(self) -> None:
        check(self)
"""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

BOUNDS = "bounds"
"""Key of a field's metadata under which its `Bounds` stand."""


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """What a number, or each number of a tuple, may be. Every number is finite, whatever else."""

    least: float = -math.inf
    """The least value allowed."""
    most: float = math.inf
    """The greatest value allowed."""
    above: float = -math.inf
    """The value must be greater than this."""
    below: float = math.inf
    """The value must be less than this."""
    whole: bool = False
    """Only whole numbers are allowed."""
    rising: bool = False
    """A tuple of two is a lower and an upper bound, in this order; equal ones are allowed."""

    def hold(self, value: float) -> bool:
        """Whether `value` lies within the bounds."""
        try:
            finite = math.isfinite(value)
        except OverflowError:  # a whole number beyond all floats
            return False
        inside = finite and self.least <= value <= self.most and self.above < value < self.below
        return inside and (not self.whole or float(value).is_integer())

    def __str__(self) -> str:
        """The bounds in words: "a whole number from 1 to 1000"."""
        low = f"above {self.above:g}" if math.isfinite(self.above) else ""
        low = low or (f"at least {self.least:g}" if math.isfinite(self.least) else "")
        high = f"below {self.below:g}" if math.isfinite(self.below) else ""
        high = high or (f"at most {self.most:g}" if math.isfinite(self.most) else "")
        what = "a whole number" if self.whole else "a finite number"
        return " ".join([what, " and ".join(part for part in (low, high) if part)]).strip()


def number(default: Any = dataclasses.MISSING, **bounds: Any) -> Any:
    """A dataclass field with a `default`, whose value, or each number in it, keeps `bounds`; see `Bounds`."""
    return field(default=default, metadata={BOUNDS: Bounds(**bounds)})


def check(parameters: Any) -> None:
    """Raise ValueError, naming the field, where a number in the dataclass `parameters` is not within its bounds.

    Every number must be finite, also in fields without bounds of their own.
    """
    for item in dataclasses.fields(parameters):
        value = getattr(parameters, item.name)
        bounds = item.metadata.get(BOUNDS, Bounds())
        numbers = _numbers(value)
        if item.metadata.get(BOUNDS) and not numbers:
            raise ValueError(f"{item.name} = {value!r}: expected {bounds}")
        if not all(bounds.hold(one) for one in numbers):
            raise ValueError(f"{item.name} = {_shown(value)}: expected {bounds}")
        if bounds.rising and not numbers[0] <= numbers[-1]:
            raise ValueError(f"{item.name} = {_shown(value)}: expected [low, high] with low <= high")


def _numbers(value: Any) -> list[float]:
    """The numbers in a field's value; none where it is something else."""
    if isinstance(value, bool | str) or value is None:
        return []
    if isinstance(value, Iterable):
        return [one for part in value for one in _numbers(part)]
    return [value] if isinstance(value, int | float) else []


def _shown(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
