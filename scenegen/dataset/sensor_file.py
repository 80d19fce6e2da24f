"""A sensor in a manifest: a raster's parameters, or the digest of a table of rays, which lies in
the dataset's folder as `rays.npy`."""

import math
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from lidarsim import BeamTable, Lidar, Sensor
from lidarsim.parameters import MOST_RAYS, MOST_TEXT
from lidarsim.sensors.table import MOST_AXES, most_bytes, read_npy
from scenegen.dataset.parameters import configured
from scenegen.errors import BrokenError, DatasetError, printable, raised_as
from scenegen.files import Json, read_bounded, sha256_of
from scenegen.stores import Place, create_at, read_at

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
