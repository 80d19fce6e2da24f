"""The parts of a recipe that have entries of their own in a manifest: one table that writers,
readers and checks walk."""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim import BeamTable, GridSpec, Lidar, Sensor
from lidarsim.noise import VERSION
from lidarsim.parameters import MOST_RAYS, MOST_TEXT
from lidarsim.sensors.table import MOST_AXES, most_bytes, read_npy
from scenegen.dataset.rules import DIGEST, Rule, check, made, text, whole
from scenegen.errors import BrokenError, DatasetError, printable, raised_as, short
from scenegen.files import Json, read_bounded, sha256_of
from scenegen.limits import MOST_CLASSES, MOST_RAYS_IN_SAMPLE, MOST_SEED, MOST_VOXELS
from scenegen.sample import Schema
from scenegen.stores import Place, create_at, read_at
from scenegen.worlds.mapping import Known, Mapper

if TYPE_CHECKING:  # these import MuJoCo, which reading does not take
    from lidarsim.noise.chain import Noise
    from scenegen.dataset.trust import Manifest
    from scenegen.recipe import Recipe

GRID = {"shape": "shape", "voxel": "voxel_m", "truncation": "truncation_m", "hollow": "hollow"}
"""A grid's parameters: their names in the file, and in `GridSpec`."""
NEEDED = ("shape", "voxel", "truncation")
"""Parameters of a grid that every file names; it names the others only where they are not the
default."""
RAYS = "rays.npy"
"""The file of a table of rays, in a dataset's folder."""
MOST_STAGES_TEXT = 4000
"""Characters of the text of a dataset's stages."""
_NOISE = {
    "stages": text(
        rf"[ -~]{{1,{MOST_STAGES_TEXT}}}", "stages of noise, as lidarsim.noise writes them"
    ),
    "bound_m": Rule(
        lambda value: value is None or (type(value) in (int, float) and 0 <= value < math.inf),
        "metres, or null",
    ),
    "version": whole(1, MOST_SEED),
}
_TABLE_OF_RAYS = {
    "sensor": text("table", "table, or no entry for a raster"),
    "rays": text("rays[.]npy", RAYS),
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
    "made_by": text(rf"(?s).{{0,{MOST_TEXT}}}", "what made the rays"),
}
"""What a manifest says of a table of rays; a recipe's [lidar] takes the same, but for the shape."""
_LABELS = {
    "by": text("class|name|material|group", "class, name, material or group"),
    "classes": Rule(
        lambda value: (
            isinstance(value, list)
            and 0 < len(value) <= MOST_CLASSES
            and all(isinstance(name, str) and name.isprintable() for name in value)
            and len(set(value)) == len(value)
            and value[0] == "nothing"
        ),
        f'up to {MOST_CLASSES} different names, "nothing" first',
    ),
}


def grid_entry(grid: GridSpec) -> Json:
    """What the manifest says of a grid."""
    plain = GridSpec()
    return {
        name: getattr(grid, ours)
        for name, ours in GRID.items()
        if name in NEEDED or getattr(grid, ours) != getattr(plain, ours)
    }


def _read_grid(entry: Any, before: Json) -> GridSpec:
    grid = made(GridSpec, entry, "grid", GRID, needed=NEEDED)
    if math.prod(grid.shape) > MOST_VOXELS:
        raise BrokenError(
            f"grid.shape = {short(list(grid.shape))}: expected {MOST_VOXELS} voxels at most"
        )
    return grid


def sensor_entry(sensor: Sensor) -> Json:
    """What the manifest says of a sensor, as plain JSON values."""
    if isinstance(sensor, Lidar):
        return plain(asdict(sensor))
    table = BeamTable.of(sensor)
    return {
        "sensor": "table",
        "rays": RAYS,
        "sha256": table.sha256,
        "shape": list(table.shape),
        "max_range_m": table.max_range_m,
        "made_by": table.made_by,
    }


