"""Parameters of dataclasses: bounds stand beside the default, and are checked when an object is
made."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

MAX_RAYS = 1_000_000
"""The most rays of one scan."""
MIN_RANGE_M, MAX_RANGE_M = 1e-3, 1e4
"""Bounds of a sensor's range, metres. Ranges are stored in float32, which here still resolves
millimetres."""
MIN_RETURN_M = 0.1
"""The minimum range of unknown sensors, metres: nearer points are the carrier, or rays without a
return."""
MAX_LENGTH_M = 1e6
"""Sizes and places in a world, metres: float64 then keeps a tenth of a nanometre."""
MAX_TRIANGLES = 5_000_000
"""The most triangles of a world's meshes and height fields, each counted as often as a geom uses
it: 360 MB."""


BOUNDS = "bounds"
"""Key of a field's metadata for its `Bounds`."""
FILE = "file"
"""Key of the metadata of fields for which a table may give the path of a file."""
MAX_TEXT = 300
"""The most characters of a sensor's description of itself."""
MAX_SHOWN = 60
"""The most characters of a value that an error repeats."""
_COUNTED = {2: "two", 3: "three", 4: "four"}


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """The values that a number, or each number of a tuple, may have. All must be finite."""

    minimum: float = -math.inf
    """The least value allowed."""
    maximum: float = math.inf
    """The greatest value allowed."""
    above: float = -math.inf
    """The value must be greater than this."""
    below: float = math.inf
    """The value must be less than this."""
    whole: bool = False
    """Only whole numbers are allowed; fields annotated `int` are so anyway."""
    rising: bool | None = None
    """A tuple of two is a lower and an upper bound, in this order; equal ones are allowed. None
    leaves that to `otherwise` of `check`, and without it means False."""

    def hold(self, value: float) -> bool:
        """Return whether `value` lies within the bounds."""
        try:
            finite = math.isfinite(value)
        except OverflowError:  # a whole number beyond all floats
            return False
        inside = (
            finite and self.minimum <= value <= self.maximum and self.above < value < self.below
        )
        return inside and (not self.whole or float(value).is_integer())

    def __str__(self) -> str:
        """Describe the bounds: "a whole number from 1 to 1000"."""
        return self.words(whole=self.whole)

    def words(self, *, whole: bool, count: int = 1) -> str:
        """Describe the bounds in words.

        Args:
            whole: Whether numbers must be whole.
            count: How many numbers a value has.

        Returns:
            A phrase such as "[low, high] with low <= high, finite numbers above 0".
        """
        phrase = f"{'whole' if whole else 'finite'} number"
        rising = (
            "[low, high] with low <= high,"
            if self.rising and count == 2
            else _COUNTED.get(count, str(count))
        )
        phrase = f"a {phrase}" if count == 1 else f"{rising} {phrase}s"
        if math.isfinite(self.minimum) and math.isfinite(self.maximum):
            return f"{phrase} from {self.minimum:.12g} to {self.maximum:.12g}"
        bounds = {
            "above": self.above,
            "at least": self.minimum,
            "below": self.below,
            "at most": self.maximum,
        }
        limits = [f"{name} {bound:.12g}" for name, bound in bounds.items() if math.isfinite(bound)]
        return f"{phrase} {' and '.join(limits)}".rstrip()


def number(default: Any = dataclasses.MISSING, **bounds: Any) -> Any:
    """Define a dataclass field whose value, or each number in it, keeps bounds.

    Args:
        default: The field's default.
        **bounds: Fields of `Bounds`.

    Returns:
        The field.
    """
    return field(default=default, metadata={BOUNDS: Bounds(**bounds)})


def check(
    parameters: Any, otherwise: Callable[[str, Any], Bounds] = lambda name, value: Bounds()
) -> None:
    """Check every field of a dataclass against its annotation and its bounds.

    Annotations may be numbers, bool, str, Literal, dataclasses, and tuples or unions of these.
    Values of the right kind become the annotated type: a list a tuple, a whole float an int. An
    angle in degrees that is a multiple of 15 in radians is refused: 6.283 is a turn, and not
    6.283°. A field that names a file is not checked.

    Args:
        parameters: The dataclass; converted values are set in place, also if it is frozen.
        otherwise: Gives the bounds of a field without bounds of its own, from its name and value;
            by default, numbers must be finite. If it says that values rise, they must do so also
            within bounds of the field's own, unless these say `rising=False`.

    Raises:
        ValueError: If a value has another type or is out of bounds; the message names the field.
    """
    kind_of: type = type(parameters)
    hints = _hints(kind_of)
    for item in dataclasses.fields(parameters):
        if FILE in item.metadata:
            continue
        raw = getattr(parameters, item.name)
        kind = hints.get(item.name, Any)
        usual = otherwise(item.name, _plain(raw))
        bounds: Bounds = item.metadata.get(BOUNDS, usual)
        if bounds.rising is None and usual.rising:
            # bounds of a field's own say how far a range may reach, and leave it a range
            bounds = dataclasses.replace(bounds, rising=True)
        try:
            value = _read(raw, kind, bounds)
        except _UnfitError:
            example = (
                f", such as {short_repr(item.default)}"
                if isinstance(item.default, tuple) and item.default
                else ""
            )
            raise ValueError(
                f"{item.name} = {short_repr(raw)}: expected {_words(kind, bounds)}{example}"
            ) from None
        if item.name.endswith("_deg") and isinstance(value, float) and (turn := _radians(value)):
            raise ValueError(
                f"{item.name} = {short_repr(raw)}: is {turn} degrees in radians; expected degrees"
            )
        # frozen dataclasses are checked, too
        if value is not raw:
            object.__setattr__(parameters, item.name, value)


