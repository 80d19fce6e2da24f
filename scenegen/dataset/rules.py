"""What a stranger's manifest says, held against rules before anybody relies on it: JSON of any
kind, noise, the sensor, and how samples are numbered."""

import dataclasses
import hashlib
import itertools
import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from lidarsim import BeamTable, Lidar, Sensor
from lidarsim.noise import STAGES
from lidarsim.parameters import MOST_RAYS
from lidarsim.sensors.table import MOST_AXES, MOST_MADE_BY, most_bytes, read_npy
from scenegen import SPLITS
from scenegen.errors import BrokenError, DatasetError, NewerError, printable, short
from scenegen.files import read_bounded, write_whole
from scenegen.limits import MOST_CLASSES, MOST_SEED, MOST_SOURCES
from scenegen.sample import stored_fields


@dataclass(frozen=True, kw_only=True)
class Numbering:
    """The rule of docs/format.md, for one split. A place may be one number, or an array of them."""

    viewpoints: int
    """Samples of one flight."""
    scenes: int | None
    """Worlds from MJCF files, which flights visit in turn; None where each flight has a world of
    its own."""

    def name(self, place: Any) -> tuple[Any, Any]:
        """(world, viewpoint) of the sample at `place`."""
        unit, view = place // self.viewpoints, place % self.viewpoints
        if self.scenes is None:
            return unit, view
        return unit % self.scenes, unit // self.scenes * self.viewpoints + view

    def place(self, world: Any, viewpoint: Any) -> Any:
        """The place of the sample that is `viewpoint` of `world`."""
        if self.scenes is None:
            return world * self.viewpoints + viewpoint
        turn, view = viewpoint // self.viewpoints, viewpoint % self.viewpoints
        return (turn * self.scenes + world) * self.viewpoints + view

    def worlds(self, start: int, samples: int) -> Sequence[int]:
        """Numbers of the worlds that so many samples are of, from the one at `start` on, rising."""
        units = range(start // self.viewpoints, (start + samples - 1) // self.viewpoints + 1)
        return (
            units
            if self.scenes is None
            else sorted({unit % self.scenes for unit in units[: self.scenes]})
        )


T = TypeVar("T")


@dataclass(frozen=True)
class Rule:
    """What a value may be, as a test and in words."""

    fits: Callable[[Any], bool]
    words: str


FLAG = Rule(lambda value: isinstance(value, bool), "true or false")
TABLE = Rule(lambda value: isinstance(value, dict), "a table")
LIST = Rule(lambda value: isinstance(value, list), "a list")


def whole(least: int, most: int) -> Rule:
    """Whole numbers from `least` to `most`."""
    return Rule(
        lambda value: type(value) is int and least <= value <= most,
        f"a whole number from {least} to {most}",
    )


def text(pattern: str, words: str) -> Rule:
    """Texts that match the whole `pattern`, which `words` describe."""
    matches = re.compile(pattern).fullmatch
    return Rule(lambda value: isinstance(value, str) and matches(value) is not None, words)


DIGEST = text("[0-9a-f]{64}", "a SHA-256, 64 hexadecimal digits")


def optional(rule: Rule) -> Rule:
    """What `rule` allows, or null."""
    return Rule(lambda value: value is None or rule.fits(value), f"{rule.words}, or null")


def table_of(rule: Rule) -> Rule:
    """Tables whose values are as `rule` says, whatever they are called."""
    return Rule(
        lambda value: isinstance(value, dict) and all(map(rule.fits, value.values())),
        f"a table, each value {rule.words}",
    )


def check(found: Any, rules: Mapping[str, Rule], at: str, known: Collection[str] = ()) -> None:
    """Raise BrokenError unless `found` is a table that has all that `rules` name, each as its rule
    says, and, where names are `known`, NewerError if it has others.

    `at` is where the table stands in the file, such as ``shards.3``, empty for the whole; it begins
    the error.
    """
    if not isinstance(found, Mapping):
        raise BrokenError(f"{at} = {short(found)}: expected a table")
    for name, rule in rules.items():
        where = f"{at}.{name}" if at else name
        if name not in found:
            raise BrokenError(f"{where} is missing: expected {rule.words}")
        if not rule.fits(found[name]):
            raise BrokenError(f"{where} = {short(found[name])}: expected {rule.words}")
    for name in found if known else ():
        if name not in known:
            raise NewerError(f"{at}: unknown parameter {short(name)}: expected {', '.join(known)}")


def ruled(rule: Rule) -> Any:
    """A field of a dataclass whose values in a file are as `rule` says."""
    return field(metadata={"rule": rule})


def checked(kind: type, found: Any, at: str) -> dict[str, Any]:
    """The values in the table `found` of those fields of the dataclass `kind` that have a rule.
    Raises BrokenError."""
    rules = _rules_of(kind)
    check(found, rules, at)
    return {name: found[name] for name in rules}


@cache  # a manifest lists up to a hundred thousand shards
def _rules_of(kind: type) -> Mapping[str, Rule]:
    return {item.name: item.metadata["rule"] for item in fields(kind) if "rule" in item.metadata}


def made(part: type[T], table: Any, names: Mapping[str, str], at: str) -> T:
    """The dataclass `part` of a table whose keys `names` are called otherwise there. Raises
    BrokenError."""
    check(table, {}, at, names)
    try:
        return part(**{names[name]: value for name, value in table.items()})
    except ValueError as error:
        said = str(error)
        for name, ours in names.items():
            said = said.replace(ours, name)
        raise BrokenError(f"{at}.{said}") from None


if TYPE_CHECKING:  # which imports MuJoCo, and reading takes none
    from lidarsim.noise.chain import Noise

MOST_STAGES_TEXT = 4000
"""Characters of the text of a dataset's stages."""
_NOISE_ENTRY = {
    "stages": text(
        rf"[ -~]{{1,{MOST_STAGES_TEXT}}}", "stages of noise, as lidarsim.noise writes them"
    ),
    "bound_m": Rule(
        lambda value: value is None or (type(value) in (int, float) and 0 <= value < math.inf),
        "metres, or null",
    ),
}


def noise_entry(noise: "Noise", max_range_m: float) -> dict[str, Any]:
    """What the manifest says of a chain with a sensor of that range; nothing of one without stages.
    Raises BrokenError for one that no manifest can hold."""
    if not noise.stages:
        return {}
    bound = noise.bound_m(max_range_m)
    entry = {"stages": noise.spelled(), "bound_m": bound if bound < math.inf else None}
    check_noise(entry)
    return {"noise": entry}


def check_noise(entry: Any) -> None:
    """Raise BrokenError unless a manifest's `noise` is a table as the format has it, or null."""
    if entry is not None:
        check(entry, _NOISE_ENTRY, "noise", _NOISE_ENTRY)


def is_ours(entry: Mapping[str, Any] | None) -> bool:
    """Whether all stages are scenegen's own, so that reading them imports nothing that a manifest
    names."""
    stages = entry["stages"].split(",") if entry else []
    return all(stage.partition(":")[0] in STAGES.known for stage in stages)


def noise_of(entry: Mapping[str, Any] | None, max_range_m: float) -> "Noise":
    """The chain of a manifest's entry whose stages `is_ours`. Raises BrokenError for one that
    cannot be, or whose bound is another."""
    from lidarsim.noise.chain import Noise

    try:
        found = Noise.parse(entry["stages"]) if entry else Noise()
    except ValueError as error:
        raise BrokenError(
            f"noise.stages = {short(entry['stages'] if entry else '')}: {printable(error)}"
        ) from None
    if entry and (bound := noise_entry(found, max_range_m)["noise"]["bound_m"]) != entry["bound_m"]:
        raise BrokenError(
            f"noise.bound_m = {entry['bound_m']}: its stages have {bound} with this sensor"
        )
    return found


RAYS = "rays.npy"
"""The table's file in a dataset's folder."""


_SENSOR_ENTRY = {
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


def sensor_entry(sensor: Sensor) -> dict[str, Any]:
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
    check(entry, _SENSOR_ENTRY, "lidar", _SENSOR_ENTRY)
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


FLAGS = (False, True)
FIELDS_RULE = Rule(
    lambda value: (
        value
        in [
            list(stored_fields(*given, scans))
            for given in itertools.product(FLAGS, FLAGS)
            for scans in (1, 2)
        ]
    ),
    "all, or all but the derived ones, with labels or without, with earlier scans or without",
)
LABELS_RULES = {
    "by": Rule(lambda value: value in ("name", "material", "group"), "name, material or group"),
    "classes": Rule(
        lambda value: (
            isinstance(value, list)
            and 0 < len(value) <= MOST_CLASSES
            and all(isinstance(name, str) and name.isprintable() for name in value)
            and len(set(value)) == len(value)
        ),
        f"up to {MOST_CLASSES} different names",
    ),
}
TEXTS = table_of(Rule(lambda value: isinstance(value, str), "text"))
RECIPE_RULES = {
    "version": whole(0, MOST_SEED),
    "world": optional(TABLE),
    "flight": TABLE,
    "accept": TABLE,
    "scenes": Rule(
        lambda value: (
            value is None
            or (
                isinstance(value, dict)
                and value.keys() <= set(SPLITS)
                and all(
                    isinstance(worlds, list) and all(map(TEXTS.fits, worlds))
                    for worlds in value.values()
                )
            )
        ),
        "the worlds of each split",
    ),
}
FILE_RULE = text(
    r"(train|val|test)-[0-9]{5,9}(\.h5|\.worlds\.zip)",
    "such as train-00000.h5 or train-00000.worlds.zip",
)
SOURCES_RULE = Rule(
    lambda value: isinstance(value, list) and 0 < len(value) <= MOST_SOURCES,
    "datasets, one at least",
)
