"""Sensors as a user gives them: a table [lidar], a name of the catalogue, a TOML file, or a class
as module:Object."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lidarsim import BeamTable, Sensor
from lidarsim.noise.chain import Noise
from lidarsim.sensors import CATALOGUE, FAMILIES, RASTER, SENSORS
from scenegen.errors import RecipeError, printable, short
from scenegen.tables import field_names, from_table, read_toml


def named_lidar(word: str) -> Sensor:
    """The sensor that a word on the command line names: one of `SENSORS`, a user's own, or a file
    that ends in .toml and holds what a recipe's [lidar] does. Raises RecipeError."""
    path = Path(word)
    if path.suffix != ".toml":
        return sensor_of({"sensor": word}, "--lidar", Path())
    table = read_toml(path)
    if isinstance(table.get("lidar"), dict):
        raise RecipeError(
            f"{printable(path)}: has a table [lidar]; expected its parameters at the top, without "
            f"a table"
        )
    return sensor_of(table, printable(path), path.parent)


def named_noise(text: str | None, sensor: Sensor, where: str = "") -> Noise:
    """The chain that `text` describes, see `Noise.parse`; none for None. Raises RecipeError, which
    begins with `where`."""
    try:
        return Noise() if text is None else Noise.parse(text, sensor)
    except ValueError as error:
        raise RecipeError(f"{where} {printable(error)}" if where else printable(error)) from None


def sensor_of(table: Mapping[str, Any], where: str, folder: Path) -> Sensor:
    """The sensor of a table [lidar]: `sensor` names it, and the other entries are its parameters.
    Paths in it are relative to `folder`. Raises RecipeError, which begins with `where`."""
    given = dict(table)
    name = given.pop("sensor", RASTER)
    try:
        found = SENSORS.find(name if isinstance(name, str) else short(name))
    except ValueError as error:
        raise RecipeError(f"{where} {printable(error)}") from None
    if not dataclasses.is_dataclass(found):
        raise RecipeError(
            f"{where} sensor = {short(name)}: expected a dataclass, whose fields a recipe sets"
        )
    if isinstance(given.get("name"), str) and given["name"] in SENSORS.known:
        whose = "one of the catalogue's" if given["name"] in CATALOGUE else "that of a family"
        raise RecipeError(
            f"{where} name = {short(given['name'])}: is {whose}; give your sensor a name of its "
            f"own, or take that one "
            f'with sensor = "{given["name"]}"'
        )
    if "sensor" not in table and (odd := sorted(given.keys() - field_names(found))):
        fit = [
            f'"{family}"'
            for family in FAMILIES
            if given.keys() <= field_names(SENSORS.find(family))
        ]
        if fit:
            raise RecipeError(
                f"{where} {odd[0]}: is no parameter of a raster; say which sensor it is, sensor = "
                f"{' or '.join(fit)}"
            )
    made = from_table(found, given, where, folder)
    if isinstance(own := getattr(made, "noise", None), str) and own:
        try:
            Noise.parse(own)
        except ValueError as error:
            raise RecipeError(f"{where} {printable(error)}") from None
    return made


def beam_table(sensor: Sensor) -> BeamTable:
    """The rays of any sensor. Raises ValueError, whatever a user's own code raises."""
    try:
        return BeamTable.of(sensor)
    except Exception as error:
        said = (
            printable(error)
            if isinstance(error, ValueError)
            else f"it fails: {printable(repr(error))}"
        )
        raise ValueError(f"[lidar] sensor {type(sensor).__name__}: {said}") from None