class Checked:
    """Base of a dataclass whose fields are checked when it is made."""

    def __post_init__(self) -> None:
        check(self)


def _radians(value: float) -> int:
    """Return the multiple of 15 degrees that `value` is in radians, within 0.1 %, or 0."""
    steps = round(value / (math.pi / 12))
    # 24 steps are a turn; larger values are no likely angles in radians
    is_near = abs(steps) <= 24 and math.isclose(value, steps * math.pi / 12, rel_tol=1e-3)
    return 15 * steps if is_near else 0


def check_text(name: str, text: str) -> None:
    """Check that a text is short and printable.

    Args:
        name: The text's name, for the message.
        text: The text.

    Raises:
        ValueError: If it has more than `MAX_TEXT` characters, or unprintable ones.
    """
    if len(text) > MAX_TEXT or not text.isprintable():
        raise ValueError(
            f"{name} = {short_repr(text)}: expected {MAX_TEXT} printable characters at most"
        )


def short_repr(value: Any) -> str:
    """Represent a value in an error's line: escaped, tuples as lists, cut if it is long."""
    try:
        text = ascii(list(value) if isinstance(value, tuple) else value)
        text = " ".join(map(str.strip, text.splitlines()))  # an array has several lines
    except (ValueError, RecursionError):  # a number of thousands of digits, or nested without end
        return f"a value of type {type(value).__name__}"
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 3]}..."


class _UnfitError(Exception):
    """A value is not of its field's type, or out of its bounds."""


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """Return the fields' annotations; none if some can be resolved only by a type checker."""
    try:
        return get_type_hints(kind)
    except NameError:
        return {}


def _plain(value: Any) -> Any:
    """Convert NumPy's scalars and arrays to Python's numbers and lists; return other values
    unchanged."""
    return value.tolist() if hasattr(value, "tolist") else value


def _read(raw: Any, kind: Any, bounds: Bounds) -> Any:
    """Convert `raw` to the type `kind` within `bounds`. Raises _UnfitError if it does not fit."""
    value = _plain(raw)
    origin, options = get_origin(kind), get_args(kind)
    if kind in (bool, str, NoneType):
        fits = isinstance(value, kind)
    elif kind in (int, float):
        bounds = dataclasses.replace(bounds, whole=bounds.whole or kind is int)
        # bool is a subclass of int
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        fits = is_number and bounds.hold(value)
        value = kind(value) if fits else value
    elif origin is Literal:
        # True == 1, which is another option
        fits = any(type(value) is type(option) and value == option for option in options)
    elif origin is tuple:
        return _read_tuple(value, options, bounds)
    elif origin in (Union, UnionType):
        # the first type of a union that fits wins
        for option in options:
            with suppress(_UnfitError):
                return _read(raw, option, bounds)
        fits = False
    elif isinstance(kind, type) and dataclasses.is_dataclass(kind):
        value, fits = raw, isinstance(raw, kind)
    else:
        # an annotation that cannot be resolved, or a type of somebody's own: only numbers are held
        # against bounds, and where there are bounds, there must be some
        value, numbers = raw, _numbers(value)
        fits = all(map(bounds.hold, numbers)) and (bool(numbers) or bounds == Bounds())
        fits = fits and not (bounds.rising and numbers[:1] > numbers[-1:])
    if not fits:
        raise _UnfitError
    return value


def _read_tuple(value: Any, kinds: tuple[Any, ...], bounds: Bounds) -> tuple[Any, ...]:
    """Convert a list or tuple to a tuple of `kinds`, or of any length if these are (kind, ...)."""
    if not isinstance(value, list | tuple):
        raise _UnfitError
    if kinds[1:] == (...,):
        kinds = kinds[:1] * len(value)
    if len(value) != len(kinds):
        raise _UnfitError
    read = tuple(_read(part, kind, bounds) for part, kind in zip(value, kinds, strict=True))
    if bounds.rising and read[:1] > read[-1:]:
        raise _UnfitError
    return read


def _numbers(value: Any) -> list[float]:
    """List the numbers in a value of any type."""
    if isinstance(value, bool | str) or value is None:
        return []
    if isinstance(value, Iterable):
        return [leaf for part in value for leaf in _numbers(part)]
    return [value] if isinstance(value, int | float) else []


def _words(kind: Any, bounds: Bounds) -> str:
    """Describe the values that `_read` accepts."""
    origin, options = get_origin(kind), get_args(kind)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return f"an instance of {kind.__name__}"
    plain = {bool: "true or false", str: "text", NoneType: "none"}
    if kind in plain:
        return plain[kind]
    if origin is Literal:
        return " or ".join(repr(option) for option in options)
    if origin is tuple and options[1:] != (...,) and set(options) <= {int, float}:
        return bounds.words(whole=bounds.whole or set(options) == {int}, count=len(options))
    if origin is tuple and options[1:] == (...,):
        return f"a list, each {_words(options[0], bounds)}"
    if origin is tuple:
        return f"{len(options)} values"
    if origin in (Union, UnionType):
        return " or ".join(_words(option, bounds) for option in options)
    return bounds.words(whole=bounds.whole or kind is int)
