"""Write the tables of parameters that stand in the docs, from the dataclasses that hold them.

    python docs/tables.py          # rewrites the pages
    python docs/tables.py --check  # ends with 1 where a page is not what would be written

A page asks for a table by two comments, between which it goes:

    <!-- parameters of scenegen.worlds.flight:FlightConfig -->
    <!-- end -->

`<!-- sensors -->` asks for the catalogue of sensors in the same way, `<!-- stages -->` for the
stages of noise, and `<!-- kinds -->` for what all kinds of worlds have.
"""

import ast
import dataclasses
import importlib
import inspect
import math
import re
import sys
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from lidarsim.noise import STAGES
from lidarsim.parameters import BOUNDS, Bounds
from lidarsim.sensors import CATALOGUE, SENSORS
from lidarsim.sensors.device import angles_deg
from scenegen.worlds.kinds import KINDS, kind_names
from scenegen.worlds.kinds.kind import WorldKind, bounds_by_name

PAGES = Path(__file__).parent
ASKED = re.compile(r"(<!-- parameters of ([\w.]+):(\w+) -->\n).*?(<!-- end -->)", re.S)
UNIT = re.compile(r", (metres|degrees)( a second( squared| cubed)?)?(?=[.;:]| \(paper)")
"""A unit at the end of a meaning: names end with their units, so tables leave it out."""
WORLD = "; one value a world"
AREA = re.compile(r",? per square metre(?=\.)")
"""What the end `density` of a name tells."""
SHARED = ("size_m", "ground", "ground_m")
"""Parameters of every kind of worlds, which stand in a table of all kinds."""


