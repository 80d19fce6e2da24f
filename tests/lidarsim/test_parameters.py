"""The one way to check a parameter: what is taken becomes the annotated type, what is not is named
with its bounds."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest

from lidarsim.parameters import check, number, short_repr
from scenegen.worlds.kinds.kind import bounds_by_name
from tests.refusals import refuses
from tests.scenegen import cases, each_case

if TYPE_CHECKING:
    from nowhere import Unknown


@dataclass(frozen=True, kw_only=True)
class Sensor:
    rows: int = number(16, minimum=1, maximum=1000)
    range_m: float = number(10.0, above=0)
    tilt_deg: float = number(0.0, minimum=-90, below=90)
    shape: tuple[int, int, int] = number((8, 8, 4), minimum=1)
    span_m: tuple[float, float] = number((1.0, 2.0), minimum=0, maximum=9, rising=True)
    place_m: tuple[float, float] = number((1.0, 2.0), minimum=1.0, rising=False)
    edges_m: tuple[float, ...] = number((1.0,), above=0)
    even: float = number(2.0, whole=True)
    limit: float | None = number(None, above=0)
    mount: Literal["tilt", "band"] = "tilt"
    spin: bool = True
    name: str = "vlp"
    anything: Any = None

    def __post_init__(self):
        check(self)


TAKEN = [(name, json.loads(value), kept) for name, value, kept in cases("../lidarsim/taken")]
"""In metres, half of pi is no angle in radians."""
TAKEN += [
    ("rows", np.int32(7), "7"),
    ("range_m", np.float32(0.5), "0.5"),
    ("mount", np.str_("band"), "'band'"),
    ("span_m", (2, 2), "(2.0, 2.0)"),
    ("place_m", (4.0, 2.0), "(4.0, 2.0)"),
]


@pytest.mark.parametrize(("name", "value", "kept"), TAKEN)
def test_what_fits_becomes_the_annotated_type(name, value, kept):
    actual = getattr(Sensor(**{name: value}), name)
    assert repr(actual) == kept  # which shows the type, that of parts, too


@each_case("../lidarsim/parameters", "name value")
def test_what_does_not_fit_is_named_with_its_bounds(name, value):
    line = refuses(f"{name} {value[:20]}", Sensor, **{name: json.loads(value)})
    assert line.startswith(f"{name} = ")


def test_a_value_is_shown_on_one_short_line():
    nested = []
    for _ in range(100_000):
        nested = [nested]
    # a number of more digits than Python turns into text
    for value in ("a\nb\x1b[2J" * 100, 1 << 100_000, nested, ["\u202e"]):
        text = short_repr(value)
        assert text.isprintable()
        assert text.isascii()
        assert len(text) <= 60


def test_annotations_that_only_a_type_checker_can_resolve_leave_the_bounds():
    @dataclass(frozen=True)
    class Odd:
        thing: Unknown = None
        rows: int = number(3, minimum=1)

    check(Odd())
    for value in (0, "many"):
        refuses(value, check, Odd(rows=value))


@dataclass(frozen=True, kw_only=True)
class Kind:
    """As a kind of worlds checks its parameters: by name, where a field has no bounds."""

    open_share: Any = 0.5
    rows: Any = number(3, minimum=1)
    plain_m: tuple[float, float] = (1.0, 2.0)
    count: tuple[int, int] | None = number((1, 2), minimum=1)
    unresolved_m: Any = number((1.0, 2.0), minimum=1.0)

    def __post_init__(self):
        check(self, bounds_by_name)


def test_fields_without_bounds_have_those_of_their_name():
    refuses("open_share", Kind, open_share=1.5)
    refuses("rows", Kind, rows=0)


@pytest.mark.parametrize("field", ["plain_m", "count", "unresolved_m"])
@pytest.mark.parametrize("kind", [tuple, np.array])
def test_ranges_of_a_kind_rise(field, kind):
    refuses(f"{field} {kind.__name__}", Kind, **{field: kind([4.0, 2.0])})
    for fine in ((2, 4), (3, 3)):
        assert tuple(getattr(Kind(**{field: kind(fine)}), field)) == fine
