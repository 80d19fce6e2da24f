"""TOML tables and the dataclasses made of them, with errors that name the file, the table and the
parameter; and the table [lidar]."""

import dataclasses
import itertools
import json
import re
import tomllib
from pathlib import Path
from typing import Any

from numpy.random import Generator

from lidarsim import BeamTable, Sensor
from lidarsim.noise.chain import Noise
from lidarsim.parameters import FILE, short_repr
from lidarsim.registry import suggestion
from lidarsim.sensors import FAMILIES, RASTER, SENSORS
from scenegen.base.errors import DatasetError, RecipeError, printable, reraise_as
from scenegen.base.files import Json
from scenegen.base.limits import MAX_DEPTH, MAX_RECIPE_BYTES, MAX_SOURCES
from scenegen.base.reading import read_bounded

_DECIMAL = re.compile(r"(?<![\w.])\d+\.\d+(?:[eE][-+]?\d+)?(?![\w.])")
"""A decimal number, whose dot is not that of a dotted key; a list of beams has many in a line."""
_INTERVAL = re.compile(
    r"(?<![\w.])(-?\d{1,9}(?:\.\d{1,9})?)\.\.(-?\d{1,9}(?:\.\d{1,9})?)(?![\w.])", re.ASCII
)
"""An interval in a domain: 0.01..0.05, or 1..5 for whole numbers."""


def read_toml(path: Path) -> Json:
    """Read a TOML file.

    Args:
        path: The file.

    Returns:
        Its tables.

    Raises:
        RecipeError: If it is not valid TOML, too large, or nested too deeply; the message names the
            file.
    """
    where = printable(path)
    try:
        text = read_bounded(path, MAX_RECIPE_BYTES).decode()
        lines = (
            _DECIMAL.sub("", line)
            for line in text.splitlines()
            if not line.lstrip().startswith("#")
        )
        if any(line.count(".") > MAX_DEPTH for line in lines):
            # dotted keys: tomllib's time grows with the square of their depth, or worse
            raise RecursionError
        return tomllib.loads(text)
    except DatasetError as error:
        raise RecipeError(printable(error)) from None
    except ValueError as error:  # TOMLDecodeError, and int()'s for thousands of digits
        raise RecipeError(f"{where}: not valid TOML: {printable(error)}") from None
    except RecursionError:
        raise RecipeError(f"{where}: nested too deeply; expected tables of parameters") from None


def from_table(part: Any, table: Json, where: str, folder: Path) -> Any:
    """Make a dataclass from a table.

    Args:
        part: The dataclass; or an instance, of which a copy is changed.
        table: Values by field.
        where: The table's name, for messages.
        folder: Paths in the table are relative to it.

    Returns:
        The instance, with checked values.

    Raises:
        RecipeError: If a parameter is unknown, missing or invalid.
    """
    fields = {item.name: item for item in dataclasses.fields(part)}
    values = {}
    for name, value in table.items():
        check_name(name, tuple(fields), "parameter", where)
        is_path = fields[name].type in (Path, "Path") or FILE in fields[name].metadata
        values[name] = folder / value if is_path and isinstance(value, str) else value
    for name, item in fields.items():
        needed = item.default is item.default_factory is dataclasses.MISSING
        if needed and name not in table and isinstance(part, type):
            raise RecipeError(f"{where} {name}: is missing, and has no default; give it a value")
    try:
        return part(**values) if isinstance(part, type) else dataclasses.replace(part, **values)
    except (ValueError, TypeError) as error:  # a user's own sensor may raise either
        raise RecipeError(f"{where} {printable(error)}") from None


def field_names(part: Any) -> set[str]:
    """Return the keys that a table of the dataclass `part` may have."""
    return {item.name for item in dataclasses.fields(part)}


def check_name(name: Any, known: tuple[str, ...], noun: str, where: str) -> None:
    """Check that a name is known.

    Args:
        name: The name.
        known: The known names.
        noun: What it names, for the message: "table".
        where: Its source, for the message.

    Raises:
        RecipeError: If it is unknown; the message suggests the nearest.
    """
    if name not in known:
        hint = suggestion(str(name), known)
        raise RecipeError(
            f"{where}{': ' if where else ''}unknown {noun} {short_repr(name)}; {hint}"
        )


def named_lidar(word: str | Sensor) -> Sensor:
    """Find the sensor that an option --lidar names.

    Args:
        word: A name in `SENSORS`, a user's own, or a file that ends in .toml with the entries of a
            recipe's [lidar]; a sensor is returned unchanged.

    Returns:
        The sensor.

    Raises:
        RecipeError: If there is no such sensor.
    """
    if not isinstance(word, str):
        if not hasattr(word, "directions_body"):
            raise RecipeError(
                f"lidar = {short_repr(word)}: expected a sensor, the name of one, or a .toml file"
            )
        return word
    path = Path(word)
    if path.suffix != ".toml":
        return sensor_of({"sensor": word}, "lidar:", Path())
    table = read_toml(path)
    if isinstance(table.get("lidar"), dict):
        raise RecipeError(
            f"{printable(path)}: has a table [lidar]; expected its parameters at the top, without "
            f"a table"
        )
    return sensor_of(table, printable(path), path.parent)


def named_noise(text: str | Noise | None, sensor: Sensor, where: str = "") -> Noise:
    """Read a chain of noise.

    Args:
        text: See `Noise.parse`; None for no noise.
        sensor: The sensor, for ``datasheet``.
        where: The beginning of the error's line.

    Returns:
        The chain.

    Raises:
        RecipeError: If the text names no chain.
    """
    with reraise_as(RecipeError, where and f"{where} "):
        return Noise() if text is None else Noise.parse(text, sensor)