def read_sensor(entry: Any, before: Json) -> Json:
    """A sensor's entry, checked. Raises BrokenError."""
    if isinstance(entry, Mapping) and "sensor" in entry:
        check(entry, _TABLE_OF_RAYS, "lidar", _TABLE_OF_RAYS)
    else:
        made(Lidar, entry, "lidar", needed=())
    return entry


def rays_files(sums: Iterable[str]) -> dict[str, str]:
    """The files of the tables of rays with these SHA-256 `sums` in the folder of a dataset, by
    sum."""
    different = dict.fromkeys(sums)
    return {one: RAYS if len(different) == 1 else f"rays-{one[:16]}.npy" for one in different}


def rays_named(parameters: Json) -> dict[str, str]:
    """`rays_files` of a manifest's checked `parameters`, and of its sources'."""
    every = parameters, *(one["parameters"] for one in parameters.get("sources") or ())
    return rays_files(one["lidar"]["sha256"] for one in every if "sensor" in one["lidar"])


def sensor_of(entry: Json, folder: Path, name: str = RAYS) -> Sensor:
    """The sensor of a checked entry, its table of rays, if it is one, in the file `name` of
    `folder`. Raises BrokenError where that is damaged."""
    if "sensor" not in entry:
        return Lidar(**entry)
    expected = (*entry["shape"], 4)
    try:
        content = read_bounded(folder / name, most_bytes(math.prod(entry["shape"])))
        if sha256_of(content) != entry["sha256"]:
            raise ValueError("is not the file whose sha256 the manifest's lidar names")
        rays = read_npy(content)
        if rays.shape != expected or rays.dtype.str != "<f8":
            raise ValueError(
                f"has shape {rays.shape} of {rays.dtype}, the manifest's lidar names {expected} of "
                "float64"
            )
        return BeamTable(rays=rays, max_range_m=entry["max_range_m"], made_by=entry["made_by"])
    except FileNotFoundError:
        raise BrokenError(
            f"{name}: is missing, though the manifest's lidar is a table of rays"
        ) from None
    except (ValueError, OSError, DatasetError) as error:
        raise BrokenError(f"{name}: {printable(error)[:200]}") from None


def tables_of(sensors: Iterable[Sensor]) -> dict[str, BeamTable]:
    """The tables of rays that `sensors` take in the dataset's folder, by their files."""
    tables = [BeamTable.of(one) for one in sensors if not isinstance(one, Lidar)]
    names = rays_files(table.sha256 for table in tables)
    return {names[table.sha256]: table for table in tables}


def write_rays(sensors: Iterable[Sensor], place: Place) -> None:
    """Put the tables of `sensors` where the dataset lies, unless they are there."""
    for name, table in tables_of(sensors).items():
        with suppress(FileNotFoundError, DatasetError):
            if read_at(place, name, len(table.npy)) == table.npy:
                continue
        create_at(place, name, table.npy)


def noise_entry(noise: "Noise", max_range_m: float) -> Json | None:
    """What the manifest says of a chain with a sensor of that range; None without stages. Raises
    BrokenError for one that no manifest can hold."""
    if not noise.stages:
        return None
    bound = noise.bound_m(max_range_m)
    entry = {
        "stages": noise.spelled(),
        "bound_m": bound if bound < math.inf else None,
        "version": VERSION,
    }
    check(entry, _NOISE, "noise", _NOISE)
    return entry


def _read_plain(name: str, rules: Mapping[str, Rule], **unnamed: Any) -> Callable[[Any, Json], Any]:
    """What reads an entry that stays a table, where it is there; `unnamed` is what it says by not
    naming it."""

    def read(entry: Any, before: Json) -> Any:
        if entry is None:
            return None
        check(entry, {}, name)
        entry = {**unnamed, **entry}
        check(entry, rules, name, rules)
        return entry

    return read


