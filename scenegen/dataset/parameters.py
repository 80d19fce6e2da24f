"""Parameters as plain values, in manifests and recipe files: checks, comparisons, the entries of
sensor, noise and mapping, and recipes as TOML.

A sensor's entry in a manifest has the parameters of a raster, or the digest of a table of rays, the
file `rays.npy` in the dataset's folder.
"""

import json
import math
import re
from contextlib import suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from lidarsim import BeamTable, Lidar, Sensor
from lidarsim.noise import VERSION as NOISE_VERSION
from lidarsim.parameters import MAX_RAYS, MAX_SHOWN, MAX_TEXT, short_repr
from lidarsim.sensors.table import MAX_AXES, max_bytes, read_npy
from scenegen.base.errors import (
    CorruptFileError,
    DatasetError,
    UnsupportedVersionError,
    printable,
    reraise_as,
)
from scenegen.base.files import Json
from scenegen.base.reading import read_bounded, sha256_of
from scenegen.base.stores import Location, create_at, read_at
from scenegen.dataset.schema import NoiseEntry, RecipeEntry
from scenegen.worlds.mapping import Mapper

if TYPE_CHECKING:
    from lidarsim.noise.chain import Noise


def plain(value: Any) -> Any:
    """Convert a value to JSON types."""
    # a tuple becomes a list, as it is when the manifest is read again and compared
    return json.loads(json.dumps(value))


def configured(config: Any, table: Any, where: str) -> Any:
    """Make a dataclass from a table.

    Args:
        config: The dataclass.
        table: Values of its fields.
        where: Location of the table in the file, for messages.

    Raises:
        UnsupportedVersionError: if the table has unknown names.
        CorruptFileError: if a value is invalid.
    """
    known = {item.name for item in fields(config)}
    for name in table:
        if name not in known:
            raise UnsupportedVersionError(
                f"{where}: unknown parameter {short_repr(name)}: expected "
                f"{', '.join(sorted(known))}"
            )
    with reraise_as(CorruptFileError, f"{where}.", of=(ValueError, TypeError)):
        return config(**table)


def differences(
    stored: Json, current: Json, words: tuple[str, str] = ("there", "asked for"), prefix: str = ""
) -> list[str]:
    """Compare two sets of parameters.

    Args:
        stored: The first set.
        current: The second set.
        words: Words for the two sets in the messages.
        prefix: Text before every name.

    Returns:
        Lines such as "grid.voxel_m is 0.2 there, 0.1 asked for". Nested names are joined by dots;
            items of a list of tables are named by their positions.
    """
    lines = []
    for name in [*stored, *(name for name in current if name not in stored)]:
        old, new = (_numbered(table.get(name, "absent")) for table in (stored, current))
        if isinstance(old, dict) and isinstance(new, dict):
            lines += differences(old, new, words, f"{prefix}{name}.")
        elif old != new:
            lines.append(
                f"{short_repr(f'{prefix}{name}')[1:-1]} is {_short_json(old)} {words[0]}, "
                f"{_short_json(new)} {words[1]}"
            )
    return lines


def _numbered(value: Any) -> Any:
    """Convert a list of tables to a table by position; other values are returned unchanged."""
    tables = isinstance(value, list) and value and isinstance(value[0], dict)
    return dict(enumerate(value)) if tables else value


def _short_json(value: Any) -> str:
    """A parameter as JSON, shortened; digests by their first digits."""
    text = re.sub(r'"(\w{8})\w{56}"', r'"\1…"', json.dumps(value))
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 3]}..."


RAYS = "rays.npy"
"""File of a table of rays, in a dataset's folder."""