def meanings(kind: type) -> dict[str, str]:
    """The docstring of every field of a dataclass, its bases' included, on one line, without the
    source of its default."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        try:
            (body,) = ast.parse(inspect.cleandoc("\n" + inspect.getsource(base))).body
        except (OSError, TypeError):  # a base without source, such as ABC in C
            continue
        assert isinstance(body, ast.ClassDef)
        for item, after in zip(body.body, body.body[1:], strict=False):
            match item, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(
                    value=ast.Constant(value=str(text))
                ):
                    meaning = " ".join(text.split()).replace("|", "/").replace(" (ours)", "")
                    found[name] = UNIT.sub("", meaning.partition(" Source: ")[0])
    return found


def table(kind: type[Any]) -> str:
    """The parameters of a dataclass: name, default and allowed values, and the meaning. Fields
    that are such dataclasses themselves are left out: they have tables of their own."""
    said = meanings(kind)
    if issubclass(kind, WorldKind):
        return kind_table(kind, said)
    lines = ["| parameter | default (allowed) | meaning |", "|---|---|---|"]
    types = get_type_hints(kind)
    for item in dataclasses.fields(kind):
        if item.default_factory is dataclasses.MISSING:
            values = _value(item.default)
            if get_origin(types[item.name]) is Literal:
                choices = [_value(choice) for choice in get_args(types[item.name])]
                values = " or ".join(sorted(choices, key=lambda choice: choice != values))
            elif allowed := _allowed(item.metadata.get(BOUNDS, Bounds())):
                values += f" ({allowed})"
            lines.append(f"| `{item.name}` | {values} | {said[item.name]} |")
    return "\n".join(lines) + "\n"


def kind_table(kind: type[WorldKind], said: dict[str, str]) -> str:
    """The parameters that only this kind of worlds has: name (with a star where one value is drawn
    for a world), the values of its three presets (a single value where they do not differ), and the
    meaning, with the values allowed where the name does not tell them."""
    lines = ["| parameter | easy · medium · hard | meaning |", "|---|---|---|"]
    for item in dataclasses.fields(kind):
        if item.name in SHARED:
            continue
        usual = bounds_by_name(item.name, item.default)
        bounds = item.metadata.get(BOUNDS, usual)
        meaning = said[item.name]
        if item.name.endswith("_share"):
            meaning = re.sub("^Share of (.)", lambda found: found[1].upper(), meaning)
        if str(bounds) != str(usual):
            meaning += f" Allowed: {_allowed(bounds)}."
        levels = [
            kind.graded.get(level, {}).get(item.name, item.default)
            for level in ("easy", "medium", "hard")
        ]
        values = [_value(value) for value in levels]
        star = "\\*" if WORLD in meaning else ""
        cells = (
            f"`{item.name}`{star}",
            values[0] if len(set(values)) == 1 else " · ".join(values),
            AREA.sub("", meaning.replace(f"{WORLD}, drawn so that", ";").replace(WORLD, "")),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def kinds() -> str:
    """What all kinds of worlds have: size, ground, and the parameters of flights and of acceptance
    in which their presets differ from the general defaults."""
    heads = ("kind", "`size_m`", "`[flight] altitude_m`", "others")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in kind_names():
        kind = KINDS.find(name)
        flight = dict(kind.flight_defaults)
        cells = [
            f"[`{name}`](#{name})",
            _value(field_default(kind, "size_m")),
            _value(flight.pop("altitude_m")),
        ]
        tables = {"flight": flight, "accept": kind.accept_defaults}
        others = [
            f"`[{table}] {parameter}` {_value(value)}"
            for table, values in tables.items()
            for parameter, value in values.items()
        ]
        lines.append(f"| {' | '.join([*cells, ', '.join(others)])} |")
    return "\n".join(lines) + "\n"


def field_default(kind: type, name: str) -> Any:
    """The default of a field of a dataclass."""
    return next(item.default for item in dataclasses.fields(kind) if item.name == name)


def _allowed(bounds: Bounds) -> str:
    """Bounds as a table writes them, such as "0–1", "±90" or ">0, ≤80"; "" without bounds."""
    low, high = bounds.minimum, bounds.maximum
    if math.isfinite(low) and math.isfinite(high):
        return f"±{high:.12g}" if low == -high else f"{low:.12g}–{high:.12g}"
    limits = ((">", bounds.above), ("≥", low), ("<", bounds.below), ("≤", high))
    return ", ".join(f"{sign}{value:.12g}" for sign, value in limits if math.isfinite(value))


def sensors() -> str:
    """The catalogue: name with a link to its picture, rays of a scan, angles, range and noise."""
    heads = ("sensor", "rays", "a scan", "elevations", "range", "`--noise datasheet`")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in CATALOGUE:
        sensor = SENSORS.find(name)
        height = angles_deg(sensor.directions_body)[0].round(2)
        last = float(sensor.times_s.max())
        cells = (
            f"[{name}](pictures/sensors/{name}.png)",
            " × ".join(map(str, sensor.shape)),
            f"{last:.2g} s" if last else "at once",
            f"{height.min():g}…{height.max():g}°",
            f"{sensor.min_range_m:g}…{sensor.max_range_m:g} m",
            f"`{sensor.noise}`",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def stages() -> str:
    """The stages of noise: name, values with their defaults, and what they do."""
    lines = ["| stage | values, in this order | what it does |", "|---|---|---|"]
    for name in STAGES.builtin:
        kind = STAGES.find(name)
        values = ", ".join(
            f"`{item.name}` {_value(item.default).strip('`')}" for item in dataclasses.fields(kind)
        )
        does = " ".join((inspect.getdoc(kind) or "").replace("``", "`").split()).replace("|", "/")
        lines.append(f"| `{name}` | {values} | {does} |")
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """A default as TOML writes it."""
    if value is dataclasses.MISSING or value is None:
        return "none"
    if isinstance(value, tuple):
        return f"`[{', '.join(_value(one).strip('`') for one in value)}]`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`"


def filled(page: str) -> str:
    """A page with every table that it asks for."""

    def fill(found: re.Match[str]) -> str:
        kind = getattr(importlib.import_module(found[2]), found[3])
        return f"{found[1]}{table(kind)}{found[4]}"

    page = ASKED.sub(fill, page)
    for name, made in (("sensors", sensors), ("stages", stages), ("kinds", kinds)):
        if (mark := f"<!-- {name} -->\n") in page:
            before, _, rest = page.partition(mark)
            page = f"{before}{mark}{made()}<!-- end -->{rest.partition('<!-- end -->')[2]}"
    return page


if __name__ == "__main__":
    stale = []
    for path in sorted(PAGES.glob("*.md")):
        text = path.read_text()
        if filled(text) != text:
            stale.append(path.name)
            if "--check" not in sys.argv:
                path.write_text(filled(text))
    if stale and "--check" in sys.argv:
        sys.exit(f"{', '.join(stale)}: not as the code says; run python docs/tables.py")
