"""The one way to check a parameter: what is taken becomes the annotated type, what is not is named
with its bounds."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest

from lidarsim.parameters import Bounds, check, number, shown
from scenegen.worlds.kinds.kind import bounds_by_name
from tests.command_line import rows

if TYPE_CHECKING:
    from nowhere import Unknown


@dataclass(frozen=True, kw_only=True)
class Sensor:
    rows: int = number(16, least=1, most=1000)
    range_m: float = number(10.0, above=0)
    tilt_deg: float = number(0.0, least=-90, below=90)
    shape: tuple[int, int, int] = number((8, 8, 4), least=1)
    span_m: tuple[float, float] = number((1.0, 2.0), least=0, most=9, rising=True)
    edges_m: tuple[float, ...] = number((1.0,), above=0)
    even: float = number(2.0, whole=True)
    limit: float | None = number(None, above=0)
    mount: Literal["tilt", "band"] = "tilt"
    spin: bool = True
    name: str = "vlp"
    anything: Any = None

    def __post_init__(self):
        check(self)


TAKEN = [
    ("rows", 1, 1),
    ("rows", np.int32(7), 7),
    ("range_m", np.float32(0.5), 0.5),
    ("range_m", 5e-324, 5e-324),
    ("shape", [1, 2.0, 10**12], (1, 2, 10**12)),
    ("span_m", (2, 2), (2.0, 2.0)),
    ("edges_m", [], ()),
    ("edges_m", [1, 2, 3], (1.0, 2.0, 3.0)),
    ("limit", None, None),
    ("mount", "band", "band"),
    ("spin", False, False),
    ("anything", {"a": 1}, {"a": 1}),
]


@pytest.mark.parametrize(("name", "value", "kept"), TAKEN)
def test_what_fits_becomes_the_annotated_type(name, value, kept):
    found = getattr(Sensor(**{name: value}), name)
    assert found == kept
    assert type(found) is type(kept)
    if isinstance(kept, tuple):
        assert [type(one) for one in found] == [type(one) for one in kept]


REFUSED = f"""
rows     → 0            → rows = 0: expected a whole number from 1 to 1000
rows     → 2.5          → rows = 2.5: expected a whole number from 1 to 1000
rows     → true         → rows = True: expected a whole number
rows     → "16"         → rows = '16': expected a whole number
range_m  → 0.0          → range_m = 0.0: expected a finite number above 0
range_m  → Infinity     → range_m = inf: expected a finite number above 0
range_m  → 1{"0" * 400} → range_m = 1000
tilt_deg → 90           → tilt_deg = 90: expected a finite number at least -90 and below 90
shape    → [8, 8]       → shape = [8, 8]: expected three whole numbers at least 1, such as [8, 8, 4]
shape    → "888"        → shape = '888': expected three whole numbers
shape    → {{"8": 8, "9": 9, "4": 4}} → expected three whole numbers
shape    → [8, [8], 4]  → shape = [8, [8], 4]: expected three whole numbers
span_m   → [2.0, 1.0]   → span_m = [2.0, 1.0]: expected [low, high] with low <= high, \
finite numbers from 0 to 9
edges_m  → [1.0, 0.0]   → edges_m = [1.0, 0.0]: expected a list, each a finite number above 0
even     → 2.5          → even = 2.5: expected a whole number
limit    → 0            → limit = 0: expected a finite number above 0 or none
mount    → "gimbal"     → mount = 'gimbal': expected 'tilt' or 'band'
mount    → ["tilt"]     → mount = ['tilt']: expected 'tilt' or 'band'
spin     → 1            → spin = 1: expected true or false
name     → 3            → name = 3: expected text
anything → [1.0, [NaN]] → anything = [1.0, [nan]]: expected a finite number
"""


@pytest.mark.parametrize(("name", "value", "line"), rows(REFUSED))
def test_what_does_not_fit_is_named_with_its_bounds(name, value, line):
    with pytest.raises(ValueError) as error:
        Sensor(**{name: json.loads(value)})
    assert line in str(error.value)


def test_a_value_is_shown_on_one_short_line():
    huge, nested = 1 << 100_000, []  # the one of more digits than Python turns into text
    for _ in range(100_000):
        nested = [nested]
    for value in ("a\nb\x1b[2J" * 100, huge, nested, ["\u202e"]):
        said = shown(value)
        assert said.isprintable()
        assert said.isascii()
        assert len(said) <= 60


def test_annotations_that_only_a_type_checker_can_resolve_leave_the_bounds():
    @dataclass(frozen=True)
    class Odd:
        thing: Unknown = None
        rows: int = number(3, least=1)

    check(Odd())
    with pytest.raises(ValueError, match="rows = 0: expected a finite number at least 1"):
        check(Odd(rows=0))
    with pytest.raises(ValueError, match="rows = 'many'"):
        check(Odd(rows="many"))  # type: ignore[arg-type]


def test_fields_without_bounds_have_those_of_their_name():
    @dataclass(frozen=True)
    class Kind:
        share: Any = 0.5
        rows: Any = number(3, least=1)

    def by_name(name, value):
        return Bounds(least=0, most=1) if name == "share" else Bounds(most=0)

    check(Kind(), by_name)
    with pytest.raises(ValueError, match=r"share = 1.5: expected a finite number from 0 to 1"):
        check(dataclasses.replace(Kind(), share=1.5), by_name)


@pytest.mark.parametrize("field", ["plain_m", "bounded_m", "bounded_count", "unresolved_m"])
@pytest.mark.parametrize("value", [(4.0, 2.0), np.array([4.0, 2.0])])
def test_ranges_of_a_kind_rise_within_bounds_of_their_own(field, value):
    with pytest.raises(ValueError, match=rf"^{field} = .*4.*2.*: expected "):
        Ranges(**{field: value})
    assert tuple(getattr(Ranges(**{field: (2.0, 4.0)}), field)) == (2, 4)
    assert tuple(getattr(Ranges(**{field: (3.0, 3.0)}), field)) == (3, 3)


def test_a_pair_that_is_no_range_says_so():
    assert Ranges(place_m=(4.0, 2.0)).place_m == (4.0, 2.0)
    with pytest.raises(ValueError, match="two finite numbers at least 1"):
        Ranges(place_m=(4.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """As a kind of worlds checks its parameters: by name, where a field has no bounds."""

    plain_m: tuple[float, float] = (1.0, 2.0)
    bounded_m: tuple[float, float] = number((1.0, 2.0), least=1.0)
    bounded_count: tuple[int, int] | None = number((1, 2), least=1)
    unresolved_m: Any = number((1.0, 2.0), least=1.0)
    place_m: tuple[float, float] = number((1.0, 2.0), least=1.0, rising=False)

    def __post_init__(self):
        check(self, bounds_by_name)


@pytest.mark.parametrize(
    ("value", "degrees"),
    [(6.28, 360), (math.pi / 2, 90), (-0.5236, -30)],
)
def test_angles_in_radians_are_told_from_degrees(value, degrees):
    @dataclass(frozen=True, kw_only=True)
    class Held:
        tilt_deg: float = number(0.0, least=-90, most=360)
        length_m: float = number(1.0)

        def __post_init__(self):
            check(self)

    with pytest.raises(
        ValueError, match=rf"^tilt_deg = \S+: is {degrees} degrees in radians; expected degrees$"
    ):
        Held(tilt_deg=value)
    assert Held(tilt_deg=math.copysign(15.0, value), length_m=value).length_m == value