class RaysEntry(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Entry of a sensor that is no raster. A recipe's [lidar] has the same fields without the
    shape."""

    sensor: Literal["table"]
    rays: Literal["rays.npy"]
    sha256: Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
    shape: Annotated[list[Annotated[int, Meta(ge=1)]], Meta(min_length=1, max_length=MAX_AXES)]
    max_range_m: float
    made_by: Annotated[str, Meta(max_length=MAX_TEXT)]


def sensor_entry(sensor: Sensor) -> Json:
    """Describe a sensor in a manifest, as JSON values."""
    if isinstance(sensor, Lidar):
        entry: Json = msgspec.json.decode(msgspec.json.encode(asdict(sensor)))
        return entry
    # every sensor but a raster is stored as a table of its rays
    table = BeamTable.of(sensor)
    return {
        "sensor": "table",
        "rays": RAYS,
        "sha256": table.sha256,
        "shape": list(table.shape),
        "max_range_m": table.max_range_m,
        "made_by": table.made_by,
    }


def _entry_of(entry: Json) -> RaysEntry | Lidar:
    """Check a sensor's entry. Raises CorruptFileError."""
    if "sensor" not in entry:
        lidar: Lidar = configured(Lidar, entry, "recipe.lidar")
        return lidar
    with reraise_as(
        CorruptFileError, "recipe.lidar: ", of=ValueError
    ):  # msgspec's errors are ValueErrors
        table = msgspec.convert(entry, RaysEntry)
        if math.prod(table.shape) > MAX_RAYS:
            raise ValueError(f"shape = {table.shape}: expected {MAX_RAYS} rays at most")
        return table


def check_sensor_entry(entry: Json) -> tuple[tuple[int, ...], float]:
    """Check a sensor's entry. Returns the shape of its scans and its range, metres. Raises
    CorruptFileError."""
    sensor = _entry_of(entry)
    return tuple(sensor.shape), sensor.max_range_m


def rays_digest(entry: Json) -> dict[str, str]:
    """Name and SHA-256 of a sensor's table of rays; {} for a raster."""
    return {RAYS: entry["sha256"]} if "sensor" in entry else {}


def sensor_of(entry: Json, folder: Path) -> Sensor:
    """Make the sensor of an entry.

    Args:
        entry: The entry.
        folder: Folder of its table of rays, if it has one.

    Raises:
        CorruptFileError: if the entry or the table is damaged.
    """
    table = _entry_of(entry)
    if isinstance(table, Lidar):
        return table
    expected = (*table.shape, 4)
    try:
        content = read_bounded(folder / RAYS, max_bytes(math.prod(table.shape)))
        if sha256_of(content) != table.sha256:
            raise ValueError("is not the file whose sha256 the manifest's lidar names")
        rays = read_npy(content)
        if rays.shape != expected or rays.dtype.str != "<f8":
            raise ValueError(f"has shape {rays.shape} of {rays.dtype}, expected {expected}")
        return BeamTable(rays=rays, max_range_m=table.max_range_m, made_by=table.made_by)
    except FileNotFoundError:
        raise CorruptFileError(
            f"{RAYS}: is missing, though the manifest's lidar is a table of rays"
        ) from None
    except (ValueError, OSError, DatasetError) as error:
        raise CorruptFileError(f"{RAYS}: {printable(error)[:200]}") from None


def write_rays(sensor: Sensor, location: Location) -> None:
    """Write the table of a sensor's rays, unless it is there. A raster has none.

    Args:
        sensor: The sensor.
        location: Location of the dataset.
    """
    if isinstance(sensor, Lidar):
        return
    content = BeamTable.of(sensor).npy
    with suppress(FileNotFoundError, DatasetError):
        # a second run must not touch the file
        if read_at(location, RAYS, len(content)) == content:
            return
    create_at(location, RAYS, content)


def recipe_text(recipe: RecipeEntry, title: str) -> str:
    """Write the recipe of a manifest as a TOML file with every parameter, so that later versions of
    presets change nothing.

    Args:
        recipe: The recipe's entry.
        title: First line of the file.
    """
    lines = [f"# {title}", f"kind = {_toml(recipe.kind)}"]
    if recipe.difficulty != "medium":
        lines.append(f"difficulty = {_toml(recipe.difficulty)}")
    # the shape follows from the table of rays
    lidar = {name: value for name, value in recipe.lidar.items() if name != "shape"}
    if "sensor" in lidar:
        lidar["rays"] = RAYS
    tables: dict[str, Json | None] = {
        "world": recipe.world,
        "flight": recipe.flight,
        "accept": recipe.accept,
        "lidar": lidar,
        "noise": {"stages": recipe.noise.stages} if recipe.noise else None,
        "mapping": recipe.mapping,
        "known": recipe.known,
        # of all parts, movers alone have a table in recipe files
        "movers": recipe.parts.get("movers"),
        "grid": recipe.grid,
    }
    for name, values in tables.items():
        if values is not None:
            lines += ["", f"[{name}]"]
            lines += [f"{_key(key)} = {_toml(value)}" for key, value in values.items()]
    return "\n".join([*lines, ""])


def _key(name: str) -> str:
    """Write a key in TOML. A manifest's keys may be untrusted, and must not add lines."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name, re.ASCII) else _toml(name)


def _toml(value: Any) -> str:
    """Write a plain value in TOML."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    # TOML spells inf and nan as Python does; JSON's Infinity would be no TOML
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def noise_entry(noise: "Noise", max_range_m: float) -> NoiseEntry | None:
    """Describe noise in a manifest.

    Args:
        noise: The chain of noise.
        max_range_m: Range of the sensor, metres.

    Returns:
        The entry; None without stages.

    Raises:
        CorruptFileError: if no manifest can describe it.
    """
    if not noise.stages:
        return None
    bound_m = noise.bound_m(max_range_m)
    entry = {
        "stages": noise.spelled(),
        "bound_m": bound_m if math.isfinite(bound_m) else None,
        "version": NOISE_VERSION,
    }
    with reraise_as(CorruptFileError, "recipe.noise: "):
        return msgspec.convert(entry, NoiseEntry)


def mapping_entry(mapping: Mapper) -> Json:
    """Describe a mapper in a manifest. All mappers that act as the default have the default's
    parameters."""
    return plain(asdict(Mapper() if mapping.plain else mapping))