def sensor_of(table: Json, where: str, folder: Path) -> Sensor:
    """Make the sensor of a table [lidar].

    Args:
        table: `sensor` names the class; the other entries are its parameters.
        where: The beginning of the error's line.
        folder: Paths in the table are relative to it.

    Returns:
        The sensor.

    Raises:
        RecipeError: If the table is invalid.
    """
    entries = dict(table)
    name = entries.pop("sensor", RASTER)
    with reraise_as(RecipeError, f"{where} "):
        kind = SENSORS.find(name if isinstance(name, str) else short_repr(name))
    if not dataclasses.is_dataclass(kind):
        raise RecipeError(
            f"{where} sensor = {short_repr(name)}: expected a dataclass, whose fields a recipe sets"
        )
    if isinstance(entries.get("name"), str) and entries["name"] in SENSORS.builtin:
        raise RecipeError(
            f"{where} name = {short_repr(entries['name'])}: is that of another; give your "
            "sensor a name "
            f'of its own, or take that one with sensor = "{entries["name"]}"'
        )
    # the default is a raster; name the families that have all these parameters
    if "sensor" not in table and (unknown := sorted(entries.keys() - field_names(kind))):
        fit = [
            f'"{family}"'
            for family in FAMILIES
            if entries.keys() <= field_names(SENSORS.find(family))
        ]
        if fit:
            raise RecipeError(
                f"{where} {unknown[0]}: is no parameter of a raster; say which sensor it is, "
                f"sensor = {' or '.join(fit)}"
            )
    sensor = from_table(kind, entries, where, folder)
    if isinstance(noise := getattr(sensor, "noise", None), str) and noise:
        with reraise_as(RecipeError, f"{where} "):
            # tried now: else a fault in it shows only when `datasheet` is asked for
            Noise.parse(noise)
    # tried now, so that faults of a user's own code show before any world is drawn
    if name not in SENSORS.builtin:
        with reraise_as(RecipeError):
            beam_table(sensor, where)
    return sensor


def beam_table(sensor: Sensor, where: str = "[lidar]") -> BeamTable:
    """Tabulate the rays of any sensor.

    Args:
        sensor: The sensor.
        where: The beginning of the error's line.

    Returns:
        The table.

    Raises:
        ValueError: If it cannot be tabulated, whatever a user's own code raises.
    """
    try:
        return BeamTable.of(sensor)
    except Exception as error:
        reason = error if isinstance(error, ValueError) else f"it fails: {error!r}"
        raise ValueError(f"{where} sensor {type(sensor).__name__}: {printable(reason)}") from None


def combinations(domain: Any, at: str, rng: Generator) -> list[dict[str, Json]]:
    """List every combination of the values of a [domain].

    If values have intervals, each combination is drawn `draws` times, with numbers from these.

    Args:
        domain: The table [domain] of a recipe.
        at: Its source, for messages.
        rng: Draws the numbers.

    Returns:
        Tables of a recipe, one for each.

    Raises:
        RecipeError: If the domain is invalid, or has too many combinations.
    """
    rows = dict(domain) if isinstance(domain, dict) else {"": domain}
    draws = rows.pop("draws", 0)
    if not all(isinstance(row, dict) for row in rows.values()):
        raise RecipeError(
            f"{at}: domain: expected tables of lists, such as [domain.lidar] with a line "
            'sensor = ["raster", "ouster-os1-64"]'
        )
    listed = {
        # an interval may stand alone, without a list around it
        (table, name): [values] if isinstance(values, str) else values
        for table, row in rows.items()
        for name, values in row.items()
    }
    for (table, name), values in listed.items():
        if not isinstance(values, list) or not values:
            raise RecipeError(
                f"{at}: domain.{table}.{name} = {short_repr(values)}: expected a list of "
                "values, or an "
                'interval, such as "0.01..0.05"'
            )
    # looked for in the text of all values, since intervals may stand deep in nested lists
    if type(draws) is not int or (draws > 0) != bool(_INTERVAL.search(str(listed))):
        raise RecipeError(
            f"{at}: domain.draws = {short_repr(draws)}: expected how often to draw, such as "
            "10, where a "
            "value has an interval, such as 0.01..0.05, and nothing elsewhere"
        )
    # `product` would make a tuple of the range, however long
    times = range(min(max(draws, 1), MAX_SOURCES + 1))
    chosen = itertools.product(times, *listed.values())
    tables: list[dict[str, Json]] = []
    for _, *chosen_values in itertools.islice(chosen, MAX_SOURCES + 1):
        tables.append({})
        for (table, name), value in zip(listed, chosen_values, strict=True):
            tables[-1].setdefault(table, {})[name] = _drawn(value, rng)
    if len(tables) > MAX_SOURCES:
        raise RecipeError(f"{at}: domain: more than {MAX_SOURCES} combinations; list or draw fewer")
    return tables


def _drawn(value: Any, rng: Generator) -> Any:
    """Replace each interval in a value by a number from it, with four digits, for people to read it
    in the manifest."""
    if isinstance(value, list):
        return [_drawn(part, rng) for part in value]
    if not isinstance(value, str):
        return value

    def number(interval: re.Match[str]) -> str:
        # an interval may be written from its greater end
        low, high = sorted(interval.groups(), key=float)
        if "." in low + high:
            return f"{rng.uniform(float(low), float(high)):.4g}"
        return str(rng.integers(int(low), int(high), endpoint=True))

    text = _INTERVAL.sub(number, value)
    # alone, an interval becomes a number; within a text, such as noise's, it stays text
    return json.loads(text) if _INTERVAL.fullmatch(value) else text
