"""Parameters as plain values, in a manifest and in a recipe file: how they are checked and
compared; the entries of a sensor, of noise and of maps; and a recipe as TOML.

A sensor in a manifest is a raster's parameters, or the digest of a table of rays, which lies in the
dataset's folder as `rays.npy`.
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
from lidarsim.parameters import MOST_RAYS, MOST_SHOWN, MOST_TEXT
from lidarsim.sensors.table import MOST_AXES, most_bytes, read_npy
from scenegen.base.errors import BrokenError, DatasetError, NewerError, printable, raised_as, short
from scenegen.base.files import Json, read_bounded, sha256_of
from scenegen.base.stores import Place, create_at, read_at
from scenegen.dataset.schema import NoiseEntry, RecipeEntry
from scenegen.worlds.mapping import Mapper

if TYPE_CHECKING:
    from lidarsim.noise.chain import Noise


def plain(value: Any) -> Any:
    """`value` as JSON would give it back."""
    return json.loads(json.dumps(value))


def configured(config: Any, table: Any, where: str) -> Any:
    """The dataclass `config` of a `table` of its fields; errors name `where` in the file that is.

    Raises:
        NewerError: The table has other names, too.
        BrokenError: A value cannot be.
    """
    known = {item.name for item in fields(config)}
    for name in table:
        if name not in known:
            raise NewerError(
                f"{where}: unknown parameter {short(name)}: expected {', '.join(sorted(known))}"
            )
    with raised_as(BrokenError, f"{where}.", of=(ValueError, TypeError)):
        return config(**table)


def differences(
    stored: Json, asked: Json, words: tuple[str, str] = ("there", "asked for"), prefix: str = ""
) -> list[str]:
    """Where two sets of parameters differ.

    Args:
        stored: The first set.
        asked: The second set.
        words: What the values of the first and of the second set are called.
        prefix: Stands before every name.

    Returns:
        Lines such as "grid.voxel_m is 0.2 there, 0.1 asked for": nested names are joined by dots,
        and the items of a list of tables named by their places.
    """
    lines = []
    for name in [*stored, *(name for name in asked if name not in stored)]:
        old, new = (_numbered(table.get(name, "absent")) for table in (stored, asked))
        if isinstance(old, dict) and isinstance(new, dict):
            lines += differences(old, new, words, f"{prefix}{name}.")
        elif old != new:
            lines.append(
                f"{short(f'{prefix}{name}')[1:-1]} is {_shown(old)} {words[0]}, "
                f"{_shown(new)} {words[1]}"
            )
    return lines


def _numbered(value: Any) -> Any:
    """A list of tables as a table of them by their places; anything else as it is."""
    tables = isinstance(value, list) and value and isinstance(value[0], dict)
    return dict(enumerate(value)) if tables else value


def _shown(value: Any) -> str:
    """A parameter as JSON writes it, cut where it is long; of digests, the first digits."""
    text = re.sub(r'"(\w{8})\w{56}"', r'"\1…"', json.dumps(value))
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."


RAYS = "rays.npy"
"""The file of a table of rays, in a dataset's folder."""


