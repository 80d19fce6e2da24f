"""The one way to check a parameter: what is taken becomes the annotated type, what is not is named
with its bounds."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest

from lidarsim.parameters import Bounds, check, number, short_repr
from scenegen.worlds.kinds.kind import bounds_by_name
from tests.command_line import rows
from tests.refusals import refuses

if TYPE_CHECKING:
    from nowhere import Unknown


@dataclass(frozen=True, kw_only=True)
class Sensor:
    rows: int = number(16, minimum=1, maximum=1000)
    range_m: float = number(10.0, above=0)
    tilt_deg: float = number(0.0, minimum=-90, below=90)
    shape: tuple[int, int, int] = number((8, 8, 4), minimum=1)
    span_m: tuple[float, float] = number((1.0, 2.0), minimum=0, maximum=9, rising=True)
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
rows     → 0
rows     → 2.5
rows     → true
rows     → "16"
range_m  → 0.0
range_m  → Infinity
range_m  → 1{"0" * 400}
tilt_deg → 90
shape    → [8, 8]
shape    → "888"
shape    → {{"8": 8, "9": 9, "4": 4}}
shape    → [8, [8], 4]
span_m   → [2.0, 1.0]
edges_m  → [1.0, 0.0]
even     → 2.5
limit    → 0
mount    → "gimbal"
mount    → ["tilt"]
spin     → 1
name     → 3
anything → [1.0, [NaN]]
"""


@pytest.mark.parametrize(("name", "value"), rows(REFUSED))
def test_what_does_not_fit_is_named_with_its_bounds(name, value):
    line = refuses(f"{name} {value[:20]}", Sensor, **{name: json.loads(value)})
    assert line.startswith(f"{name} = ")


def test_a_value_is_shown_on_one_short_line():
    huge, nested = 1 << 100_000, []  # the one of more digits than Python turns into text
    for _ in range(100_000):
        nested = [nested]
    for value in ("a\nb\x1b[2J" * 100, huge, nested, ["\u202e"]):
        said = short_repr(value)
        assert said.isprintable()
        assert said.isascii()
        assert len(said) <= 60


def test_annotations_that_only_a_type_checker_can_resolve_leave_the_bounds():
    @dataclass(frozen=True)
    class Odd:
        thing: Unknown = None
        rows: int = number(3, minimum=1)

    check(Odd())
    for value in (0, "many"):
        refuses(value, check, Odd(rows=value))


def test_fields_without_bounds_have_those_of_their_name():
    @dataclass(frozen=True)
    class Kind:
        share: Any = 0.5
        rows: Any = number(3, minimum=1)

    def by_name(name, value):
        return Bounds(minimum=0, maximum=1) if name == "share" else Bounds(maximum=0)

    check(Kind(), by_name)
    refuses("share", check, Kind(share=1.5), by_name)


@pytest.mark.parametrize("field", ["plain_m", "bounded_m", "bounded_count", "unresolved_m"])
@pytest.mark.parametrize("kind", [tuple, np.array])
def test_ranges_of_a_kind_rise_within_bounds_of_their_own(field, kind):
    refuses(f"{field} {kind.__name__}", Ranges, **{field: kind([4.0, 2.0])})
    for fine in ((2, 4), (3, 3)):
        assert tuple(getattr(Ranges(**{field: kind(fine)}), field)) == fine


def test_a_pair_need_not_rise_where_it_is_no_range():
    assert Ranges(place_m=(4.0, 2.0)).place_m == (4.0, 2.0)
    refuses("place_m", Ranges, place_m=(4.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """As a kind of worlds checks its parameters: by name, where a field has no bounds."""

    plain_m: tuple[float, float] = (1.0, 2.0)
    bounded_m: tuple[float, float] = number((1.0, 2.0), minimum=1.0)
    bounded_count: tuple[int, int] | None = number((1, 2), minimum=1)
    unresolved_m: Any = number((1.0, 2.0), minimum=1.0)
    place_m: tuple[float, float] = number((1.0, 2.0), minimum=1.0, rising=False)

    def __post_init__(self):
        check(self, bounds_by_name)


@pytest.mark.parametrize("value", [6.28, math.pi / 2, -0.5236])
def test_angles_in_radians_are_told_from_degrees(value):
    @dataclass(frozen=True, kw_only=True)
    class Held:
        tilt_deg: float = number(0.0, minimum=-90, maximum=360)
        length_m: float = number(1.0)

        def __post_init__(self):
            check(self)

    refuses(value, Held, tilt_deg=value)
    assert Held(tilt_deg=math.copysign(15.0, value), length_m=value).length_m == value