def noise_of(entry: Json | None, max_range_m: float) -> "Noise":
    """The chain of a manifest's entry whose stages are all ours. Raises BrokenError for one that
    cannot be, or whose bound is another."""
    from lidarsim.noise.chain import Noise

    if entry is None:
        return Noise()
    with raised_as(BrokenError, f"noise.stages = {short(entry['stages'])}: "):
        found = Noise.parse(entry["stages"])
    again = noise_entry(found, max_range_m)
    if again and again["bound_m"] != entry["bound_m"]:
        raise BrokenError(
            f"noise.bound_m = {entry['bound_m']}: its stages have {again['bound_m']} with this "
            f"sensor"
        )
    return found


def mapping_entry(mapping: Mapper) -> Json | None:
    """What the manifest says of how maps are made; None where each is one scan around a level
    sensor."""
    return None if mapping.plain else described(mapping)


def described(mapping: Mapper) -> Json:
    """Every parameter of how maps are made, as plain JSON values; those of the default for what is
    the same."""
    return plain(asdict(Mapper() if mapping.plain else mapping))


def _read_mapping(entry: Any, before: Json) -> Mapper:
    if entry is None:
        return Mapper()
    mapping = made(Mapper, entry, "mapping")
    sensor = before["lidar"]
    shape, reach = sensor.get("shape"), sensor.get("max_range_m")
    if "sensor" not in sensor:
        shape, reach = (raster := Lidar(**sensor)).shape, raster.max_range_m
    with raised_as(BrokenError):
        mapping.check_reach(before["grid"], reach, math.prod(shape), MOST_RAYS_IN_SAMPLE)
    return mapping


def plain(value: Any) -> Any:
    """`value` as JSON would give it back."""
    return json.loads(json.dumps(value))


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a recipe that has an entry of its own in a manifest."""

    name: str
    """Its name, in manifests, recipes and `Manifest`."""
    since: int | float | str
    """The first version of the format in which manifests may have the entry."""
    entry: Callable[["Recipe"], Any]
    """The entry that a recipe has in the manifest; None for none."""
    read: Callable[[Any, Json], Any]
    """What `Manifest` holds, from the entry (None where it is not there) and the parts before it.
    Raises BrokenError."""
    group: str = ""
    """The group of fields that it may bring; see `scenegen.sample.GROUPS`."""
    brings: Callable[[Any], bool] = bool
    """Whether samples have that group, by the part's value in a recipe or a `Manifest`."""


PARTS = (
    Part(
        name="grid",
        since=1,
        entry=lambda recipe: plain(grid_entry(recipe.grid)),
        read=_read_grid,
    ),
    Part(
        name="lidar",
        since=1,
        entry=lambda recipe: sensor_entry(recipe.lidar),
        read=read_sensor,
    ),
    Part(
        name="noise",
        since=1.2,
        entry=lambda recipe: noise_entry(recipe.noise, recipe.lidar.max_range_m),
        read=_read_plain("noise", _NOISE, version=1),
    ),
    Part(
        name="labels",
        since=1.2,
        entry=lambda recipe: recipe.labels and plain(asdict(recipe.labels)),
        read=_read_plain("labels", _LABELS),
        group="labels",
    ),
    Part(
        name="mapping",
        since=1.3,
        entry=lambda recipe: mapping_entry(recipe.mapping),
        read=_read_mapping,
        group="earlier",
        brings=lambda mapping: mapping.scans > 1,
    ),
    Part(
        name="known",
        since="1.5",
        entry=lambda recipe: recipe.known and plain(asdict(recipe.known)),
        read=lambda entry, before: None if entry is None else made(Known, entry, "known"),
        group="known",
    ),
)
"""In the order in which they stand in the file and are read."""
NAMES = tuple(part.name for part in PARTS)


def entries(recipe: "Recipe") -> Json:
    """What the manifest says of the parts of a recipe."""
    found = {part.name: part.entry(recipe) for part in PARTS}
    return {name: entry for name, entry in found.items() if entry is not None}


def schema_of(it: "Recipe | Manifest") -> Schema:
    """Which fields the samples have. Raises BrokenError where a table of rays is damaged."""
    groups = (part.group for part in PARTS if part.group and part.brings(getattr(it, part.name)))
    return Schema(grid=it.grid, lidar=it.lidar, groups=tuple(groups), scans=it.mapping.scans)
