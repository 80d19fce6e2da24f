"""The sensor of a dataset: what the manifest's `lidar` says of it, and the table of rays in the
folder.

A raster is written by its parameters, any other sensor by its rays, so that reading imports nothing
that made them.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lidarsim import BeamTable, Lidar, Sensor
from lidarsim.limits import MOST_RAYS
from lidarsim.sensors.table import MOST_AXES, MOST_MADE_BY, most_bytes, read_npy
from scenegen.dataset.rules import DIGEST, Rule, check, made
from scenegen.errors import BrokenError, DatasetError, printable
from scenegen.files import read_bounded, write_whole

RAYS = "rays.npy"
"""The table's file in a dataset's folder."""


_ENTRY = {
    "sensor": Rule(lambda value: value == "table", "table, or no entry for a raster"),
    "rays": Rule(lambda value: value == RAYS, RAYS),
    "sha256": DIGEST,
    "shape": Rule(
        lambda value: (
            isinstance(value, list)
            and 1 <= len(value) <= MOST_AXES
            and all(type(count) is int and 1 <= count <= MOST_RAYS for count in value)
            and math.prod(value) <= MOST_RAYS
        ),
        f"up to {MOST_AXES} counts, {MOST_RAYS} rays at most",
    ),
    "max_range_m": Rule(lambda value: type(value) in (int, float), "metres"),
    "made_by": Rule(
        lambda value: isinstance(value, str) and len(value) <= MOST_MADE_BY, "what made the rays"
    ),
}
"""What a manifest says of a table of rays; a recipe's [lidar] takes the same, but for the shape."""


def entry_of(sensor: Sensor) -> dict[str, Any]:
    """What the manifest says of a sensor, as plain JSON values."""
    if isinstance(sensor, Lidar):
        return json.loads(json.dumps(dataclasses.asdict(sensor)))
    table = BeamTable.of(sensor)
    return {
        "sensor": "table",
        "rays": RAYS,
        "sha256": table.sha256,
        "shape": list(table.shape),
        "max_range_m": table.max_range_m,
        "made_by": table.made_by,
    }


def files_of(entry: Mapping[str, Any]) -> dict[str, str]:
    """Files that the sensor takes in the dataset's folder, with their SHA-256. Raises
    BrokenError."""
    if "sensor" not in entry:
        _raster(entry)
        return {}
    check(entry, _ENTRY, "lidar", _ENTRY)
    return {RAYS: entry["sha256"]}


def reach_of(entry: Mapping[str, Any]) -> tuple[float, int]:
    """How far the sensor of an entry that `files_of` takes reaches, metres, and how many rays it
    has."""
    if "sensor" in entry:
        return float(entry["max_range_m"]), math.prod(entry["shape"])
    lidar = _raster(entry)
    return lidar.max_range_m, math.prod(lidar.shape)


def sensor_of(entry: Mapping[str, Any], folder: Path) -> Sensor:
    """The sensor of a manifest's `entry`. Raises BrokenError where it, or the table in `folder`, is
    damaged."""
    files = files_of(entry)
    if not files:
        return _raster(entry)
    expected = (*entry["shape"], 4)
    try:
        content = read_bounded(folder / RAYS, most_bytes(math.prod(entry["shape"])))
        if hashlib.sha256(content).hexdigest() != files[RAYS]:
            raise ValueError("is not the file whose sha256 the manifest's lidar names")
        rays = read_npy(content)
        if rays.shape != expected:
            raise ValueError(f"has shape {rays.shape}, the manifest's lidar names {expected}")
        return BeamTable(rays=rays, max_range_m=entry["max_range_m"], made_by=entry["made_by"])
    except FileNotFoundError:
        raise BrokenError(
            f"{RAYS}: is missing, though the manifest's lidar is a table of rays"
        ) from None
    except (ValueError, OSError, DatasetError) as error:
        raise BrokenError(f"{RAYS}: {printable(error)[:200]}") from None


def write_rays(sensor: Sensor, folder: Path) -> None:
    """Put the sensor's table into the dataset's folder, unless it is there."""
    if isinstance(sensor, Lidar):
        return
    path, table = folder / RAYS, BeamTable.of(sensor)
    if not path.is_file() or path.read_bytes() != table.npy:
        write_whole(path, table.npy)


def _raster(entry: Mapping[str, Any]) -> Lidar:
    return made(Lidar, entry, {item.name: item.name for item in dataclasses.fields(Lidar)}, "lidar")