class RaysEntry(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A sensor that is no raster; a recipe's [lidar] takes the same, but for the shape."""

    sensor: Literal["table"]
    rays: Literal["rays.npy"]
    sha256: Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
    shape: Annotated[list[Annotated[int, Meta(ge=1)]], Meta(min_length=1, max_length=MOST_AXES)]
    max_range_m: float
    made_by: Annotated[str, Meta(max_length=MOST_TEXT)]


def sensor_entry(sensor: Sensor) -> Json:
    """What a manifest says of a sensor, as plain JSON values."""
    if isinstance(sensor, Lidar):
        entry: Json = msgspec.json.decode(msgspec.json.encode(asdict(sensor)))
        return entry
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
    """A sensor's entry, checked. Raises BrokenError."""
    if "sensor" not in entry:
        lidar: Lidar = configured(Lidar, entry, "recipe.lidar")
        return lidar
    with raised_as(BrokenError, "recipe.lidar: ", of=ValueError):  # as msgspec's are
        table = msgspec.convert(entry, RaysEntry)
        if math.prod(table.shape) > MOST_RAYS:
            raise ValueError(f"shape = {table.shape}: expected {MOST_RAYS} rays at most")
        return table


def check_sensor_entry(entry: Json) -> tuple[tuple[int, ...], float]:
    """The shape of a sensor's scans, and its range in metres. Raises BrokenError."""
    sensor = _entry_of(entry)
    return tuple(sensor.shape), sensor.max_range_m


def rays_digest(entry: Json) -> dict[str, str]:
    """The file of the table of rays that a sensor takes, with its SHA-256; none for a raster."""
    return {RAYS: entry["sha256"]} if "sensor" in entry else {}


def sensor_of(entry: Json, folder: Path) -> Sensor:
    """The sensor of an entry, whose table of rays, if it is one, lies in `folder`. Raises
    BrokenError where that is damaged."""
    table = _entry_of(entry)
    if isinstance(table, Lidar):
        return table
    expected = (*table.shape, 4)
    try:
        content = read_bounded(folder / RAYS, most_bytes(math.prod(table.shape)))
        if sha256_of(content) != table.sha256:
            raise ValueError("is not the file whose sha256 the manifest's lidar names")
        rays = read_npy(content)
        if rays.shape != expected or rays.dtype.str != "<f8":
            raise ValueError(f"has shape {rays.shape} of {rays.dtype}, expected {expected}")
        return BeamTable(rays=rays, max_range_m=table.max_range_m, made_by=table.made_by)
    except FileNotFoundError:
        raise BrokenError(
            f"{RAYS}: is missing, though the manifest's lidar is a table of rays"
        ) from None
    except (ValueError, OSError, DatasetError) as error:
        raise BrokenError(f"{RAYS}: {printable(error)[:200]}") from None


def write_rays(sensor: Sensor, place: Place) -> None:
    """Put the table of a sensor's rays where the dataset lies, unless it is there; nothing for a
    raster."""
    if isinstance(sensor, Lidar):
        return
    content = BeamTable.of(sensor).npy
    with suppress(FileNotFoundError, DatasetError):
        if read_at(place, RAYS, len(content)) == content:
            return
    create_at(place, RAYS, content)


def recipe_text(recipe: RecipeEntry, title: str) -> str:
    """A recipe file with every parameter of a manifest's recipe, so that no preset's later version
    changes anything; `title` is its first line."""
    lines = [f"# {title}", f"kind = {_toml(recipe.kind)}"]
    if recipe.difficulty != "medium":
        lines.append(f"difficulty = {_toml(recipe.difficulty)}")
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
        "grid": recipe.grid,
    }
    for name, table in tables.items():
        if table is not None:
            lines += ["", f"[{name}]"]
            lines += [f"{_key(key)} = {_toml(value)}" for key, value in table.items()]
    return "\n".join([*lines, ""])


def _key(name: str) -> str:
    """A key in TOML: a manifest's may come from a stranger, and must not add lines of its own."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name, re.ASCII) else _toml(name)


def _toml(value: Any) -> str:
    """A plain value in TOML."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def noise_entry(noise: "Noise", max_range_m: float) -> NoiseEntry | None:
    """What a manifest says of noise on a sensor of that range; None without stages. Raises
    BrokenError for noise that no manifest can hold."""
    if not noise.stages:
        return None
    bound_m = noise.bound_m(max_range_m)
    entry = {
        "stages": noise.spelled(),
        "bound_m": bound_m if math.isfinite(bound_m) else None,
        "version": NOISE_VERSION,
    }
    with raised_as(BrokenError, "recipe.noise: "):
        return msgspec.convert(entry, NoiseEntry)


def mapping_entry(mapping: Mapper) -> Json:
    """Every parameter of how maps are made; those of the default for what is the same."""
    return plain(asdict(Mapper() if mapping.plain else mapping))
